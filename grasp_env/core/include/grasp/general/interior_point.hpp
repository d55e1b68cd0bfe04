// The general cone program by an interior point with Nesterov-Todd scaling and Mehrotra's
// corrector, as in `conic.hpp`, with further rows and variables that all contacts share:
//
//     min  sum_i c_i . z_i + d . t   s.t.   rows (`Rows`),  z_i in its cone
//
// A start may violate its equations; iterates of one that keeps them keep them. Slacks are separate
// variables, so none is a difference that cancels. Directions are refined by their residuals.
//
// Separate from `conic.hpp`, whose steps serve one problem and a register of them: four hard
// contacts take 1.5 us there and 5.5 here.
#pragma once
#include <grasp/conic/conic.hpp>
#include <grasp/general/row_system.hpp>
#include <grasp/math/double_double.hpp>

namespace grasp {

template <class R, int D, int T> class InteriorPoint {
 public:
  using Field = ArenaVector<Tuple<R, D>>;
  struct State {
    Field z, s;  // primal and dual, strictly inside
    Tuple<R, T> t{};
    ArenaVector<R> own, joint;              // multipliers; > 0 for limits
    ArenaVector<R> own_slack, joint_slack;  // > 0 for limits
  };
  Rows<R, D, T> rows;
  Field cost;
  Tuple<R, T> shared_cost{};
  State at;  // the start, then the answer
  int iterations = 0;

  explicit InteriorPoint(Rows<R, D, T> constraints)
      : rows(std::move(constraints)),
        cost(rows.count),
        system_(rows),
        f_(rows),
        d_(rows),
        left_(rows),
        more_(rows),
        residual_(rows),
        ds_(rows.count),
        dz_(rows.count),
        scaling_(rows.count),
        kappa_own_(rows.own.size()),
        dslack_own_(rows.own.size()),
        kappa_joint_(rows.joint),
        dslack_joint_(rows.joint) {
    at.z.resize(rows.count);
    at.s.resize(rows.count);
    at.own.resize(rows.own.size());
    at.own_slack.resize(rows.own.size());
    at.joint.resize(rows.joint);
    at.joint_slack.resize(rows.joint);
    best_ = at;
  }
  static std::size_t bytes_needed(int count, int joints, int owns) {
    return Rows<R, D, T>::bytes_needed(count, joints, owns) +
           RowSystem<R, D, T>::bytes_needed(count, joints, owns) +
           9 * Space<R, D, T>::bytes_needed(count, joints, owns) +
           3 * Arena::bytes_needed<Tuple<R, D>>(count) + Arena::bytes_needed<Scaling<R, D>>(count) +
           2 * (Arena::bytes_needed<R>(joints) + Arena::bytes_needed<R>(owns));
  }

  R objective() const {
    R total = inner(shared_cost, at.t);
    for (int i = 0; i < rows.count; ++i) total += inner(cost[i], at.z[i]);
    return total;
  }

  // Iterate until accept() returns a gap within the tolerance. accept() is called for feasible
  // iterates with a gap of at most tolerance * |objective| + absolute, or already `accept_factor` *
  // |objective|. If the gap is closed but an equation is not, or accept() has no force because
  // shortened steps never kept the equations, up to SETTLINGS settling steps follow. Ends at the
  // best feasible iterate.
  template <class Accept>
  Code run(double tolerance, double absolute, double accept_factor, int limit, Accept&& accept) {
    double goal = tolerance;
    R best = infinity;
    int settled = 0;
    Code code;
    for (iterations = 0;; ++iterations) {
      const Measured m = measure();
      if (!(m.gap < infinity)) {
        code = STALLED;
        break;
      }
      const bool usable = m.primal < NEARLY && m.dual < NEARLY;
      if (usable && m.gap < best) {
        best = m.gap;
        best_ = at;
      }
      bool done = false, spent = false, settle = false;
      const bool close = m.gap <= goal * m.size + absolute;
      if (!(m.primal < FEASIBLE && m.dual < FEASIBLE)) {
        settle = close && m.dual < FEASIBLE && settled++ < SETTLINGS;
      } else if (close || m.gap <= accept_factor * m.size + absolute) {
        const double gap = accept();
        done = gap <= tolerance;
        settle = close && !(gap < infinity) && max(m.primal, m.dual) > EQUATION_ROUNDING &&
                 settled++ < SETTLINGS;
        while (!done && !settle && !spent && m.gap <= goal * m.size + absolute) {
          goal *= 0.1;
          spent = goal < 1e-3 * tolerance || !(m.gap > 0.0);
        }
      }
      if (done) return CONVERGED;
      if (spent || m.diverges) {
        code = STALLED;
        break;
      }
      if (iterations >= limit) {
        code = LIMIT;
        break;
      }
      if (!step(settle ? max(m.gap, MIDDLE * (tolerance * m.size + absolute)) : m.gap, settle)) {
        code = STALLED;
        break;
      }
    }
    if (best < infinity) at = best_;
    return code;
  }

 private:
  static constexpr double FEASIBLE = 1e-9, NEARLY = 1e-7;  // residuals relative to the data
  static constexpr double EQUATION_ROUNDING = 1e-14;  // equation residual that is mere rounding
  static constexpr double AWAY = 1e10;   // multipliers that indicate an infeasible program
  static constexpr double MIDDLE = 0.3;  // of the required gap: target of a settling step
  static constexpr int REFINEMENTS = 2, SETTLINGS = 3;
  static constexpr double ENOUGH = 1e-12;  // of the largest force: allowed residual of a direction
  R largest_ = 0.0;
  RowSystem<R, D, T> system_;
  Space<R, D, T> f_, d_, left_, more_, residual_;  // d_.z is the scaled direction W^-1 dz
  State best_;
  Field ds_, dz_;
  ArenaVector<Scaling<R, D>> scaling_;
  ArenaVector<R> kappa_own_, dslack_own_, kappa_joint_, dslack_joint_;

  struct Measured {
    R gap, size, primal, dual;
    bool diverges;
  };

  // Write the residuals of the equations; return the gap and the sizes.
  Measured measure() {
    return sized<R>(rows.joint, [&](auto joint) { return measure(joint); });
  }
  template <class J> Measured measure(const J joint) {
    Measured m{0.0, abs(objective()), 0.0, 0.0, false};
    R largest_z = 1e-12, largest_c = 1e-12, largest_y = 0.0;
    const auto keep = [](R& most, const R& value) { keep_largest(most, abs(value)); };
    for (int r = 0; r < joint; ++r) {
      residual_.joint[r] = inner(rows.coupling[r], at.t) - rows.right[r];
      if (r >= rows.equal) {
        residual_.joint[r] += at.joint_slack[r];
        m.gap += at.joint_slack[r] * at.joint[r];
      }
      keep(largest_y, at.joint[r]);
      keep(largest_z, rows.right[r]);
    }
    residual_.t = shared_cost;
    for (int r = 0; r < joint; ++r) add(residual_.t, at.joint[r], rows.coupling[r]);
    for (int i = 0; i < rows.count; ++i) {
      const Tuple<R, D>& z = at.z[i];
      const Tuple<R, D>& s = at.s[i];
      Tuple<R, D> left = cost[i];
      for (int r = 0; r < joint; ++r) {
        const Tuple<R, D>& row = rows.columns[joint * i + r];
        residual_.joint[r] += inner(row, z);
        add(left, at.joint[r], row);
      }
      rows.each_own(i, [&](int k, bool paired) {
        residual_.own[k] = inner(rows.own[k].row, z);
        if (paired) residual_.own[k + 1] = -residual_.own[k];
        add(left, rows.pulled(at.own, k, paired), rows.own[k].row);
      });
      add(left, R(-1.0), s);
      residual_.z[i] = left;
      m.gap += dot(cone(z), cone(s));
      keep(largest_z, z[0]);
      keep(largest_c, cost[i][0]);
      for (const R& value : left) keep(m.dual, value);
    }
    for (int k = 0; k < int(rows.own.size()); ++k) {
      if (k >= rows.first[rows.count]) residual_.own[k] = 0.0;
      residual_.own[k] += inner(rows.own[k].shared, at.t) + at.own_slack[k] - rows.own[k].right;
      m.gap += at.own_slack[k] * at.own[k];
      add(residual_.t, at.own[k], rows.own[k].shared);
      keep(m.primal, residual_.own[k] / (1.0 + abs(rows.own[k].right)));
      keep(largest_y, at.own[k]);
    }
    for (const R& value : residual_.t) keep(m.dual, value);
    for (const R& value : shared_cost) keep(largest_c, value);
    for (const R& value : residual_.joint) keep(m.primal, value);
    largest_ = largest_z;
    m.primal /= largest_z;
    m.dual /= largest_c;
    m.diverges = m.primal > FEASIBLE && largest_y > AWAY * largest_c;
    return m;
  }

  double degree() const {
    return 2.0 * rows.count + double(rows.own.size()) + (rows.joint - rows.equal);
  }

  Tuple<R, D> scaled(int i, const Tuple<R, D>& a) const { return system_.shapes[i] * a; }

  // Step from the gap to the one that Mehrotra's predictor finds. settle: step to this gap, so that
  // whole steps stay inside and keep every equation.
  bool step(const R& gap, bool settle) {
    for (int i = 0; i < rows.count; ++i) {
      const Scaling<R, D>& m = scaling_[i] = Scaling<R, D>(cone(at.z[i]), cone(at.s[i]));
      Shape<R, D>& shape = system_.shapes[i];
      const R root = sqrt(m.eta);
      const Vec<R, D> v = m.v;
      shape.a[0][0] = root * v.u;
      for (int a = 1; a < D; ++a) {
        shape.a[0][a] = shape.a[a][0] = root * v[a];
        shape.a[a][a] = root * (1.0 + v[a] * v[a] * m.shrink);
        for (int k = 1; k < a; ++k) shape.a[k][a] = shape.a[a][k] = root * v[k] * v[a] * m.shrink;
      }
    }
    for (int k = 0; k < int(rows.own.size()); ++k)
      system_.own_diagonal[k] = at.own_slack[k] / at.own[k];
    for (int r = rows.equal; r < rows.joint; ++r)
      system_.joint_diagonal[r] = at.joint_slack[r] / at.joint[r];
    if (!system_.factor(rows)) return false;
    R part = 1.0, least = 1.0;
    if (settle) {
      clear_predictor();
    } else {
      find_direction(0.0, false, 0);
      const auto [primal, dual] = reach();
      const R near = min(R(1.0), 1.0 / primal);
      const R far = min(R(1.0), 1.0 / dual);
      part = min(R(1.0), max(gap_after(near, far), R(0.0)) / gap);
      least = min(near, far);
    }
    find_direction(max(part * part * part, R(1e-10)) * gap / degree(), true, REFINEMENTS);
    const R fraction = 0.9 + 0.095 * least;
    const auto [first, second] = reach();
    const R along = min(R(1.0), fraction / first);
    const R up = min(R(1.0), fraction / second);
    if (!(max(along, up) > 1e-10 && finite(first) && finite(second))) return false;
    for (int i = 0; i < rows.count; ++i) {
      add(at.z[i], along, dz_[i]);
      add(at.s[i], up, ds_[i]);
    }
    add(at.t, along, d_.t);
    for (int k = 0; k < int(rows.own.size()); ++k) {
      at.own[k] += up * d_.own[k];
      at.own_slack[k] += along * dslack_own_[k];
    }
    for (int r = 0; r < rows.joint; ++r) at.joint[r] += up * d_.joint[r];
    for (int r = rows.equal; r < rows.joint; ++r) at.joint_slack[r] += along * dslack_joint_[r];
    return true;
  }

  void clear_predictor() {
    d_.z.assign(rows.count, {});
    ds_.assign(rows.count, {});
    for (auto* values : {&d_.own, &d_.joint, &dslack_own_, &dslack_joint_})
      std::fill(values->begin(), values->end(), R(0.0));
  }

  // The direction towards complementarity `target`. second: with the second-order term of the
  // predictor, which is still stored.
  void find_direction(const R& target, bool second, int refinements) {
    for (int i = 0; i < rows.count; ++i) {
      const Tuple<R, D> ls = scaled(i, at.s[i]);
      const Vec<R, D> l = cone(ls);
      Tuple<R, D> h;
      for (int a = 0; a < D; ++a) h[a] = -ls[a];
      if (second) {
        const Vec<R, D> e = cone(scaled(i, ds_[i]));
        const Vec<R, D> p = cone(d_.z[i]);
        Vec<R, D> r = -(p.u * e + e.u * p);
        r.u = target - dot(p, e);
        const R q = lorentz(l, r) / lorentz(l, l);
        h[0] += q;
        for (int a = 1; a < D; ++a) h[a] += (r[a] - q * l[a]) / l.u;
      }
      f_.z[i] = h;
      add(f_.z[i], R(-1.0), scaled(i, residual_.z[i]));
    }
    f_.t = residual_.t;
    for (R& value : f_.t) value = -value;
    for (int k = 0; k < int(rows.own.size()); ++k) {
      kappa_own_[k] =
          target - at.own_slack[k] * at.own[k] - (second ? dslack_own_[k] * d_.own[k] : R(0.0));
      f_.own[k] = -residual_.own[k] - kappa_own_[k] / at.own[k];
    }
    for (int r = 0; r < rows.joint; ++r) {
      f_.joint[r] = -residual_.joint[r];
      if (r < rows.equal) continue;
      kappa_joint_[r] = target - at.joint_slack[r] * at.joint[r] -
                        (second ? dslack_joint_[r] * d_.joint[r] : R(0.0));
      f_.joint[r] -= kappa_joint_[r] / at.joint[r];
    }
    system_.solve(rows, f_, d_);
    R before = infinity;
    for (int round = 0; round < refinements; ++round) {
      const R now = system_.missed(rows, f_, d_, left_);
      if (!(now < 0.5 * before && now > ENOUGH * largest_)) break;
      before = now;
      system_.solve(rows, left_, more_);
      d_.add(more_);
    }
    for (int i = 0; i < rows.count; ++i) {
      dz_[i] = scaled(i, d_.z[i]);
      // ds from its own equation, so feasibility is kept to the last digit
      ds_[i] = residual_.z[i];
      sized<R>(rows.joint, [&](auto joint) {
        for (int r = 0; r < joint; ++r) add(ds_[i], d_.joint[r], rows.columns[joint * i + r]);
      });
      rows.each_own(i, [&](int k, bool paired) {
        add(ds_[i], rows.pulled(d_.own, k, paired), rows.own[k].row);
      });
    }
    for (int k = 0; k < int(rows.own.size()); ++k)
      dslack_own_[k] = (kappa_own_[k] - at.own_slack[k] * d_.own[k]) / at.own[k];
    for (int r = rows.equal; r < rows.joint; ++r)
      dslack_joint_[r] = (kappa_joint_[r] - at.joint_slack[r] * d_.joint[r]) / at.joint[r];
  }

  // 1 / (largest step) of the primal and the dual part; at least 1e-12; nan is kept.
  struct Reach {
    R primal, dual;
  };
  Reach reach() const {
    Reach out{1e-12, 1e-12};
    for (int i = 0; i < rows.count; ++i) {
      keep_largest<R>(out.primal, Boundary(cone(at.z[i])).per(cone(dz_[i])));
      keep_largest<R>(out.dual, Boundary(cone(at.s[i])).per(cone(ds_[i])));
    }
    for (int k = 0; k < int(rows.own.size()); ++k) {
      keep_largest<R>(out.primal, -dslack_own_[k] / at.own_slack[k]);
      keep_largest<R>(out.dual, -d_.own[k] / at.own[k]);
    }
    for (int r = rows.equal; r < rows.joint; ++r) {
      keep_largest<R>(out.primal, -dslack_joint_[r] / at.joint_slack[r]);
      keep_largest<R>(out.dual, -d_.joint[r] / at.joint[r]);
    }
    return out;
  }

  R gap_after(const R& primal, const R& dual) const {
    R total = 0.0;
    for (int i = 0; i < rows.count; ++i)
      for (int a = 0; a < D; ++a)
        total += (at.z[i][a] + primal * dz_[i][a]) * (at.s[i][a] + dual * ds_[i][a]);
    for (int k = 0; k < int(rows.own.size()); ++k)
      total += (at.own_slack[k] + primal * dslack_own_[k]) * (at.own[k] + dual * d_.own[k]);
    for (int r = rows.equal; r < rows.joint; ++r)
      total += (at.joint_slack[r] + primal * dslack_joint_[r]) * (at.joint[r] + dual * d_.joint[r]);
    return total;
  }
};

}  // namespace grasp
