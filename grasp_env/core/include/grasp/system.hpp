// The linear system of Newton on Phi under balance: H is block diagonal, so a step is one 6 x 6 system G H^-1 G^T whatever N is.
#pragma once
#include "cones.hpp"

namespace grasp {

template <class V, int B> class System {
public:
    using Field = typename Cones<V, B>::Field;
    Field gradient;
    Blocks<Sym3<V>, B> inverse;  // H^-1
    Ldl6 schur;                  // S = G H^-1 G^T, factored
    Vec6 pull{}, made{};         // G H^-1 grad and G x

    explicit System(const Cones<V, B>& cones) : gradient(cones.field()) { resize(inverse, cones.blocks.size()); }

    // All of it at x; false where S is not positive definite in floating point.
    bool assemble(const Cones<V, B>& cones, const Field& x) {
        return assemble(cones, x, [](int, Vec3<V>&, Sym3<V>&) {});
    }
    // With other terms of the objective: more(b, gradient, inverse) adds those of block b.
    template <class F> bool assemble(const Cones<V, B>& cones, const Field& x, F&& more) {
        V s[21] = {}, q[6] = {}, l[6] = {};
        for (int b = 0; b < int(cones.blocks.size()); ++b) {
            const auto& c = cones.blocks[b];
            inverse[b] = inverse_hessian(x[b], c.weights);
            gradient[b] = c.mask * grasp::gradient(x[b], c.weights);  // so that unused lanes stay where they are
            more(b, gradient[b], inverse[b]);
            const Sym3<V> h = inverse[b];
            c.add_wrench(h * gradient[b], q), c.add_wrench(x[b], l);
#pragma GCC unroll 8
            for (int r = 0; r < 6; ++r) {
                const Vec3<V> hg = h * c.g[r];
#pragma GCC unroll 8
                for (int k = 0; k <= r; ++k) s[packed(r, k)] += dot(hg, c.g[k]);
            }
        }
        Packed6 lower;
#pragma GCC unroll 32
        for (int k = 0; k < 21; ++k) lower[k] = sum(s[k]);
        pull = sums(q), made = sums(l);
        return schur.factor(lower) > 0.0;
    }

    // Multipliers of the step from an x that misses balance by `left` = G x + w: S nu = G H^-1 grad - left.
    Vec6 multipliers(const Vec6& left) const { return schur.solve(pull - left); }

    // step = H^-1 (G^T nu - grad); returns G step
    Vec6 direction(const Cones<V, B>& cones, const Vec6& nu, Field& step) const {
        V moved[6] = {};
        for (int b = 0; b < int(cones.blocks.size()); ++b) {
            step[b] = inverse[b] * (cones.blocks[b].transposed(nu) - gradient[b]);
            cones.blocks[b].add_wrench(step[b], moved);
        }
        return sums(moved);
    }

    // x -= H^-1 G^T S^-1 missed: balance restored by the change that is least in the Hessian; returns G x
    Vec6 restore(const Cones<V, B>& cones, const Vec6& missed, Field& x) const {
        const Vec6 n = schur.solve(missed);
        V moved[6] = {};
        for (int b = 0; b < int(cones.blocks.size()); ++b) {
            x[b] -= inverse[b] * cones.blocks[b].transposed(n);
            cones.blocks[b].add_wrench(x[b], moved);
        }
        return sums(moved);
    }
};

}  // namespace grasp
