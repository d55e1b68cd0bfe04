// What `ForceOptimizer` is made of and asked.
#pragma once
#include <memory>
#include <optional>
#include <grasp/general/constraints.hpp>
#include <grasp/flow/flow.hpp>
#include <grasp/terms/force_limits.hpp>
#include <grasp/learned/learned.hpp>

namespace grasp {

using Wrench = std::span<const double, 6>;  // external, on the object: force [N], moment [N m]
using Doubles = std::span<const double>;

enum class Method {
    newton,        // Phi by Newton: about six steps
    reduced_flow,  // Phi by the paper's gradient flow, in its fewest products
    full_flow,     // the same as printed, dense: up to FULL_CONTACTS contacts
    conic,         // the least sum or maximum of the normal forces, exactly on the cones where that is least
};

// Contacts with the weights of Phi, and limits besides friction. Positions, normals, wrenches and the Jacobian are given in ONE frame
// of the caller's choice.
struct Problem {
    Contacts contacts;
    ForceLimits limits{};  // jacobian: (N, 3, J), or (N, 6, J) with the angular velocities of the fingertips
};

struct Options {
    Method method = Method::newton;
    Criterion criterion = Criterion::sum;  // of conic: of the normal forces
    Start start = Start::standard;
    double tolerance = 0.0;  // relative certified gap, at most 1; 0: 1e-4, of conic 1e-6
    int limit = 20000;       // most accepted steps
    bool elastic = false;    // where no force keeps the limits: the one that exceeds them least, instead of the proof
    StepRule step_rule{};    // of the flows
    std::shared_ptr<const Model> model{};  // of Start::learned; none: that is replaced

    double gap() const { return tolerance > 0.0 ? tolerance : method == Method::conic ? 1e-6 : 1e-4; }
};

// What a call, or an update, has of its own; what is left empty stays as in the problem.
struct Now {
    Doubles positions{}, normals{};  // (N, 3) [m], inward unit normals
    Doubles friction{};              // one coefficient, N, or two of each
    Doubles jacobian{};              // as of the limits
    Doubles torque_bias{};           // (J,) [N m]
    std::uint64_t contacts = ~std::uint64_t(0);  // bit i: contact i touches; of solvers for up to 64 contacts

    bool empty() const {
        return positions.empty() && normals.empty() && friction.empty() && jacobian.empty() && torque_bias.empty() &&
               contacts == ~std::uint64_t(0);
    }
};

// One call: what to balance, what is different now, where to begin.
struct Ask {
    const double* wrench;
    Now now{};
    Start start = Start::standard;
    Doubles force{}, torsion{};  // of Start::given, guess and previous: (N, 3) [N] and (N,) [N m], current contact frames
    const double* previous = nullptr;  // of Start::previous, before `force`: the row of another solution of as many contacts
    double optimum = std::numeric_limits<double>::quiet_NaN();  // a known min Phi to take the gap to, instead of the bound
    std::span<double> trace{};  // receives Phi of the first iterates
    Doubles adjustment{};  // (N, 3) [N], the frame of the positions: added to the start, which is then brought inside the cones
};

}  // namespace grasp
