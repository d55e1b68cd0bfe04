// Internal forces strictly inside the cones, and the start for any wrench that one of them gives;
// for one problem or a register of them.
#pragma once
#include <grasp/phi/system.hpp>

namespace grasp {

// Largest k at which point + k ray crosses the cone or its opposite, for a ray inside one of the
// two.
template <class T, int D> inline T crossing(const Vec<T, D>& point, const Vec<T, D>& ray) {
  const T a = lorentz(ray, ray);
  const T b = lorentz(point, ray);
  const T c = lorentz(point, point);
  const T root = sqrt(max(b * b - a * c, T{}));  // b^2 >= a c up to rounding
  return select(b > 0.0, -c / (root + b), select(root - b > 0.0, (root - b) / a, T{}));
}

// The k >= 0 with point + k ray inside the cone lie between `low` and `high`; none if low >= high.
struct Interval {
  double low, high;
};
inline Interval inside(const Vec3<double>& point, const Vec3<double>& ray) {
  // q(k) = a k^2 + 2 b k + c > 0 and u(k) > 0; {q > 0, u > 0} is convex, so the solution is one
  // interval
  const double a = lorentz(ray, ray);
  const double b = lorentz(point, ray);
  const double c = lorentz(point, point);
  const double discriminant = b * b - a * c;
  const Interval none{0.0, -1.0};
  if (!(std::abs(a) + std::abs(b) + std::abs(c) < infinity)) return none;
  if (a > 0.0)
    return ray.u > 0.0 ? Interval{max(crossing(point, ray), 0.0), infinity}
                       : Interval{0.0, -crossing(point, -ray)};
  if (a < 0.0) {
    if (!(discriminant > 0.0)) return none;
    const double root = std::sqrt(discriminant);
    const double q = b >= 0.0 ? -(b + root) : root - b;
    const double first = q / a;
    const double second = c / q;
    const double one = std::min(first, second);
    const double two = std::max(first, second);
    return point.u + 0.5 * (one + two) * ray.u > 0.0 ? Interval{std::max(one, 0.0), two} : none;
  }
  if (b > 0.0)
    return ray.u > 0.0 ? Interval{std::max(-c / (2.0 * b), 0.0), infinity}
                       : none;  // parallel to the cone's surface
  if (b < 0.0) return ray.u < 0.0 ? Interval{0.0, -c / (2.0 * b)} : none;
  return c > 0.0 && point.u > 0.0 ? Interval{0.0, infinity} : none;
}

template <class V, int B> inline Interval inside(const Cones<V, B>& cones,
                                                 const typename Cones<V, B>::Field& point,
                                                 const typename Cones<V, B>::Field& ray) {
  Interval common{0.0, infinity};
  for (int i = 0; i < cones.count; ++i) {
    Vec3<double> p, r;
    for (int a = 0; a < 3; ++a) {
      p[a] = get(point[i / width<V>][a], i % width<V>);
      r[a] = get(ray[i / width<V>][a], i % width<V>);
    }
    const Interval one = inside(p, r);
    common = {std::max(common.low, one.low), std::min(common.high, one.high)};
  }
  return common;
}

// k > 0 that minimises Phi(k x) = k a + b / k, for x strictly inside.
template <class V, int B, int D>
Reduced<V> best_scale(const Cones<V, B, D>& cones, const Blocks<Vec<V, D>, B>& x) {
  V force{}, barrier{};
  for (int b = 0; b < int(x.size()); ++b) {
    const auto& c = cones.blocks[b];
    Weights<V, D> without_force = c.weights;
    without_force.omega = V{};
    force += c.mask * squeezing_cost(c.weights.omega) * x[b].u;
    barrier += c.mask * phi(x[b], without_force);
  }
  return sqrt(sum(barrier) / sum(force));
}

// Write the start for a wrench w (unit frame) into x: the least-norm force plus a multiple of
// `rest`, an internal force strictly inside: 1.1 times what brings it inside plus a half, and at
// least once.
template <class V, int B, int D>
void begin(const Cones<V, B, D>& cones, const typename Cones<V, B, D>::Field& rest,
           const Six<Reduced<V>>& w, typename Cones<V, B, D>::Field& x) {
  using S = Reduced<V>;
  V needed{};
  for (int b = 0; b < int(x.size()); ++b) {
    x[b] = -cones.blocks[b].least(w);
    needed = max(needed, crossing(x[b], rest[b]));
  }
  const V multiple = all<V>(max(S(1.0), 1.1 * largest(needed) + 0.5));
  for (int b = 0; b < int(x.size()); ++b) x[b] += multiple * rest[b];
}

// Copy `from` to `to`: everything, or the lanes of some problems.
template <class Field> inline void copy_where(bool which, const Field& from, Field& to) {
  if (which) to = from;
}
template <class Mask, class Field>
inline void copy_where(const Mask& which, const Field& from, Field& to) {
  for (int b = 0; b < int(to.size()); ++b) to[b] = select(which, from[b], to[b]);
}

inline constexpr int
    FEW_STEPS = 20,
    MANY_STEPS = 200;  // towards an internal force: 5 are typical, 11 suffice in 99 % of cases

// Find an internal force strictly inside the cones and store it in `rest`. Infeasible-start Newton
// from the axes, with at most `most` steps. Return true if one was found. find(missed): computes
// the step at x and the residual of balance; returns false if there is no step.
template <class V, int B, int D, class Field, class F>
auto balance_inside(const Cones<V, B, D>& cones, Field& x, const Field& step, Field& rest, int most,
                    F&& find) {
  using S = Reduced<V>;
  for (int b = 0; b < int(x.size()); ++b)
    x[b] = axis<D>(sqrt(cones.blocks[b].weights.lambda / cones.blocks[b].weights.omega));
  auto open = S(0.0) == S(0.0);
  auto done = S(0.0) != S(0.0);
  for (int iteration = 0; iteration < most; ++iteration) {
    const S force = cones.largest_normal(x);
    Six<S> missed{};
    open = open & (force < LARGEST) & find(missed);
    auto there = decltype(open)(open & (size(missed) < 1e-9 * force));
    if (any(there)) {
      there = there & (cones.largest_normal(step) < 1e-2 * force);
      copy_where(there, x, rest);
      done = done | there;
      open = open & !there;
    }
    if (!any(open)) break;
    const S reach = cones.reach(x, step);
    const S alpha = min(S(1.0), 0.9 / max(reach, S(1e-300)));
    for (int b = 0; b < int(x.size()); ++b) x[b] += all<V>(alpha) * step[b];
  }
  cones.balance(rest, Six<S>{});
  return done & (cones.phi(rest) < infinity);
}

}  // namespace grasp
