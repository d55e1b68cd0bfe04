// Numbers with twice a double's digits, for the few problems that lose all of a double's: the unevaluated sum of two doubles
// (Dekker 1971; Hida, Li, Bailey 2001). A dozen times slower.
#pragma once
#include <cmath>

namespace grasp {

struct Twice {
    double high = 0.0, low = 0.0;

    Twice() = default;
    Twice(double value) : high(value) {}
    explicit operator double() const { return high; }

    friend Twice operator+(const Twice& a, const Twice& b) {
        Twice s = sum(a.high, b.high);
        const Twice t = sum(a.low, b.low);
        s = ordered(s.high, s.low + t.high);
        return ordered(s.high, s.low + t.low);
    }
    friend Twice operator-(const Twice& a) { return {-a.high, -a.low}; }
    friend Twice operator-(const Twice& a, const Twice& b) { return a + -b; }
    friend Twice operator*(const Twice& a, const Twice& b) {
        const double p = product(a.high, b.high);
        return ordered(p, std::fma(a.high, b.high, -p) + (a.high * b.low + a.low * b.high));
    }
    friend Twice operator/(const Twice& a, const Twice& b) {
        const double first = a.high / b.high;
        if (!std::isfinite(first)) return first;
        Twice left = a - first * b;
        const double second = left.high / b.high;
        left = left - second * b;
        return ordered(first, second) + Twice(left.high / b.high);
    }
    friend Twice sqrt(const Twice& a) {
        const double root = std::sqrt(a.high);
        if (!(root > 0.0)) return root;
        return Twice(root) + (a - Twice(root) * Twice(root)) / Twice(2.0 * root);
    }
    Twice& operator+=(const Twice& b) { return *this = *this + b; }
    Twice& operator-=(const Twice& b) { return *this = *this - b; }
    Twice& operator*=(const Twice& b) { return *this = *this * b; }
    Twice& operator/=(const Twice& b) { return *this = *this / b; }
    friend bool operator<(const Twice& a, const Twice& b) { return a.high < b.high || (a.high == b.high && a.low < b.low); }
    friend bool operator>(const Twice& a, const Twice& b) { return b < a; }
    friend bool operator<=(const Twice& a, const Twice& b) { return a.high < b.high || (a.high == b.high && a.low <= b.low); }
    friend bool operator>=(const Twice& a, const Twice& b) { return b <= a; }

private:
    Twice(double high, double low) : high(high), low(low) {}
    static Twice sum(double a, double b) {  // exact
        const double s = a + b, c = s - a;
        return {s, (a - (s - c)) + (b - c)};
    }
    static Twice ordered(double a, double b) {  // exact if |a| >= |b|
        const double s = a + b;
        return {s, b - (s - a)};
    }
    // Never fused with a sum: compilers may round a product and a sum at once, which the error terms above do not allow for.
    static double product(double a, double b) { return std::fma(a, b, 0.0); }
};

inline bool finite(double a) { return std::isfinite(a); }
inline bool finite(const Twice& a) { return std::isfinite(a.high); }

}  // namespace grasp
