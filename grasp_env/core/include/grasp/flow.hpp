// The paper's gradient flow, x_{k+1} = x_k + alpha_k d_k (Eqs. 12, 26): every x_k balanced and strictly inside the cones, Phi falling.
#pragma once
#include "newton.hpp"
#include "projection.hpp"

namespace grasp {

// alpha_k, as data; see `step_size.py`.
struct StepRule {
    enum Kind { FIXED, ARMIJO, ADAPTIVE, BARZILAI_BORWEIN, EXACT };
    static constexpr double ALTERNATE = 0.0, LONG_ONLY = 1.0;  // BARZILAI_BORWEIN has its variant in `grow`; else the short one
    int kind = ADAPTIVE;
    double first = 0.3;     // first trial step [N / omega]
    double grow = 1.5;      // factor after an accepted step
    double shrink = 0.5;    // after a rejected one
    double decrease = 0.0;  // share of alpha |d|^2 by which Phi has to fall; of EXACT: of the slope that may be left
};

template <class V, int B> class FlowOn {
public:
    using Field = typename Cones<V, B>::Field;
    StepRule rule;

    FlowOn(const Cones<V, B>& cones, const StepRule& rule, Form form)
        : rule(rule), projection_(cones, form), next_(cones.field()), gradient_(cones.field()), there_(cones.field()),
          step_(cones.field()), past_(cones.field()) {}

    // The contacts of now; false where G has lost rank.
    bool place(const Cones<V, B>& cones) { return projection_.place(cones); }

    // The step at x made so many times; returns its last number.
    double repeat(const Cones<V, B>& cones, Field& x, int times) {
        for (int b = 0; b < int(x.size()); ++b) gradient_[b] = gradient(x[b], cones.blocks[b].weights);
        for (int k = 0; k < times; ++k) {
            projection_.apply(cones, x, gradient_, step_);
            const V little = all<V>(1e-30) * step_[0].u;  // one after the other
            x[0].u += little, gradient_[0].u += little;
        }
        return get(step_[0].u, 0);
    }

    // From the start in on.x, which is balanced and strictly inside, to the record.
    Code descend(NewtonOn<V, B>& on, const Call& call, const Vec6& w, const Record& record) {
        const auto& cones = on.cones;
        const int blocks = int(cones.blocks.size());
        const double tolerance = on.options.tolerance;
        const bool known = call.optimum == call.optimum;
        cones.store_force(on.x, record.initial_force());
        // in registers where their number is fixed
        Local x = on.x, next = next_, gradient = gradient_, there = there_, step = step_, past = past_;
        for (int b = 0; b < blocks; ++b) step[b] = past[b] = {V{}, V{}, V{}};
        // Phi at x + alpha step, which goes to `next`, its gradient to `there`; +inf outside
        const auto evaluate = [&](double alpha) {
            V total{}, room = all<V>(infinity);
            for (int b = 0; b < blocks; ++b) {
                const auto& c = cones.blocks[b];
                const Vec3<V> at = next[b] = x[b] + all<V>(alpha) * step[b];
                total += c.mask * phi(at, c.weights, there[b]);
                room = min(room, min(at.u, lorentz(at, at)));
            }
            const double value = sum(total);
            return least(room) > 0.0 && value == value ? value : infinity;
        };
        const auto slope = [&] { return total_of([&](int b) { return dot(there[b], step[b]); }); };  // at `next`
        const auto bend = [&] {
            return total_of([&](int b) { return cones.blocks[b].mask * curvature(next[b], step[b], cones.blocks[b].weights); });
        };
        double value = evaluate(0.0);
        if (!(value < infinity)) return REFUSED;
        double bound = known ? call.optimum : -infinity, alpha = rule.first, before = 0.0, gained = 0.0;
        Watch watch{tolerance};
        Vec6 nu{};
        int iterations = 0, trials = 0;
        Code code = LIMIT;
        const auto certified = [&] { return bound > 0.0 && value - bound <= tolerance * bound; };
        const auto certify = [&] {
            on.x = x;
            Vec6 found;
            const double lower = bound_at(on, w, found);
            if (lower >= bound) bound = lower, nu = found;
            watch.looked(iterations, value, bound);
        };
        for (;; ++iterations) {
            for (int b = 0; b < blocks; ++b) x[b] = next[b], gradient[b] = there[b];
            if (iterations < call.traced) call.trace[iterations] = value;
            if (!known && (watch.due(iterations, value, gained) || iterations >= on.options.limit)) certify();
            if (certified()) {
                code = CONVERGED;
                break;
            }
            if (iterations >= on.options.limit) break;
            projection_.apply(cones, x, gradient, step);
            const double length = total_of([&](int b) { return squared(step[b]); });  // |d|^2
            const double reach = total_of([&](int b) { return cones.blocks[b].mask * squared(x[b]); });
            if (rule.kind == StepRule::BARZILAI_BORWEIN) {
                const double mixed = total_of([&](int b) { return inner(step[b], past[b]); });
                if (iterations > 0) alpha *= inverse_curvature(before, length, mixed, iterations);
                for (int b = 0; b < blocks; ++b) past[b] = step[b];
                before = length;
            } else if (rule.kind == StepRule::EXACT) {
                const double here = bend();
                alpha = here > 0.0 ? length / here : rule.first;
            } else if (rule.kind == StepRule::ADAPTIVE) {
                if (iterations > 0) alpha *= rule.grow;
            } else {
                alpha = rule.first;
            }
            alpha = std::min(alpha, LONGEST);
            // a step far shorter than x, left from a start near the apex, grows from here instead of stalling
            if (alpha * alpha * length < SHORTEST * SHORTEST * reach && length > 0.0) alpha = SHORTEST * std::sqrt(reach / length);
            double trial = infinity, decrease = 0.0;
            if (rule.kind == StepRule::EXACT) trial = search(evaluate, slope, bend, rule.decrease * length, alpha, trials);
            if (rule.kind == StepRule::ARMIJO) decrease = rule.decrease * length;
            bool accepted = trial < value;
            for (int tried = 0; !accepted && alpha * alpha * length > ROUNDED * ROUNDED * reach; ++tried) {
                ++trials;
                trial = evaluate(alpha);
                accepted = trial < value && trial <= value - decrease * alpha;
                if (!accepted) alpha *= tried < PATIENCE ? rule.shrink : std::min(rule.shrink, 0.5);
            }
            if (!accepted) {
                if (!known) certify();
                code = certified() ? CONVERGED : STALLED;
                break;
            }
            gained = value - trial, value = trial;
        }
        on.x = x;
        if (known) bound_at(on, w, nu);
        Summary& s = record.summary();
        s.iterations = iterations, s.trials = trials, s.objective = value, s.lower_bound = bound;
        s.limit_excess = 0.0, s.multipliers = cones.unit.pull_back(nu);
        std::copy(call.wrench, call.wrench + 6, s.wrench.begin());
        std::fill(record.torsion(), record.torsion() + cones.count, 0.0);
        return finish(on, w, code, known, record);
    }

private:
    using Local = std::conditional_t<B == 0, Field&, Field>;
    static constexpr double SHORTEST = 1e-10;  // the first trial of an iteration moves x by at least this part of its length
    static constexpr double ROUNDED = 1e-16;   // and none by less than this
    static constexpr double LONGEST = 1e300;
    static constexpr double FLAT = 1e-12, LEAP = 10.0;  // where <s, y> is below this share of <s, s> / alpha Phi is straight to rounding
    static constexpr int SEARCHES = 60;   // trials of a search for the exact minimum, before it settles for any decrease
    static constexpr int PATIENCE = 100;  // trials of an iteration after which steps are halved at least, so that they end
    Projection<V, B> projection_;
    Field next_, gradient_, there_, step_, past_;

    // When to compute the bound, which costs as much as several iterations: not while steps gain more than what may be left, and once one
    // is close, where the next will do. A bound falls short of min Phi by up to SHORT times the square of the gap, in parts of it.
    struct Watch {
        double enough;            // relative gap that is asked for
        int next = 0;             // iteration at which to look in any case
        double goal = -infinity;  // Phi at which to look

        bool due(int iterations, double value, double gained) const {
            return (iterations >= next || value <= goal) && gained <= enough * value;
        }
        void looked(int iterations, double value, double bound) {
            const double gap = value - bound;
            const bool close = bound > 0.0 && gap < CLOSE * bound;
            next = iterations + std::max(1, iterations / (close ? 2 : 8));
            goal = close ? bound + enough * bound + std::min(0.5, SHORT * gap / bound) * gap : -infinity;
        }
        static constexpr double CLOSE = 1e-2, SHORT = 300.0;
    };

    template <class F> double total_of(F&& part) const {
        V total{};
        for (int b = 0; b < int(step_.size()); ++b) total += part(b);
        return sum(total);
    }

    // Lower bound of min Phi from the Newton multipliers at on.x; -inf: none.
    [[gnu::noinline]] static double bound_at(NewtonOn<V, B>& on, const Vec6& w, Vec6& nu) {
        nu = {};
        if (!on.system.assemble(on.cones, on.x)) return -infinity;
        nu = on.system.multipliers(on.system.made + w);
        return on.cones.lower_bound(nu, w);
    }

    // Barzilai and Borwein (1988) in the metric of P, over alpha: with s the step before and y the change of the projected gradient,
    // <s, s> / <s, y> or <s, y> / <y, y>.
    double inverse_curvature(double before, double now, double mixed, int iterations) const {
        const double s_y = before - mixed, y_y = (before - mixed) + (now - mixed);
        if (!(s_y > FLAT * before && y_y > 0.0)) return LEAP;
        const bool alternate = rule.grow == StepRule::ALTERNATE, only = rule.grow == StepRule::LONG_ONLY;
        return only || (alternate && iterations % 2 == 0) ? before / s_y : s_y / y_y;
    }

    // Phi where its slope is at most `enough`, along alpha: Newton on the slope, kept in a bracket; inf: not found.
    template <class Evaluate, class Slope, class Bend>
    double search(Evaluate&& evaluate, Slope&& slope, Bend&& bend, double enough, double& alpha, int& trials) const {
        double low = 0.0, high = infinity;
        for (int k = 0; k < SEARCHES; ++k) {
            ++trials;
            const double trial = evaluate(alpha), down = slope();
            double guess = -1.0;
            if (trial < infinity) {
                if (std::abs(down) <= enough) return trial;
                guess = alpha - down / bend();
            }
            (trial < infinity && down < 0.0 ? low : high) = alpha;
            if (!(low < guess && guess < high)) guess = high < infinity ? 0.5 * (low + high) : 2.0 * alpha;
            alpha = guess;
        }
        return infinity;
    }

    // What rounding left of balance, and the certificates: CONVERGED only where the force itself keeps what that says.
    Code finish(NewtonOn<V, B>& on, const Vec6& w, Code code, bool known, const Record& record) {
        const auto& cones = on.cones;
        Summary& s = record.summary();
        if (s.iterations > 0.0) {
            next_ = on.x;
            cones.balance(on.x, w);
            if (!(cones.phi(on.x) < infinity)) on.x = next_;
        }
        cones.certify(on.x, w, record);
        const double reached = cones.phi(on.x);
        const bool honest = std::abs(reached - s.objective) <= HONEST * s.objective;
        if (!honest) s.objective = reached;
        const bool below = !known && s.objective - s.lower_bound < -HONEST * s.lower_bound;  // its bound: it misses balance
        const bool near = s.objective - s.lower_bound <= on.options.tolerance * s.lower_bound;
        if (code == CONVERGED && !(near && !below && cones.balanced(on.x, w, s.residual) && s.margin > 0.0)) code = STALLED;
        s.code = code;
        return code;
    }
    static constexpr double HONEST = 1e-9;  // part by which Phi may be off through rounding
};

}  // namespace grasp
