// The offline part: the optima of Phi for the 12 unit wrenches, and for none (paper, Sec. III).
#pragma once
#include "newton.hpp"

namespace grasp {

inline constexpr double BASIS_TOLERANCE = 1e-10;
inline constexpr int BASIS_ITERATIONS = 200;
// Basis forces are starts: where floating point ends before 1e-10 (tiny lambda), one within a hundredth still serves.
inline constexpr double ACCEPTED_GAP = 1e-2;

// The k >= 0 with point + k ray inside the cone: from `low` to `high`; none where low >= high.
struct Interval { double low, high; };
inline Interval inside(const Vec3<double>& point, const Vec3<double>& ray) {
    // q(k) = a k^2 + 2 b k + c > 0 and u(k) > 0; {q > 0, u > 0} is convex: one interval
    const double a = lorentz(ray, ray), b = lorentz(point, ray), c = lorentz(point, point);
    const double discriminant = b * b - a * c;
    const Interval none{0.0, -1.0};
    if (!(std::abs(a) + std::abs(b) + std::abs(c) < infinity)) return none;
    if (a > 0.0) {  // the ray ends inside one of the two opposite cones, so b^2 >= a c but for rounding
        const double root = std::sqrt(std::max(discriminant, 0.0));
        double near = 0.0, far = 0.0;
        if (b > 0.0) near = -(root + b) / a, far = -c / (root + b);
        else if (root - b > 0.0) near = c / (root - b), far = (root - b) / a;
        return ray.u > 0.0 ? Interval{std::max(far, 0.0), infinity} : Interval{0.0, near};
    }
    if (a < 0.0) {
        if (!(discriminant > 0.0)) return none;
        const double root = std::sqrt(discriminant), q = b >= 0.0 ? -(b + root) : root - b;
        const double first = q / a, second = c / q, one = std::min(first, second), two = std::max(first, second);
        return point.u + 0.5 * (one + two) * ray.u > 0.0 ? Interval{std::max(one, 0.0), two} : none;
    }
    if (b > 0.0) return ray.u > 0.0 ? Interval{std::max(-c / (2.0 * b), 0.0), infinity} : none;  // along the cone's surface
    if (b < 0.0) return ray.u < 0.0 ? Interval{0.0, -c / (2.0 * b)} : none;
    return c > 0.0 && point.u > 0.0 ? Interval{0.0, infinity} : none;
}

template <class V, int B> inline Interval inside(const Cones<V, B>& cones, const typename Cones<V, B>::Field& point,
                                                 const typename Cones<V, B>::Field& ray) {
    Interval found{0.0, infinity};
    for (int i = 0; i < cones.count; ++i) {
        Vec3<double> p, r;
        for (int a = 0; a < 3; ++a)
            p[a] = get(point[i / width<V>][a], i % width<V>), r[a] = get(ray[i / width<V>][a], i % width<V>);
        const Interval one = inside(p, r);
        found = {std::max(found.low, one.low), std::min(found.high, one.high)};
    }
    return found;
}

// Fills the basis of `newton` for its contacts; returns the worst relative gap, inf: failed.
// warm: the basis holds the optima of nearby contacts to start from; else newton.x is an internal force strictly inside.
template <class V, int B> double make_basis(NewtonOn<V, B>& newton, bool warm) {
    const auto& cones = newton.cones;
    auto& starter = newton.starter;
    auto& basis = starter.basis;
    auto& x = newton.x;
    const Record record(newton.row.data(), cones.count);
    const Options kept = newton.options;
    newton.options = {BASIS_TOLERANCE, BASIS_ITERATIONS};
    double worst = 0.0;
    for (int k = 12; k >= 0 && worst < infinity; --k) {  // rest (12) first: the others start from it
        double wrench[6] = {};
        if (k < 12) wrench[k % 6] = k < 6 ? 1.0 : -1.0;
        const Vec6 w = cones.unit.of(wrench);
        bool started = false;
        if (warm) {  // twice: the second correction takes the rounding of the first out of the balance
            x = basis[k];
            started = starter.tangent(cones, newton.system, w, x) && cones.phi(x) < infinity &&
                      starter.tangent(cones, newton.system, w, x) && cones.phi(x) < infinity;
        }
        if (!started && warm && k == 12) {
            worst = infinity;
        } else if (!started && k == 12) {
            const double scale = squeeze(cones, x);
            for (auto& v : x) v = all<V>(scale) * v;
        } else if (!started) {
            for (auto& v : x) v = {V{}, V{}, V{}};
            cones.balance(x, w);
            const double least = std::max(1.1 * inside(cones, x, basis[12]).low, 1.0);
            for (int b = 0; b < int(x.size()); ++b) x[b] += all<V>(least) * basis[12][b];
        }
        const Call call{.wrench = wrench, .start = Start::given};
        if (worst == infinity || !(cones.phi(x) < infinity)) {
            worst = infinity;
            break;
        }
        newton.descend_from(starter.safe() = x, call, w, record, LONG);
        newton.polish(w);
        cones.balance(x, w);
        basis[k] = x;
        const Summary& s = record.summary();
        worst = s.lower_bound > 0.0 ? std::max(worst, (s.objective - s.lower_bound) / s.lower_bound) : infinity;
    }
    newton.options = kept;
    starter.has_basis = worst < ACCEPTED_GAP, starter.moved = false;
    return worst;
}

// k > 0 of least Phi(k x) for x strictly inside: Phi(k x) = k a + b / k.
template <class V, int B> double squeeze(const Cones<V, B>& cones, const typename Cones<V, B>::Field& x) {
    V force{}, barrier{};
    for (int b = 0; b < int(x.size()); ++b) {
        const auto& c = cones.blocks[b];
        force += c.mask * phi(x[b], {c.weights.omega, V{}}), barrier += c.mask * phi(x[b], {V{}, c.weights.lambda});
    }
    return std::sqrt(sum(barrier) / sum(force));
}

}  // namespace grasp
