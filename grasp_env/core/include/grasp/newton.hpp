// Damped Newton on Phi under balance; linear in the number of contacts.
#pragma once
#include "start.hpp"

namespace grasp {

// Parts of the way to the boundary that a step goes at most: with the shorter one it takes a fifth fewer steps.
inline constexpr double SHORT = 0.7, LONG = 0.95;

struct Options {
    double tolerance = 1e-4;  // relative certified gap
    int limit = 20000;        // most accepted steps
};

// One problem: what to balance, where to begin, what to tell.
struct Call {
    const double* wrench;                                       // (6,) [N, N m]
    Start start = Start::combination;
    const double* force = nullptr;                              // (3N,) [N] unless `start` is the combination
    double optimum = std::numeric_limits<double>::quiet_NaN();  // a known min Phi to take the gap to, instead of the bound
    double* trace = nullptr;                                    // receives Phi of iterates 0 .. traced - 1
    int traced = 0;
};

inline bool sane_wrench(const double* wrench) {
    for (int r = 0; r < 6; ++r)
        if (!(std::abs(wrench[r]) <= LARGEST)) return false;
    return true;
}

template <class V, int B> class NewtonOn {
public:
    using Field = typename Cones<V, B>::Field;
    Options options;
    Cones<V, B> cones;
    System<V, B> system;
    Starter<V, B> starter;
    Field x;  // the start, then the iterate
    std::vector<double> row;  // a record to work with

    NewtonOn(int count, const Options& options)
        : options(options), cones(count), system(cones), starter(cones), x(cones.field()),
          row(record_size(count)), step_(cones.field()), begun_(cones.field()) {}

    // Start, descent, certificates. REFUSED: numbers that are not finite, or no start that is balanced and strictly inside.
    Code solve(const Call& call, const Record& record) {
        record.summary().code = REFUSED;
        if (!sane_wrench(call.wrench)) return REFUSED;
        const Vec6 w = cones.unit.of(call.wrench);
        if (!begin(call, w)) return REFUSED;
        begun_ = x;
        return descend_from(begun_, call, w, record);
    }

    // From the start in x, of which `begun` is a copy: with steps that reach `first` of the way to the boundary, and where forces at very
    // different depths stall those, with the others.
    Code descend_from(const Field& begun, const Call& call, const Vec6& w, const Record& record, double first = SHORT) {
        Code code = descend(call, w, record, first);
        if (code != STALLED) return code;
        const double tried = record.summary().trials;
        x = begun;
        code = descend(call, w, record, SHORT + LONG - first);
        record.summary().trials += tried;
        return code;
    }

    // The start of a call, in x.
    bool begin(const Call& call, const Vec6& w) {
        if (call.start == Start::given) {
            cones.load_force(call.force, x);
            return is_start(w);
        }
        if (!starter.has_basis) return false;
        if (call.start == Start::combination) return starter.combination(cones, system, call.wrench, w, x);
        if (!starter.combination(cones, system, call.wrench, w, starter.safe())) return false;
        cones.load_force(call.force, x);
        starter.carry(cones, system, starter.safe(), w, call.start, x);
        return true;
    }

    // From the start in x, which is balanced and strictly inside, to the record.
    // fraction: of the way to the boundary that a step goes at most.
    Code descend(const Call& call, const Vec6& w, const Record& record, double fraction) {
        cones.store_force(x, record.initial_force());
        const bool known = call.optimum == call.optimum;
        const double tolerance = options.tolerance, tight = std::min(1e-2, 0.1 * std::sqrt(std::sqrt(tolerance)));
        double value = cones.phi(x);
        if (!(value < infinity)) return REFUSED;
        double bound = known ? call.optimum : -infinity;
        int iterations = 0, trials = 0;
        Code code = STALLED;
        Vec6 nu{};
        // far below its bound is a force that misses balance: steps restore it
        const auto certified = [&] {
            return bound > 0.0 && value - bound <= tolerance * bound && (known || value - bound >= BELOW * bound);
        };
        for (;; ++iterations) {
            if (iterations < call.traced) call.trace[iterations] = value;
            if (!system.assemble(cones, x)) break;
            const Vec6 left = system.made + w;
            nu = system.multipliers(left);
            const auto [decrement, reach] = find_step(nu, left, value);
            // Phi - min Phi is half the squared decrement to third order: the bound costs a quarter of an iteration, so it waits
            if (!known && (decrement < 4.0 * tolerance * value || iterations >= options.limit))
                bound = std::max(bound, cones.lower_bound(nu, w));
            if (certified()) {
                code = CONVERGED;
                break;
            }
            if (iterations >= options.limit) {
                code = LIMIT;
                break;
            }
            double alpha = reach > 0.0 ? std::min(1.0, fraction / reach) : 1.0;
            if (!search(value, decrement, alpha, trials)) {
                if (!known) bound = std::max(bound, cones.lower_bound(nu, w));
                code = certified() ? CONVERGED : STALLED;
                break;
            }
            for (int b = 0; b < int(x.size()); ++b) x[b] += all<V>(alpha) * step_[b];
            // the multipliers belong to where the step went: where it was a small whole one, they certify that without a system
            if (alpha == 1.0 && decrement < std::sqrt(tolerance) * value) {
                if (!known) bound = std::max(bound, cones.lower_bound(nu, w, x, tight));
                if (certified()) {
                    if (++iterations < call.traced) call.trace[iterations] = value;
                    code = CONVERGED;
                    break;
                }
            }
        }
        if (iterations > 0) cones.balance(x, w);  // what rounding left of G x + w
        Summary& s = record.summary();
        s.code = code, s.iterations = iterations, s.trials = trials, s.objective = value, s.lower_bound = bound;
        s.reserved = 0.0, s.multipliers = cones.unit.pull_back(nu);
        std::copy(call.wrench, call.wrench + 6, s.wrench.begin());
        std::fill(record.torsion(), record.torsion() + cones.count, 0.0);
        cones.certify(x, w, record);
        return code;
    }

    // The Newton step at x into `out`, its multipliers in the unit frame, and its squared decrement; negative: S lost definiteness.
    double newton_step(const Vec6& w, Field& out, Vec6& nu) {
        if (!system.assemble(cones, x)) return -1.0;
        const Vec6 left = system.made + w;
        nu = system.multipliers(left);
        const double decrement = find_step(nu, left, cones.phi(x)).decrement;
        out = step_;
        return decrement;
    }

    // One more whole step from a converged x, where it does not raise Phi: from the tolerance to the last digits.
    void polish(const Vec6& w) {
        if (!system.assemble(cones, x)) return;
        const Vec6 left = system.made + w;
        const double value = cones.phi(x);
        find_step(system.multipliers(left), left, value);
        if (cones.phi_along(x, step_, 1.0) <= value)
            for (int b = 0; b < int(x.size()); ++b) x[b] += step_[b];
    }

    // An internal force strictly inside the cones, in x: infeasible-start Newton from the axes; false without force closure.
    bool internal_force() {
        for (int b = 0; b < int(x.size()); ++b)
            x[b] = {sqrt(cones.blocks[b].weights.lambda / cones.blocks[b].weights.omega), V{}, V{}};
        for (int iteration = 0; iteration < 200; ++iteration) {
            if (!system.assemble(cones, x) || !(cones.largest_normal(x) < LARGEST)) return false;
            const double force = cones.largest_normal(x);
            system.direction(cones, system.multipliers(system.made), step_);
            if (size(system.made) < 1e-9 * force && cones.largest_normal(step_) < 1e-2 * force) {
                cones.balance(x, Vec6{});
                return cones.phi(x) < infinity;
            }
            const double reach = cones.reach(x, step_), alpha = reach > 0.0 ? std::min(1.0, 0.9 / reach) : 1.0;
            for (int b = 0; b < int(x.size()); ++b) x[b] += all<V>(alpha) * step_[b];
        }
        return false;
    }

private:
    static constexpr int REFINEMENTS = 3, HALVINGS = 60;
    static constexpr double BALANCED = 1e-13;  // a step that misses balance by less than this part of Phi needs no refinement
    static constexpr double SHORTEST = 1e-10;  // a step moves x by at least this part of its length
    static constexpr double BELOW = -1e-9;     // rounding by which Phi may fall short of its bound
    static constexpr double MISSED = 1e-8;     // part of wrench and force by which a given start may miss balance
    Field step_, begun_;

    struct Direction { double decrement, reach; };  // squared Newton decrement, 1 / (largest step inside the cones)

    // Forces at very different depths in their cones make S ill-conditioned: what the step misses of balance is taken off, in the metric
    // of Phi while it is large (a few digits a time), then by the least change.
    Direction find_step(const Vec6& nu, const Vec6& left, double value) {
        Vec6 missed = left + system.direction(cones, nu, step_);
        for (int round = 0; round < REFINEMENTS && size(missed) > BALANCED * value; ++round)
            missed = left + system.restore(cones, missed, step_);
        V decrement{}, reach{};
        for (int b = 0; b < int(x.size()); ++b) {
            const auto& c = cones.blocks[b];
            step_[b] -= c.least(missed);
            decrement -= dot(step_[b], system.gradient[b]);
            reach = max(reach, Boundary<V>(x[b]).per(step_[b]));
        }
        return {sum(decrement), largest(reach)};
    }

    // Halves alpha until Phi falls; false where no step that moves x does.
    bool search(double& value, double decrement, double& alpha, int& trials) {
        for (int halving = 0; halving < HALVINGS; ++halving, alpha *= 0.5) {
            ++trials;
            const double found = cones.phi_along(x, step_, alpha);
            const bool falls = found < value - 1e-4 * alpha * decrement, flat = decrement < 1e-9 * value;
            if (falls || (flat && found <= value)) {
                // far from the optimum steps are as long as Phi is straight: what counts is how far x moves
                const bool suspect = flat || halving > 0;
                if (suspect && !(alpha * cones.largest_normal(step_) > SHORTEST * cones.largest_normal(x))) return false;
                value = found;
                return true;
            }
        }
        return false;
    }

    bool is_start(const Vec6& w) const {
        if (!cones.sane(x) || !(cones.phi(x) < infinity)) return false;
        return size(cones.wrench(x) + w) <= MISSED * (cones.largest_normal(x) + size(w));
    }
};

}  // namespace grasp
