// Numbers with twice a double's digits, for the few problems that need them: the unevaluated sum of
// two doubles (Dekker 1971; Hida, Li, Bailey 2001). A dozen times slower.
#pragma once
#include <cmath>

namespace grasp {

struct DoubleDouble {
  double high = 0.0, low = 0.0;

  DoubleDouble() = default;
  DoubleDouble(double value) : high(value) {}
  explicit operator double() const { return high; }

  friend DoubleDouble operator+(const DoubleDouble& a, const DoubleDouble& b) {
    DoubleDouble s = sum(a.high, b.high);
    const DoubleDouble t = sum(a.low, b.low);
    s = ordered(s.high, s.low + t.high);
    return ordered(s.high, s.low + t.low);
  }
  friend DoubleDouble operator-(const DoubleDouble& a) { return {-a.high, -a.low}; }
  friend DoubleDouble operator-(const DoubleDouble& a, const DoubleDouble& b) { return a + -b; }
  friend DoubleDouble operator*(const DoubleDouble& a, const DoubleDouble& b) {
    const double p = product(a.high, b.high);
    return ordered(p, std::fma(a.high, b.high, -p) + (a.high * b.low + a.low * b.high));
  }
  friend DoubleDouble operator/(const DoubleDouble& a, const DoubleDouble& b) {
    const double first = a.high / b.high;
    if (!std::isfinite(first)) return first;
    DoubleDouble left = a - first * b;
    const double second = left.high / b.high;
    left = left - second * b;
    return ordered(first, second) + DoubleDouble(left.high / b.high);
  }
  friend DoubleDouble sqrt(const DoubleDouble& a) {
    const double root = std::sqrt(a.high);
    if (!(root > 0.0)) return root;
    return DoubleDouble(root) +
           (a - DoubleDouble(root) * DoubleDouble(root)) / DoubleDouble(2.0 * root);
  }
  DoubleDouble& operator+=(const DoubleDouble& b) { return *this = *this + b; }
  DoubleDouble& operator-=(const DoubleDouble& b) { return *this = *this - b; }
  DoubleDouble& operator*=(const DoubleDouble& b) { return *this = *this * b; }
  DoubleDouble& operator/=(const DoubleDouble& b) { return *this = *this / b; }
  friend bool operator<(const DoubleDouble& a, const DoubleDouble& b) {
    return a.high < b.high || (a.high == b.high && a.low < b.low);
  }
  friend bool operator>(const DoubleDouble& a, const DoubleDouble& b) { return b < a; }
  friend bool operator<=(const DoubleDouble& a, const DoubleDouble& b) {
    return a.high < b.high || (a.high == b.high && a.low <= b.low);
  }
  friend bool operator>=(const DoubleDouble& a, const DoubleDouble& b) { return b <= a; }

 private:
  DoubleDouble(double high, double low) : high(high), low(low) {}
  static DoubleDouble sum(double a, double b) {  // exact
    const double s = a + b;
    const double c = s - a;
    return {s, (a - (s - c)) + (b - c)};
  }
  static DoubleDouble ordered(double a, double b) {  // exact if |a| >= |b|
    const double s = a + b;
    return {s, b - (s - a)};
  }
  // Never fused with a sum: compilers may round a product and a sum at once, which the error terms
  // above do not allow for.
  static double product(double a, double b) { return std::fma(a, b, 0.0); }
};

inline bool finite(double a) { return std::isfinite(a); }
inline bool finite(const DoubleDouble& a) { return std::isfinite(a.high); }

}  // namespace grasp
