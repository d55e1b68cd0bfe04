// One solution as one row of numbers: what solvers write, single or in a batch.
#pragma once
#include <cstddef>
#include "linear6.hpp"

namespace grasp {

// How a solve ended.
// REFUSED: numbers that are not finite, or no start. LIMITS_EXCEEDED: no force keeps all limits; this one exceeds them least.
// UNDECIDED: neither a force nor a proof that there is none. RANK_LOST: contacts that cannot make wrenches of all directions.
enum Code { CONVERGED, LIMIT, STALLED, INFEASIBLE, REFUSED, LIMITS_EXCEEDED, UNDECIDED, RANK_LOST };

struct Summary {
    double code = REFUSED;   // a `Code`
    double iterations = 0;   // accepted steps
    double trials = 0;       // all steps tried
    double objective = 0;    // Phi, or the sum of the normal forces [N]; where limits are exceeded, the excess
    double lower_bound = 0;  // no balanced force has a smaller objective; -inf: none
    double residual = 0;     // largest |component| of G f + w in the unit frame [N]
    double margin = 0;       // least distance to a cone's surface [N]
    double limit_excess = 0;  // largest excess of a limit, as a part of it; 0 within
    Vec6 wrench{};       // what is balanced [N, N m]
    Vec6 multipliers{};  // nu of balance: grad objective = G^T nu (+ the cones' multipliers)
};

// A row: the summary, then force (N, 3), initial force (N, 3) [N], torsion (N,) [N m].
constexpr int record_size(int count) { return int(sizeof(Summary) / sizeof(double)) + 7 * count; }

class Record {
public:
    Record(double* row, int count) : row_(row), count_(count) {}
    Code code() const { return Code(int(summary().code)); }
    Summary& summary() const { return *reinterpret_cast<Summary*>(row_); }
    double* force() const { return row_ + sizeof(Summary) / sizeof(double); }
    double* initial_force() const { return force() + 3 * count_; }
    double* torsion() const { return force() + 6 * count_; }
    void clear() const { std::fill(row_, row_ + record_size(count_), 0.0); }
    // INFEASIBLE: no force, and the twist that proves it in place of the multipliers. missed: the wrench, unit frame [N]
    Code refute(const Vec6& twist, double missed) const {
        Summary& s = summary();
        s.code = INFEASIBLE, s.objective = s.lower_bound = infinity, s.margin = s.limit_excess = 0.0, s.residual = missed;
        s.multipliers = twist;
        std::fill(force(), row_ + record_size(count_), 0.0);
        return INFEASIBLE;
    }

private:
    double* row_;
    int count_;
};

}  // namespace grasp
