// The exact problem: the least sum of normal forces subject to balance and friction cones. Primal-dual interior point with
// Nesterov-Todd scaling and Mehrotra's corrector (Nesterov, Todd 1997; Mehrotra 1992; as in Vandenberghe 2010, "The CVXOPT linear
// and quadratic cone program solvers"). Every iterate is a valid grasp, and y scaled onto the boundary is a certified bound.
//
//     min sum_i c_i u_i  s.t.  G x = -w,  x_i in the cone u >= |(o, t)|
//     max -w . y  s.t.  s_i = c_i e_u - G_i^T y in the cone
//
// In these coordinates the scaling of a contact is eta (2 v v^T - J), v . J v = 1, so the 6 x 6 matrix of an iteration is the sum
// of eta (2 (G v)(G v)^T - G J G^T) with G J G^T constant. That sum loses digits close to losing force closure, or with contacts
// close together. If it stalls, the problem is solved again by least squares in the axes of the scalings, where no step is the
// difference of two large ones.
//
// This file holds one algorithm, with the steps that one problem and a register of problems share.
#pragma once
#include <grasp/phi/newton.hpp>
#include <grasp/math/qr6.hpp>

namespace grasp {

// M = eta (2 v v^T - J) takes s to x; its square root is sqrt(eta) * `scaled`.
template <class T> struct Scaling {
    Vec3<T> v;
    T eta, shrink, root;  // 1 / (1 + v_0), 1 / sqrt(s . J s)

    Scaling() = default;
    Scaling(const Vec3<T>& x, const Vec3<T>& s) {
        const T i = 1.0 / lorentz(s, s);
        eta = sqrt(lorentz(x, x) * i);
        const Vec3<T> z{x.u + eta * s.u, x.o - eta * s.o, x.t - eta * s.t};
        v = (1.0 / sqrt(lorentz(z, z))) * z;
        shrink = 1.0 / (1.0 + v.u);
        root = sqrt(i);
    }
    Vec3<T> scaled(const Vec3<T>& d) const {
        const T z = v.o * d.o + v.t * d.t, k = d.u + z * shrink;
        return {v.u * d.u + z, d.o + k * v.o, d.t + k * v.t};
    }
    Vec3<T> unscaled(const Vec3<T>& d) const {  // inverse of `scaled`
        const T z = v.o * d.o + v.t * d.t, k = z * shrink - d.u;
        return {v.u * d.u - z, d.o + k * v.o, d.t + k * v.t};
    }
    Vec3<T> times(const Vec3<T>& d) const {  // M d
        const T z = 2.0 * dot(v, d);
        return {eta * (z * v.u - d.u), eta * (z * v.o + d.o), eta * (z * v.t + d.t)};
    }
};

// The iterate and its steps, for one problem or a register of them.
template <class V, int B> class ConicSteps {
public:
    using S = Reduced<V>;
    using Field = typename Cones<V, B>::Field;
    struct At {
        Vec3<V> x, s;  // primal and dual slack
        Scaling<V> m;
        Vec3<V> l, d, q;  // scaled point, (scaled) dual direction, dx
        V share, l0;  // share of the `Boundary` at l; 1 / l_0
        Vec3<V> first;  // first x, for the record

        Boundary<V> boundary() const { return {l, m.root, share}; }  // l . J l = s . J s
    };
    Cones<V, B> cones;
    Field rest;  // an internal force strictly inside the cones, with which a start squeezes
    Blocks<At, B> at;
    S gap{}, price{};
    Six<S> y{};
    Ldl<S> schur;

    explicit ConicSteps(int count) : cones(count), rest(cones.field()) { resize(at, cones.blocks.size()); }
    int blocks() const { return int(at.size()); }

    // x = -G^+ w + k rest, with k larger than the triangle inequality requires; s = c
    void start(const Six<S>& minus) {
        V squeeze = all<V>(1e-6), cost{};
        for (int b = 0; b < blocks(); ++b) {
            at[b].x = cones.blocks[b].least(minus);
            squeeze = max(squeeze, -slack(at[b].x) / slack(rest[b]));
        }
        const V k = all<V>(1.3 * largest(squeeze));
        for (int b = 0; b < blocks(); ++b) {
            const auto& c = cones.blocks[b];
            at[b].x += k * rest[b];
            at[b].first = at[b].x;
            at[b].s = {c.cost, V{}, V{}};
            cost += c.mask * c.cost * at[b].x.u;
        }
        gap = price = sum(cost), y = {};
    }

    // S = sum eta (2 (G v)(G v)^T - G J G^T), factored; returns its smallest pivot
    [[gnu::always_inline]] S system() {
        V s[21] = {};
        for (int b = 0; b < blocks(); ++b) {
            const auto& c = cones.blocks[b];
            const auto& m = at[b].m = Scaling<V>(at[b].x, at[b].s);
            V g[6];
#pragma GCC unroll 8
            for (int r = 0; r < 6; ++r) g[r] = dot(c.g[r], m.v);
#pragma GCC unroll 8
            for (int r = 0; r < 6; ++r) {
                const V e = 2.0 * g[r];
#pragma GCC unroll 8
                for (int k = 0; k <= r; ++k) s[packed(r, k)] += m.eta * (e * g[k] - c.gjg[packed(r, k)]);
            }
        }
        Packed<S> lower;
#pragma GCC unroll 32
        for (int k = 0; k < 21; ++k) lower[k] = sum(s[k]);
        return schur.factor(lower);
    }

    // Take a step with Mehrotra's corrector. down: the predictor's dy (dx + M ds = -x, so that S dy = G x = -w). correct(pull): the
    // whole dy. Return true if the step moves anything; otherwise it is not taken. EXACT: `correct` leaves dx in q. least: smallest
    // fraction of the gap that centring keeps; 1 stays in the interior instead of heading for the optimum.
    template <bool EXACT, class F> [[gnu::always_inline]] auto step(const Six<S>& down, F&& correct, double least = 0.0) {
        const auto [primal, dual, cross, square] = predict(down);
        const S after = gap + dual * cross - primal * (gap + cross) - primal * dual * (cross + square);
        const S part = max(S(0.0), after) / gap, centring = max(min(part * part * part, S(1.0)), S(least));
        const S reach = 0.9 + (STEP - 0.9) * min(dual, primal);
        const Six<S> dy = correct(centre(centring * gap / (2.0 * cones.count)));
        const auto [longest_x, longest_s] = direct<EXACT>(dy, reach);
        const auto moves = longest_x + longest_s > 1e-6;
        if (!any(moves)) return moves;
        y = y + longest_s * dy;
        advance(longest_x, longest_s);
        return moves;
    }

    // The certified answer at the iterate x of a wrench of size 1: y scaled onto the boundary of its set by theta, and the force
    // [N] for a wrench of size `scale`. For any y the largest theta with c - theta G^T y in every cone is min c / (g_u + |g_t|), g
    // = G^T y, over the contacts where that is positive.
    struct Answer {
        S theta, price, bound;
        S gap() const { return select(bound > 0.0, (price - bound) / bound, S(infinity)); }
    };
    Answer answer(const Six<S>& minus, const S& scale, Field& force) {
        V before[6] = {}, steepest{}, squeeze{};
        for (int b = 0; b < blocks(); ++b) {
            const auto& c = cones.blocks[b];
            c.add_wrench(at[b].x, before);
            const Vec3<V> g = c.transposed(y);
            steepest = max(steepest, (g.u + sqrt(g.o * g.o + g.t * g.t)) / c.cost);
        }
        const S most = largest(steepest), theta = select(most > 0.0, 1.0 / most, S(1.0));
        const Six<S> left = sums(before) - minus;
        for (int b = 0; b < blocks(); ++b) {
            const auto& c = cones.blocks[b];
            auto& x = at[b].x;
            x -= c.least(left);
            const V outside = 1e-15 * x.u - slack(x);  // 1e-15 allows for the rounding of the next lines
            // restoring the last digits of balance may take x out of its cone; an internal force takes it back
            squeeze = max(squeeze, 1.1 * c.mask * outside / slack(rest[b]));
        }
        const V k = all<V>(largest(squeeze));
        for (int b = 0; b < blocks(); ++b) force[b] = all<V>(scale) * (at[b].x + k * rest[b]);
        return {theta, price_of(force), scale * max(theta * dot(minus, y), S(0.0))};
    }
    S price_of(const Field& force) const {  // sum of the normal forces [N]
        V price{};
        for (int b = 0; b < blocks(); ++b) price += cones.blocks[b].mask * cones.blocks[b].cost * force[b].u;
        return sum(price);
    }

private:
    static constexpr double STEP = 0.995;  // largest fraction of the way to the boundary

    // Longest steps of x and s along the predictor ds = -G^T dy, and the terms s . dx and ds . ds.
    struct Predicted { S primal, dual, cross, square; };
    Predicted predict(const Six<S>& dy) {
        V primal = all<V>(1.0), dual = all<V>(1.0), cross{}, square{};
        for (int b = 0; b < blocks(); ++b) {
            auto& here = at[b];
            const auto& m = here.m;
            const Vec3<V> l = here.l = m.scaled(here.s), e = here.d = m.scaled(-cones.blocks[b].transposed(dy));
            const V n = l.u * m.root + 1.0, both = 1.0 / (n * l.u);  // one division for two
            here.share = both * l.u, here.l0 = both * n;
            const auto way = here.boundary().way(e);
            dual = max(dual, way.away - way.along), primal = max(primal, 1.0 + way.away + way.along);
            const V part = cones.blocks[b].mask * m.eta;
            cross += part * dot(l, e), square += part * dot(e, e);
        }
        return {1.0 / largest(primal), 1.0 / largest(dual), sum(cross), sum(square)};
    }

    // d = scaled right-hand side with centring and second order, q its unscaled image; returns -G q
    [[gnu::always_inline]] Six<S> centre(const S& target) {
        V out[6] = {};
        for (int b = 0; b < blocks(); ++b) {
            auto& here = at[b];
            const auto& m = here.m;
            const Vec3<V>&l = here.l, e = here.d, f = l + e;
            const Vec3<V> r{target / m.eta + dot(f, e), f.u * e.o + e.u * f.o, f.u * e.t + e.u * f.t};
            const V h = lorentz(l, r) * m.root * m.root;
            // unused lanes do not move
            here.d = cones.blocks[b].mask * (Vec3<V>{h, (r.o - h * l.o) * here.l0, (r.t - h * l.t) * here.l0} - l);
            here.q = m.eta * m.scaled(here.d);
            cones.blocks[b].add_wrench(here.q, out);
        }
        return -1.0 * sums(out);
    }

    // d = ds, q = dx; returns the steps, `reach` of the way to the boundary of x and s
    struct Lengths { S primal, dual; };
    template <bool EXACT> [[gnu::always_inline]] Lengths direct(const Six<S>& dy, const S& reach) {
        V primal = all<V>(reach), dual = all<V>(reach);
        for (int b = 0; b < blocks(); ++b) {
            auto& here = at[b];
            const Vec3<V> d = -cones.blocks[b].transposed(dy);
            if constexpr (EXACT) {  // q is dx already
                dual = max(dual, Boundary<V>(here.s).per(d)), primal = max(primal, Boundary<V>(here.x).per(here.q));
            } else {
                const Vec3<V> e = here.m.scaled(d);
                const Boundary<V> edge = here.boundary();
                dual = max(dual, edge.per(e)), primal = max(primal, edge.per(here.d - e));
                here.q -= here.m.times(d);
            }
            here.d = d;
        }
        return {reach / largest(primal), reach / largest(dual)};
    }

    [[gnu::always_inline]] void advance(const S& primal, const S& dual) {
        V left{}, cost{};
        for (int b = 0; b < blocks(); ++b) {
            auto& here = at[b];
            const auto& c = cones.blocks[b];
            here.x += all<V>(primal) * here.q, here.s += all<V>(dual) * here.d;
            left += c.mask * dot(here.x, here.s), cost += c.mask * c.cost * here.x.u;
        }
        gap = sum(left), price = sum(cost);
    }
};

template <class V, int B> class ConicSolver : public ConicSteps<V, B> {
    using Steps = ConicSteps<V, B>;
    using typename Steps::At;

public:
    using Steps::cones, Steps::rest, Steps::at, Steps::y;
    using typename Steps::Field;
    Stop options;

    ConicSolver(int count, const Stop& options)
        : Steps(count), options(options), force_(cones.field()), first_(cones.field()), qr_(Steps::blocks()),
          fitted_(qr_.rows()) {}

    // A wrench of size 1, and its original size.
    struct UnitWrench {
        Vec6 unit, minus;
        double scale;
    };
    // Begin a record. Return false if the record is complete.
    bool begin_record(const double* wrench, UnitWrench& posed, const Record& record) const {
        record.clear();
        Summary& out = record.summary();
        out.code = REFUSED;
        if (!is_valid_wrench(wrench) || !cones.is_in_range(rest) || !(cones.margin(rest) > 0.0)) return false;
        std::copy(wrench, wrench + 6, out.wrench.begin());
        posed.unit = cones.unit.of(wrench);
        posed.scale = size(posed.unit);
        if (posed.scale < NOTHING) {  // zero force is the answer
            out.code = CONVERGED, out.residual = posed.scale;
            return false;
        }
        posed.minus = (-1.0 / posed.scale) * posed.unit;
        return true;
    }

    Code solve(const double* wrench, const Record& record) {
        UnitWrench posed;
        Summary& out = record.summary();
        if (!begin_record(wrench, posed, record)) return Code(int(out.code));
        Code code = descend<false>(posed, record);
        if (code == STALLED) {  // S has lost its digits
            const double tried = out.iterations;
            code = descend<true>(posed, record);
            out.trials += tried;
        }
        return code;
    }

    // Write the iterate as an answer with its certificate, since the iterations' own gap is no proof. Return the certified gap.
    double conclude(const UnitWrench& posed, int iterations, const Record& record) {
        const double certified = certify(posed, record);
        Summary& out = record.summary();
        out.code = certified <= options.tolerance ? CONVERGED : STALLED, out.iterations = out.trials = iterations;
        return certified;
    }

    // Outcome of `find_inside`.
    enum class Inside { found, none, unknown };
    // Find a force x strictly inside the cones that balances a wrench (unit frame), or the twist that proves that none exists.
    // Needs no internal force: takes centred steps from the axes until the balanced force nearest to the iterate is inside. Steps
    // without centring head for the optimum on the boundary, which is often nearer than balance. If no force exists, y grows
    // without bound and becomes the proof.
    Inside find_inside(const Vec6& w, Field& x, Vec6& twist, int& iterations) {
        const double scale = size(w);
        if (!(scale >= NOTHING)) return Inside::unknown;
        const Vec6 minus = (-1.0 / scale) * w;
        V cost{};
        for (int b = 0; b < blocks(); ++b) {
            const auto& c = cones.blocks[b];
            at[b].x = {all<V>(1.0), V{}, V{}}, at[b].s = {c.cost, V{}, V{}};
            cost += c.mask * c.cost;
        }
        this->gap = this->price = sum(cost), y = {};
        for (int k = 0; k < SEARCH; ++k, ++iterations) {
            const Vec6 left = missed(minus);
            for (int b = 0; b < blocks(); ++b) x[b] = all<V>(scale) * at[b].x;
            cones.balance(x, w);
            if (cones.margin(x) > 0.0) return Inside::found;
            if (!(this->system() > 0.0)) return Inside::unknown;
            const auto correct = [&](const Vec6& pull) { return this->schur.solve(pull - left); };
            if (!this->template step<false>(this->schur.solve(minus), correct, 1.0)) return Inside::unknown;
            for (int b = 0; b < blocks(); ++b) x[b] = -cones.blocks[b].transposed(y);
            if (std::min(dot(minus, y), cones.margin(x)) > ROUNDING * size(y)) {
                twist = -1.0 * y;
                return Inside::none;
            }
        }
        return Inside::unknown;
    }

private:
    static constexpr int SEARCH = 60;  // steps; a dozen is usual
    static constexpr double ROUNDING = 1e-12;  // fraction of the twist by which a proof must be strict
    Field force_, first_;  // the forces that are written
    LaneQr6<V> qr_;
    std::vector<double> fitted_;  // scaled, in the axes
    using Steps::blocks;

    // Descend from the start and write the record. EXACT: find dy by least squares instead of S, whose condition number is squared.
    template <bool EXACT> Code descend(const UnitWrench& posed, const Record& record) {
        const Vec6& minus = posed.minus;
        this->start(minus);
        double goal = options.tolerance;
        for (int iterations = 0;; ++iterations) {
            while (this->gap <= goal * this->price) {
                if (conclude(posed, iterations, record) <= options.tolerance) return CONVERGED;
                goal *= 0.1;
                if (!(this->gap > 0.0) || goal < 1e-3 * options.tolerance) return STALLED;
            }
            const bool ends = iterations >= options.limit, sound = !ends && (EXACT ? factor_axes() : this->system() > 0.0);
            bool moves = false;
            if constexpr (EXACT) {
                if (sound)
                    moves = this->template step<true>(fit([](const At& at) { return at.m.scaled(at.s); }),
                                                      [&](const Vec6&) { return correction(missed(minus)); });
            } else {
                if (sound)
                    moves = this->template step<false>(this->schur.solve(minus),
                                                       [&](const Vec6& pull) { return this->schur.solve(pull); });
            }
            if (moves) continue;
            const Code code = ends ? LIMIT : STALLED;
            if (conclude(posed, iterations, record) <= options.tolerance) return CONVERGED;
            record.summary().code = code;
            return code;
        }
    }

    Vec6 missed(const Vec6& minus) const {  // G x + w
        V total[6] = {};
        for (int b = 0; b < blocks(); ++b) cones.blocks[b].add_wrench(at[b].x, total);
        return sums(total) - minus;
    }

    // M by its axes: along v, against it, and across both. None of its entries is a difference or loses digits to a larger one.
    struct RootAxes {
        Vec3<V> axis[3];
        V size[3];  // of the root of M: sqrt(eta) times v_0 + |v|, 1 / (v_0 + |v|), 1

        explicit RootAxes(const Scaling<V>& m) {
            const V half = all<V>(0.70710678118654752440), s = sqrt(m.v.o * m.v.o + m.v.t * m.v.t), root = sqrt(m.eta);
            const V o = s > 1e-140 ? m.v.o / s : all<V>(1.0), t = s > 1e-140 ? m.v.t / s : V{};
            axis[0] = half * Vec3<V>{all<V>(1.0), o, t}, axis[1] = half * Vec3<V>{all<V>(1.0), -o, -t}, axis[2] = {V{}, -t, o};
            size[0] = root * (m.v.u + s), size[1] = root / (m.v.u + s), size[2] = root;
        }
    };
    // Factor A, with S = A^T A.
    bool factor_axes() {
        for (int b = 0; b < blocks(); ++b) {
            const RootAxes m(at[b].m = Scaling<V>(at[b].x, at[b].s));
            for (int k = 0; k < 3; ++k)
                for (int r = 0; r < 6; ++r) qr_.set(b, k, r, m.size[k] * dot(cones.blocks[b].g[r], m.axis[k]));
        }
        return qr_.factor();
    }
    // The dy for which A dy is nearest to a scaled field.
    template <class F> Vec6 fit(F&& field) {
        for (int b = 0; b < blocks(); ++b) {
            const RootAxes m(at[b].m);
            const Vec3<V> d = sqrt(at[b].m.eta) * field(at[b]);
            for (int k = 0; k < 3; ++k) qr_.put(fitted_, b, k, dot(d, m.axis[k]));
        }
        return qr_.reject(fitted_);
    }
    // dy and q = dx, the root of M times the part of d that A dy leaves: never the difference of two large steps. Also removes the
    // balance residual of x.
    Vec6 correction(const Vec6& left) {
        Vec6 dy = -1.0 * fit([](const At& at) { return at.d; });
        for (auto& here : at) here.q = {V{}, V{}, V{}};
        add(fitted_);
        for (int round = 0; round < 3; ++round) {
            V total[6] = {};
            for (int b = 0; b < blocks(); ++b) cones.blocks[b].add_wrench(at[b].q, total);
            dy = dy + qr_.least(-1.0 * (sums(total) + left), fitted_);
            add(fitted_);
        }
        return dy;
    }
    void add(const std::vector<double>& z) {
        for (int b = 0; b < blocks(); ++b) {
            const RootAxes m(at[b].m);
            for (int k = 0; k < 3; ++k) at[b].q += (m.size[k] * qr_.get(z, b, k)) * m.axis[k];
        }
    }

    // Write force and certificates; return the gap.
    double certify(const UnitWrench& posed, const Record& record) {
        auto made = this->answer(posed.minus, posed.scale, force_);
        for (int b = 0; b < blocks(); ++b) first_[b] = all<V>(posed.scale) * at[b].first;
        cones.store_force(first_, record.initial_force());
        cones.certify(force_, posed.unit, record);
        Summary& out = record.summary();
        if (!(out.margin >= 0.0)) move_inside(posed.unit, record), made.price = this->price_of(force_);
        out.multipliers = cones.unit.pull_back(made.theta * y);
        out.lower_bound = made.bound, out.objective = made.price;
        return cones.balanced(force_, posed.unit, out.residual) ? made.gap() : infinity;
    }
    // If rounding left a force outside a cone, move it towards the start, which is well inside.
    [[gnu::cold, gnu::noinline]] void move_inside(const Vec6& unit, const Record& record) {
        for (double part = 1e-15; !(record.summary().margin >= 0.0); part = std::min(1.0, 4.0 * part)) {
            for (int b = 0; b < blocks(); ++b)
                force_[b] = part < 1.0 ? force_[b] + all<V>(part) * (first_[b] - force_[b]) : first_[b];
            cones.certify(force_, unit, record);
            if (part == 1.0) break;
        }
    }
};

}  // namespace grasp
