// The exact problem: the least weighted sum of normal forces subject to balance and friction cones.
// Primal-dual interior point with Nesterov-Todd scaling and Mehrotra's corrector (Nesterov, Todd
// 1997; Mehrotra 1992; as in Vandenberghe 2010, "The CVXOPT linear and quadratic cone program
// solvers"). Every iterate is a valid grasp, and y scaled onto the boundary is a certified bound.
//
//     min sum_i c_i u_i  s.t.  G x = -w,  x_i in the cone u >= |(o, t)|
//     max -w . y  s.t.  s_i = c_i e_u - G_i^T y in the cone
//
// In these coordinates the scaling of a contact is eta (2 v v^T - J), v . J v = 1, so the 6 x 6
// matrix of an iteration is the sum of eta (2 (G v)(G v)^T - G J G^T) with G J G^T constant. That
// sum loses digits close to losing force closure, or with contacts close together. If it stalls,
// the problem is solved again by least squares in the axes of the scalings, where no step is the
// difference of two large ones.
#pragma once
#include <grasp/conic/steps.hpp>
#include <grasp/phi/descent.hpp>
#include <grasp/math/qr6.hpp>

namespace grasp {

template <class V, int B> class ConicSolver : public ConicSteps<V, B> {
  using Steps = ConicSteps<V, B>;
  using typename Steps::At;

 public:
  using Steps::cones, Steps::rest, Steps::at, Steps::y;
  using typename Steps::Field;
  StopRule options;

  ConicSolver(int count, const StopRule& options)
      : Steps(count),
        options(options),
        force_(cones.field()),
        first_(cones.field()),
        qr_(Steps::blocks()),
        fitted_(qr_.rows()) {}

  // A wrench of size 1, and its original size.
  struct UnitWrench {
    Vec6 unit, minus;
    double scale;
  };
  // Return false if the record is complete.
  bool begin_record(const double* wrench, UnitWrench& posed, const Record& record) const {
    record.clear();
    Summary& out = record.summary();
    out.code = REFUSED;
    if (!is_valid_wrench(wrench) || !cones.is_in_range(rest) || !(cones.margin(rest) > 0.0))
      return false;
    std::copy(wrench, wrench + 6, out.wrench.begin());
    posed.unit = cones.unit.of(wrench);
    posed.scale = size(posed.unit);
    if (posed.scale < NOTHING) {  // zero force is the answer
      out.code = CONVERGED;
      out.residual = posed.scale;
      return false;
    }
    posed.minus = (-1.0 / posed.scale) * posed.unit;
    return true;
  }

  Code solve(const double* wrench, const Record& record) {
    UnitWrench posed;
    Summary& out = record.summary();
    if (!begin_record(wrench, posed, record)) return Code(int(out.code));
    this->start(posed.minus);
    Code code = descend<false>(posed, record);
    if (code == STALLED) {  // S has lost its digits
      const double tried = out.iterations;
      this->start(posed.minus);
      code = descend<true>(posed, record);
      out.trials += tried;
    }
    return code;
  }
  // Go on from the iterate of a solver that has lost digits: x, s and `first` in `at`, and y, for a
  // wrench of size 1. Needs no internal force.
  Code solve_from_iterate(const double* wrench, const Record& record) {
    UnitWrench posed;
    for (auto& x : rest) x = axis<3>(all<V>(1.0));
    if (!begin_record(wrench, posed, record)) return Code(int(record.summary().code));
    this->advance(0.0, 0.0);
    for (int k = 0; k < SETTLINGS; ++k)  // restore balance
      if (!factor_axes() || !exact_step(posed.minus, 1.0)) break;
    return descend<true>(posed, record);
  }

  // Write the answer at the iterate with its certificate; the gap of the iterations is no proof.
  // Return the certified gap.
  double conclude(const UnitWrench& posed, int iterations, const Record& record) {
    const double certified = certify(posed, record);
    Summary& out = record.summary();
    out.code = certified <= options.tolerance ? CONVERGED : STALLED;
    out.iterations = out.trials = iterations;
    return certified;
  }

  enum class Inside { found, none, unknown };
  // Find a force x strictly inside the cones that balances a wrench (unit frame), or the twist that
  // proves that none exists. Needs no internal force: takes centred steps from the axes until the
  // balanced force nearest to the iterate is inside. Steps without centring head for the optimum on
  // the boundary, which is often nearer than balance. If no force exists, y grows without bound and
  // becomes the proof.
  Inside find_inside(const Vec6& w, Field& x, Vec6& twist, int& iterations) {
    const double scale = size(w);
    if (!(scale >= NOTHING)) return Inside::unknown;
    const Vec6 minus = (-1.0 / scale) * w;
    V cost{};
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      at[b].x = {all<V>(1.0), V{}, V{}};
      at[b].s = {c.cost, V{}, V{}};
      cost += c.mask * c.cost;
    }
    this->gap = this->objective = sum(cost);
    y = {};
    for (int k = 0; k < SEARCH; ++k, ++iterations) {
      const Vec6 left = missed(minus);
      for (int b = 0; b < blocks(); ++b) x[b] = all<V>(scale) * at[b].x;
      cones.balance(x, w);
      if (cones.margin(x) > 0.0) return Inside::found;
      if (!(this->system() > 0.0)) return Inside::unknown;
      const auto correct = [&](const Vec6& pull) { return this->schur.solve(pull - left); };
      if (!this->template step<false>(this->schur.solve(minus), correct, 1.0))
        return Inside::unknown;
      for (int b = 0; b < blocks(); ++b) x[b] = -cones.blocks[b].transposed(y);
      if (dot(minus, y) > BOUNDARY * sum_of_sizes(y) && cones.margin(x) > ROUNDING * size(y)) {
        twist = -1.0 * y;
        return Inside::none;
      }
    }
    return Inside::unknown;
  }

 private:
  static constexpr int SETTLINGS = 2;
  static constexpr int SEARCH = 60;  // steps; a dozen is usual
  // fraction of the twist by which a proof must be strict
  static constexpr double ROUNDING = 1e-12;
  Field force_, first_;  // the forces that are written
  LaneQr6<V, 3> qr_;
  std::vector<double> fitted_;  // scaled, in the axes
  using Steps::blocks;

  // Descend from the iterate and write the record. EXACT: find dy by least squares instead of S,
  // whose condition number is squared.
  template <bool EXACT> Code descend(const UnitWrench& posed, const Record& record) {
    const Vec6& minus = posed.minus;
    double goal = options.tolerance;
    for (int iterations = 0;; ++iterations) {
      while (this->gap <= goal * this->objective) {
        if (conclude(posed, iterations, record) <= options.tolerance) return CONVERGED;
        goal *= 0.1;
        if (!(this->gap > 0.0) || goal < 1e-3 * options.tolerance) return STALLED;
      }
      const bool ends = iterations >= options.limit;
      const bool sound = !ends && (EXACT ? factor_axes() : this->system() > 0.0);
      bool moves = false;
      if constexpr (EXACT) {
        if (sound) moves = exact_step(minus, 0.0);
      } else {
        if (sound)
          moves = this->template step<false>(
              this->schur.solve(minus), [&](const Vec6& pull) { return this->schur.solve(pull); });
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

  bool exact_step(const Vec6& minus, double least) {
    return this->template step<true>(
        fit([](const At& at) { return at.m.scaled(at.s); }),
        [&](const Vec6&) { return correction(missed(minus)); }, least);
  }
  // M by its axes: along v, against it, and across both. None of its entries is a difference or
  // loses digits to a larger one.
  struct RootAxes {
    Vec3<V> axis[3];
    V size[3];  // of the root of M: sqrt(eta) times v_0 + |v|, 1 / (v_0 + |v|), 1

    explicit RootAxes(const Scaling<V, 3>& m) {
      const V half = all<V>(0.70710678118654752440);
      const V s = tangent_length(m.v);
      const V root = sqrt(m.eta);
      const TangentAxes<V, 3> tangents(m.v, s);
      axis[0] = with_tangents(half, half, tangents.along);
      axis[1] = with_tangents(half, -half, tangents.along);
      axis[2] = tangents.across[0];
      size[0] = root * (m.v.u + s);
      size[1] = root / (m.v.u + s);
      size[2] = root;
    }
  };
  // Factor A, with S = A^T A.
  bool factor_axes() {
    for (int b = 0; b < blocks(); ++b) {
      const RootAxes m(at[b].m = Scaling(at[b].x, at[b].s));
      for (int k = 0; k < 3; ++k)
        for (int r = 0; r < 6; ++r)
          qr_.set(b, k, r, m.size[k] * dot(cones.blocks[b].g[r], m.axis[k]));
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
  // dy and q = dx, the root of M times the part of d that A dy leaves: never the difference of two
  // large steps. Also removes the balance residual of x.
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
    auto bounded = this->answer(posed.minus, posed.scale, force_);
    for (int b = 0; b < blocks(); ++b) first_[b] = all<V>(posed.scale) * at[b].first;
    cones.store_force(first_, record.initial_force());
    cones.certify(force_, posed.unit, record);
    Summary& out = record.summary();
    if (!(out.margin >= 0.0)) {
      move_inside(posed.unit, record);
      bounded.objective = this->objective_of(force_);
    }
    out.multipliers = cones.unit.pull_back(bounded.theta * y);
    out.lower_bound = bounded.bound;
    out.objective = bounded.objective;
    return cones.balanced(force_, posed.unit, out.residual) ? bounded.gap() : infinity;
  }
  // If rounding left a force outside a cone, move it towards the start, which is well inside.
  [[gnu::cold, gnu::noinline]] void move_inside(const Vec6& unit, const Record& record) {
    for (double share = 1e-15; !(record.summary().margin >= 0.0);
         share = std::min(1.0, 4.0 * share)) {
      for (int b = 0; b < blocks(); ++b)
        force_[b] = share < 1.0 ? force_[b] + all<V>(share) * (first_[b] - force_[b]) : first_[b];
      cones.certify(force_, unit, record);
      if (share == 1.0) break;
    }
  }
};

}  // namespace grasp
