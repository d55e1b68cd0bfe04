// Problems on many grasps: each is placed, gets its own basis or internal force, and solves the wrenches that are its own.
#pragma once
#include "basis.hpp"
#include "dispatch.hpp"
#include "problems.hpp"

namespace grasp {

// Hard contacts of U grasps, N each; problems first[u] to first[u + 1] - 1 are those of grasp u.
struct Grasps {
    int contacts;
    std::ptrdiff_t count;
    const double *positions, *normals;  // (U, N, 3) [m], unit length, object frame
    const double *scales, *tangents;  // (U, N, 3) as `Contacts` takes them
    const double* weights;  // (N, 2) omega, lambda
    const double* first;  // (U + 1,)

    // f(contacts, problems) for each; where there is no such grasp the records say REFUSED.
    template <class F> void each(const Many& many, F&& f) const {
        const std::ptrdiff_t size = 3 * contacts;
        for (std::ptrdiff_t u = 0; u < count; ++u) {
            const auto from = std::ptrdiff_t(first[u]), until = std::ptrdiff_t(first[u + 1]);
            const Many part{until - from, many.wrench(from), many.rows + record_size(contacts) * from};
            Contacts placed(contacts, scales + size * u, weights, tangents + size * u);
            const bool good = placed.place(positions + size * u, normals + size * u) == Placing::good;
            if (!good || !f(placed, part))
                for (std::ptrdiff_t k = 0; k < part.count; ++k) part.record(k, contacts).summary().code = REFUSED;
        }
    }
};

// Newton from the 12-basis of each grasp. REFUSED: no force closure in floating point.
inline void newton_grasps(const Grasps& grasps, const Stop& options, const Many& many) {
    dispatch(grasps.contacts, [&]<class V, int B>() {
        NewtonOn<V, B> one(grasps.contacts, options);
        grasps.each(many, [&](const Contacts& contacts, const Many& part) {
            one.cones.pack(contacts);
            if (!one.internal_force() || !(make_basis(one, false) < ACCEPTED_GAP)) return false;
            newton_many(one, part);
            return true;
        });
    });
}

// The least sum of normal forces.
inline void conic_grasps(const Grasps& grasps, const Stop& options, const Many& many) {
    dispatch(grasps.contacts, [&]<class V, int B>() {
        NewtonOn<V, B> newton(grasps.contacts, options);
        ConicOn<V, B> one(grasps.contacts, options);
        grasps.each(many, [&](const Contacts& contacts, const Many& part) {
            newton.cones.pack(contacts), one.cones.pack(contacts);
            if (!newton.internal_force()) return false;
            one.rest = newton.x;
            conic_many(one, part);
            return true;
        });
    });
}

}  // namespace grasp
