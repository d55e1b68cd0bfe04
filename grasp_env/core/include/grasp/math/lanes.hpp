// Registers with the operators of numbers: `Lanes` holds W contacts of one problem (a double is the
// register of one contact), `Each` one contact of W problems.
#pragma once
#include <array>
#include <limits>
#include <type_traits>
#include <vector>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error \
    "grasp: -ffast-math drops the checks for NaN that every solver relies on; take -ffp-contract=fast -fno-math-errno -fno-trapping-math"
#endif

namespace grasp {

// Doubles in a register of this build. Wider vectors than the machine's go through memory: twelve
// times as slow.
#if defined(__AVX512F__)
inline constexpr int REGISTER = 8;
#elif defined(__AVX__)
inline constexpr int REGISTER = 4;
#else
inline constexpr int REGISTER = 2;
#endif

template <int W> struct LaneType {
  typedef double type __attribute__((vector_size(8 * W)));
};
template <> struct LaneType<1> {
  typedef double type;
};
template <int W> using Lanes = typename LaneType<W>::type;
template <class V> inline constexpr int width = int(sizeof(V) / sizeof(double));
template <int W> struct Each;
template <class V> inline constexpr bool many = false;  // true for a register of problems
template <int W> inline constexpr bool many<Each<W>> = true;
template <int W> inline constexpr int width<Each<W>> = 1;  // contacts in a register
inline constexpr double infinity = std::numeric_limits<double>::infinity();

template <class V> [[gnu::always_inline]] inline V select(decltype(V{} < V{}) which, V a, V b) {
  return which ? a : b;
}
template <class V> inline V all(double a) { return V{} + a; }
template <class V> inline V all(const V& a)
  requires many<V>
{
  return a;
}
template <class V> inline V min(V a, V b) { return a < b ? a : b; }
template <class V> inline V max(V a, V b) { return a > b ? a : b; }
template <class V> inline V abs(V a) {
  if constexpr (std::is_same_v<V, double>)
    return __builtin_fabs(a);
  else
    return max(a, -a);
}

template <class V> inline double get(const V& a, int n) {
  if constexpr (many<V>)
    return a.lanes[n];
  else if constexpr (width<V> == 1)
    return a;
  else
    return a[n];
}
template <class V> inline void set(V& a, int n, double value) {
  if constexpr (many<V>)
    a.lanes[n] = value;
  else if constexpr (width<V> == 1)
    a = value;
  else
    a[n] = value;
}
template <class V> [[gnu::always_inline]] inline V sqrt(V a) {
  if constexpr (width<V> == 1) {
    return __builtin_sqrt(a);
  } else {
    V root = a;
    for (int n = 0; n < width<V>; ++n) root[n] = __builtin_sqrt(a[n]);
    return root;
  }
}

// W problems side by side, one contact at a time: sums and comparisons over the contacts stay
// separate for each problem.
template <int W> struct Each {
  using Register = Lanes<W>;
  using Mask = decltype(Register{} < Register{});  // of problems
  Register lanes;

  Each() = default;
  Each(double a) : lanes(Register{} + a) {}
  Each(const Register& lanes) : lanes(lanes) {}

  friend Each operator+(const Each& a, const Each& b) { return a.lanes + b.lanes; }
  friend Each operator-(const Each& a, const Each& b) { return a.lanes - b.lanes; }
  friend Each operator-(const Each& a) { return -a.lanes; }
  friend Each operator*(const Each& a, const Each& b) { return a.lanes * b.lanes; }
  friend Each operator/(const Each& a, const Each& b) { return a.lanes / b.lanes; }
  Each& operator+=(const Each& b) { return *this = *this + b; }
  Each& operator-=(const Each& b) { return *this = *this - b; }
  Each& operator*=(const Each& b) { return *this = *this * b; }
  friend Mask operator<(const Each& a, const Each& b) { return a.lanes < b.lanes; }
  friend Mask operator>(const Each& a, const Each& b) { return a.lanes > b.lanes; }
  friend Mask operator<=(const Each& a, const Each& b) { return a.lanes <= b.lanes; }
  friend Mask operator>=(const Each& a, const Each& b) { return a.lanes >= b.lanes; }
  friend Mask operator==(const Each& a, const Each& b) { return a.lanes == b.lanes; }
  friend Mask operator!=(const Each& a, const Each& b) { return a.lanes != b.lanes; }
  friend Each select(const Mask& which, const Each& a, const Each& b) {
    return which ? a.lanes : b.lanes;
  }
  friend Each min(const Each& a, const Each& b) { return select(a < b, a, b); }
  friend Each max(const Each& a, const Each& b) { return select(a > b, a, b); }
  friend Each sqrt(const Each& a) { return sqrt(a.lanes); }
};

// The lanes from `first` on, as many as a register of half the size holds.
template <int first, class V> [[gnu::always_inline]] inline auto half(const V& a) {
#if __has_builtin(__builtin_shufflevector)
  if constexpr (width<V> == 4)
    return __builtin_shufflevector(a, a, first, first + 1);
  else
    return __builtin_shufflevector(a, a, first, first + 1, first + 2, first + 3);
#else  // GCC 11
  typedef std::remove_cvref_t<decltype(a[0])> type __attribute__((vector_size(sizeof(V) / 2)));
  type out;
  __builtin_memcpy(&out, reinterpret_cast<const char*>(&a) + first * sizeof(double), sizeof(out));
  return out;
#endif
}
// Reductions over the lanes, as a tree.
template <class V, class F> inline auto reduce(V a, F pair) {
  if constexpr (width<V> == 1)
    return a;
  else if constexpr (width<V> == 2)
    return pair(a[0], a[1]);
  else
    return reduce(pair(half<0>(a), half<width<V> / 2>(a)), pair);
}
template <class V> inline double sum(V a) {
  return reduce(a, [](auto p, auto q) { return p + q; });
}
template <class V> inline double least(V a) {
  return reduce(a, [](auto p, auto q) {
    if constexpr (width<decltype(p)> > 1)
      return min(p, q);
    else
      return min(Lanes<2>{p},
                 Lanes<2>{q})[0];  // scalars might become a branch, which trials mispredict
  });
}
template <class V> inline double largest(V a) {
  return reduce(a, [](auto p, auto q) { return max(p, q); });
}

template <int W> inline const Each<W>& sum(const Each<W>& a) { return a; }
template <int W> inline const Each<W>& least(const Each<W>& a) { return a; }
template <int W> inline const Each<W>& largest(const Each<W>& a) { return a; }
// The result of reducing a register over its contacts: one number, or one for each problem.
template <class V> using Reduced = std::remove_cvref_t<decltype(sum(V{}))>;

inline bool any(bool which) { return which; }
template <class M> inline bool any(const M& which) {
  return reduce(which, [](auto p, auto q) { return p | q; }) != 0;
}

// B registers of T, or as many as the contacts need if B = 0.
template <class T, int B> struct BlocksType {
  using type = std::array<T, B>;
};
template <class T> struct BlocksType<T, 0> {
  using type = std::vector<T>;
};
template <class T, int B> using Blocks = typename BlocksType<T, B>::type;

template <class Items> inline void resize(Items& items, std::size_t count) {
  if constexpr (requires { items.resize(count); }) items.resize(count);
}

}  // namespace grasp
