// Damped Newton on Phi with further rows: each adds lambda / slack, the order of tr P^-1. Balance
// and rows are as in `rows.hpp`; a contact's block is written in the axes of its inverse Hessian,
// H^-1 = F F^T (`Axes`).
//
// The steps are separate from those of `NewtonSolver`, which stay in registers: four hard contacts
// take 1.1 us there and 7 here.
#pragma once
#include <climits>
#include <grasp/newton/newton.hpp>
#include <grasp/general/row_system.hpp>
#include <grasp/math/double_double.hpp>

namespace grasp {

template <class R, int D> class PhiRows {
 public:
  using Field = ArenaVector<Tuple<R, D>>;
  Rows<R, D, 0> rows;
  ArenaVector<Weights<R, D>> weights;
  ArenaVector<R> row_weights;  // (M,) lambda of each limit
  Field z;                     // the start, strictly inside, then the answer
  Space<R, D, 0> y, proof;     // multipliers, and those of the bound
  int iterations = 0, trials = 0;
  R value = 0.0, bound = 0.0;

  PhiRows(Rows<R, D, 0> constraints, int limits)
      : rows(std::move(constraints)),
        weights(rows.count),
        row_weights(limits),
        z(rows.count),
        y(rows),
        proof(rows),
        system_(rows),
        f_(rows),
        left_(rows),
        more_(rows),
        own_slack_(rows.own.size()),
        own_trial_(rows.own.size()),
        joint_slack_(rows.joint),
        joint_trial_(rows.joint),
        step_(rows.count),
        trial_(rows.count) {}
  static std::size_t bytes_needed(int count, int joints, int owns, int limits) {
    return Rows<R, D, 0>::bytes_needed(count, joints, owns) +
           RowSystem<R, D, 0>::bytes_needed(count, joints, owns) +
           5 * Space<R, D, 0>::bytes_needed(count, joints, owns) +
           3 * Arena::bytes_needed<Tuple<R, D>>(count) + Arena::bytes_needed<Weights<R, D>>(count) +
           Arena::bytes_needed<R>(limits) +
           2 * (Arena::bytes_needed<R>(joints) + Arena::bytes_needed<R>(owns));
  }

  // fraction: longest step, as a fraction of the way to the boundary
  Code run(const Call& call, double fraction) {
    const double tolerance = call.stop.tolerance;
    const bool known = call.optimum == call.optimum;
    bound = known ? call.optimum : -infinity;
    iterations = trials = 0;
    evaluate();
    if (!(value < infinity)) return REFUSED;
    // rounding of the balance may take Phi below its bound
    const auto certified = [&] {
      return bound > 0.0 && value - bound <= tolerance * bound &&
             (known || value - bound >= -tolerance * bound);
    };
    Direction step{};
    const auto find = [&](Code& code) {
      step = find_step();
      if (!(step.decrement < infinity)) {
        code = certified() ? CONVERGED : STALLED;
        return Next::stop;
      }
      if (const R next = known ? bound : lower_bound();
          known || !(next <= bound) || !(bound > -infinity)) {
        bound = next;
        proof = y;
      }
      return Next::step;
    };
    const auto advance = [&](Code& code) {
      if (search(step.decrement, step.reach > 0.0 ? min(R(1.0), fraction / step.reach) : R(1.0)))
        return true;
      code = certified() ? CONVERGED : STALLED;
      return false;
    };
    return run_descent(*this, call, INT_MAX, find, certified, advance);
  }

  // Balance z to the last digit of R by the least-norm change.
  void balance() {
    for (int pass = 0; pass < 2; ++pass)
      for (int r = 0; r < rows.equal; ++r) {
        R left = rows.right[r];
        for (int i = 0; i < rows.count; ++i) left -= inner(rows.columns[rows.joint * i + r], z[i]);
        for (int i = 0; i < rows.count; ++i) add(z[i], left, rows.columns[rows.joint * i + r]);
      }
  }
  // Phi at z; infinite unless strictly inside.
  void evaluate() {
    slacks(z, own_slack_, joint_slack_);
    value = phi(z, own_slack_, joint_slack_);
  }

 private:
  struct Direction {
    R decrement, reach;
  };  // squared Newton decrement (nan: no step), 1 / (largest step inside)
  static constexpr int REFINEMENTS = 3, HALVINGS = 60;
  // fraction of Phi: a smaller balance residual of a step needs no refinement
  static constexpr double BALANCED = 1e-13;
  // a step moves z by at least this fraction of its length
  static constexpr double SHORTEST = 1e-10;
  RowSystem<R, D, 0> system_;
  Space<R, D, 0> f_, left_, more_;
  ArenaVector<R> own_slack_, own_trial_, joint_slack_, joint_trial_;
  Field step_, trial_;

  void slacks(const Field& at, ArenaVector<R>& own, ArenaVector<R>& joint) const {
    joint = rows.right;
    for (int i = 0; i < rows.count; ++i) {
      for (int r = 0; r < rows.joint; ++r)
        joint[r] -= inner(rows.columns[rows.joint * i + r], at[i]);
      for (int k = rows.first[i]; k < rows.first[i + 1]; ++k)
        own[k] = rows.own[k].right - inner(rows.own[k].row, at[i]);
    }
    for (int k = rows.first[rows.count]; k < int(rows.own.size()); ++k) own[k] = rows.own[k].right;
  }

  // +inf unless strictly inside
  R phi(const Field& at, const ArenaVector<R>& own, const ArenaVector<R>& joint) const {
    R total = 0.0;
    const auto barrier = [&](const R& weight, const R& slack) {
      total += slack > 0.0 ? weight / slack : R(infinity);
    };
    for (int i = 0; i < rows.count; ++i) {
      const Vec<R, D> x = cone(at[i]);
      if (!(x.u > 0.0 && lorentz(x, x) > 0.0)) return infinity;
      total += grasp::phi(x, weights[i]);
    }
    for (int k = 0; k < int(rows.own.size()); ++k) barrier(row_weights[rows.own[k].label], own[k]);
    for (int r = rows.equal; r < rows.joint; ++r) barrier(row_weights[rows.label[r]], joint[r]);
    return total < infinity ? total : R(infinity);
  }

  Direction find_step() {
    for (int i = 0; i < rows.count; ++i) {
      const Axes<R, D> axes(cone(z[i]), weights[i]);
      Shape<R, D>& shape = system_.shapes[i];
      for (int a = 0; a < D; ++a)
        for (int k = 0; k < D; ++k) shape.a[a][k] = axes[k][a];
      f_.z[i] = shape.transposed(tuple(-gradient(cone(z[i]), weights[i])));
    }
    // a limit's multiplier is p = lambda / slack^2 at z, and p + p' (C dz) after the step
    for (int k = 0; k < int(rows.own.size()); ++k) {
      const R& slack = own_slack_[k];
      system_.own_diagonal[k] = 0.5 * slack * slack * slack / row_weights[rows.own[k].label];
      f_.own[k] = -0.5 * slack;
    }
    for (int r = 0; r < rows.joint; ++r) {
      f_.joint[r] = joint_slack_[r];
      if (r < rows.equal) continue;
      system_.joint_diagonal[r] =
          0.5 * joint_slack_[r] * joint_slack_[r] * joint_slack_[r] / row_weights[rows.label[r]];
      f_.joint[r] *= -0.5;
    }
    const R none = R(0.0) / R(0.0);
    if (!system_.factor(rows)) return {none, none};
    system_.solve(rows, f_, y);
    for (int round = 0;; ++round) {
      R worst = 0.0;
      system_.missed(rows, f_, y, left_);
      for (int r = 0; r < rows.equal; ++r) keep_largest(worst, abs(left_.joint[r]));
      if (round == REFINEMENTS || !(worst > BALANCED * value)) break;
      system_.solve(rows, left_, more_);
      y.add(more_);
    }
    // the least-norm change removes the remaining balance residual
    R decrement = 0.0, reach = 0.0;
    for (int i = 0; i < rows.count; ++i) {
      step_[i] = system_.shapes[i] * y.z[i];
      for (int r = 0; r < rows.equal; ++r)
        add(step_[i], left_.joint[r], rows.columns[rows.joint * i + r]);
      const Vec<R, D> x = cone(z[i]);
      const Vec<R, D> move = cone(step_[i]);
      decrement -= dot(gradient(x, weights[i]), move);
      keep_largest(reach, Boundary(x).per(move));
      for (int r = rows.equal; r < rows.joint; ++r)
        joint_trial_[r] =
            (i ? joint_trial_[r] : R(0.0)) + inner(rows.columns[rows.joint * i + r], step_[i]);
      for (int k = rows.first[i]; k < rows.first[i + 1]; ++k)
        shrinks(inner(rows.own[k].row, step_[i]), own_slack_[k], row_weights[rows.own[k].label],
                decrement, reach);
    }
    for (int r = rows.equal; r < rows.joint; ++r)
      shrinks(joint_trial_[r], joint_slack_[r], row_weights[rows.label[r]], decrement, reach);
    return {decrement, reach};
  }
  static void shrinks(const R& by, const R& slack, const R& weight, R& decrement, R& reach) {
    decrement -= weight / (slack * slack) * by;
    keep_largest<R>(reach, by / slack);
  }

  // Halve alpha until Phi decreases. Return false if no step that moves z decreases it.
  bool search(const R& decrement, R alpha) {
    R moved = 0.0, size = 0.0;
    for (int i = 0; i < rows.count; ++i) {
      keep_largest(moved, abs(step_[i][0]));
      keep_largest(size, abs(z[i][0]));
    }
    for (int halving = 0; halving < HALVINGS; ++halving, alpha *= 0.5) {
      ++trials;
      trial_ = z;
      for (int i = 0; i < rows.count; ++i) add(trial_[i], alpha, step_[i]);
      slacks(trial_, own_trial_, joint_trial_);
      const R after = phi(trial_, own_trial_, joint_trial_);
      const bool flat = decrement < 1e-9 * value;
      if (after < value - 1e-4 * alpha * decrement || (flat && after <= value)) {
        // far from the optimum Phi is nearly straight and steps are long: judge how far z moves
        if ((flat || halving > 0) && !(alpha * moved > SHORTEST * size)) return false;
        std::swap(z, trial_);
        std::swap(own_slack_, own_trial_);
        std::swap(joint_slack_, joint_trial_);
        value = after;
        return true;
      }
    }
    return false;
  }

  // Dual value at the multipliers: for each contact the minimum of phi(x) + q . x, q = C^T y (see
  // `dual`); for each limit that of lambda / slack + y slack. -inf: no bound.
  R lower_bound() {
    R total = 0.0;
    for (int k = 0; k < int(rows.own.size()); ++k) {
      y.own[k] = max(y.own[k], R(0.0));
      total += 2.0 * sqrt(row_weights[rows.own[k].label] * y.own[k]) - y.own[k] * rows.own[k].right;
    }
    for (int r = 0; r < rows.joint; ++r) {
      if (r >= rows.equal) {
        y.joint[r] = max(y.joint[r], R(0.0));
        total += 2.0 * sqrt(row_weights[rows.label[r]] * y.joint[r]);
      }
      total -= y.joint[r] * rows.right[r];
    }
    for (int i = 0; i < rows.count; ++i) {
      Tuple<R, D> q{};
      for (int r = 0; r < rows.joint; ++r) add(q, y.joint[r], rows.columns[rows.joint * i + r]);
      for (int k = rows.first[i]; k < rows.first[i + 1]; ++k) add(q, y.own[k], rows.own[k].row);
      R room;
      total += dual(-cone(q), weights[i], room);
      if (!(room > 0.0)) return -infinity;
    }
    return total < infinity ? total : R(-infinity);
  }
};

}  // namespace grasp
