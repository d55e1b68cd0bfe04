// The balanced force in the cones that exceeds the limits least, if no force keeps them. For limits
// on single contacts; the general program, for all others, takes 80 us where this takes 9.
//
//     min t  s.t.  G x = -w,  x_i in the cone,  a . x <= b + t share
//     max -sum y b - nu . w  s.t.  sum y share = 1,  s_i = sum y a - G_i^T nu in the cone,  y >= 0
//
// A primal-dual interior point as in conic.hpp. The rows are rank-one changes of a contact's
// scaling; t is one border of the 6 x 6 system_. x stays balanced, and the multipliers of every
// iterate bound t (`RaisedLimits::farkas`), dual feasible or not.
#pragma once
#include <grasp/conic/conic.hpp>
#include <grasp/limits/raised_limits.hpp>
#include <grasp/phi/system.hpp>

namespace grasp {

inline constexpr double EXCESS_WITHIN = 1e-2;  // relative distance allowed above the least excess
inline constexpr double EXCESS_FLOOR = 1e-6;  // absolute distance allowed, as a fraction of a limit

template <class V, int B> class LeastExcess {
 public:
  using Field = typename Cones<V, B>::Field;

  RaisedLimits<V, B> rows;

  explicit LeastExcess(const Cones<V, B>& cones) : system_(cones) {
    resize(at_, cones.blocks.size());
  }

  // Solve from x, balanced, in the cones and outside the limits; x is overwritten.
  // LIMITS_EXCEEDED: objective and bound are those of the excess. Steps are added to those of the
  // record. STALLED: the least excess is not certified.
  Code solve(const Cones<V, B>& cones, const Vec6& w, Field& x, const Record& record) {
    const ExcessForce force = descend(cones, w, x);
    cones.balance(x, w);
    cones.certify(x, w, record);
    Summary& s = record.summary();
    s.iterations += force.iterations;
    s.trials += force.iterations;
    s.objective = s.limit_excess = rows.excess(x);
    s.lower_bound = force.bound;
    s.multipliers = cones.unit.pull_back(force.multipliers);
    const Code code = force.certified && s.margin > 0.0 ? LIMITS_EXCEEDED : STALLED;
    s.code = code;
    return code;
  }
  // The same from a previous least excess x, without a proof that no force keeps the limits.
  Code follow(const Cones<V, B>& cones, const Vec6& w, Field& x, const Record& record) {
    if (!(rows.excess(x) > EXCESS_FLOOR)) return REFUSED;
    Summary& s = record.summary();
    s.iterations = s.trials = 0.0;
    const Code code = solve(cones, w, x, record);
    return code == LIMITS_EXCEEDED && s.lower_bound > EXCESS_FLOOR ? code : REFUSED;
  }

 private:
  struct ExcessForce {
    bool certified;
    int iterations;
    double bound;
    Vec6 multipliers;  // -d t / d w
  };
  System<V, B> system_;

  ExcessForce descend(const Cones<V, B>& cones, const Vec6& w, Field& x) {
    const int blocks = int(x.size());
    double t = BEGIN * rows.excess(x) + EXCESS_FLOOR;
    Vec6 nu{};
    begin(cones, x, t);
    ExcessForce out{false, 0, 0.0, {}};
    for (; out.iterations < MOST; ++out.iterations) {
      const auto [gap, curvature] = scale(cones, x, t);
      const bool good =
          system_.assemble(cones, x, {}, [&](int b, Vec3<V>& gradient, Sym3<V>& inverse) {
            gradient = Vec3<V>{};
            inverse = at_[b].inverse;
          });
      if (!good) return out;
      const Border border = bordered(cones, curvature);
      const Vec6 left = system_.applied + w;
      // predictor: aims at zero products
      ExcessStep step = direct(cones, border, left, -1.0, x);
      const double after = reached(cones, x, step);
      const double part = std::clamp(after / gap, 0.0, 1.0);
      const double enough = ENOUGH * allowed(out.bound);
      const double target =
          std::max(std::max(part * part * part, CENTRE) * gap, enough) / (cones.count + rows.sides);
      const double slope = correct(cones, target);
      step = direct(cones, border, left, slope, x);
      const double primal = std::min(1.0, REACH * step.primal);
      const double dual = std::min(1.0, REACH * step.dual);
      if (!(primal + dual > 1e-6)) return out;
      for (int b = 0; b < blocks; ++b) {
        x[b] += all<V>(primal) * at_[b].dx;
        at_[b].s += all<V>(dual) * at_[b].ds;
        rows.for_each(b, [&](Pair<V>& p) {
          p.sides(
              [&](Side<V>& side, double) { side.multiplier += all<V>(dual) * side.dmultiplier; });
        });
      }
      t += primal * step.dt;
      nu = nu + dual * (step.nu - nu);
      const auto proof = rows.farkas(cones, nu, w, t);
      if (proof.share > 0.0 && -proof.value > out.bound * proof.share) {
        out.bound = -proof.value / proof.share;
        out.multipliers = (1.0 / proof.share) * proof.nu;
      }
      if (out.bound > 0.0 && rows.excess(x) - out.bound <= AIM * allowed(out.bound)) {
        out.certified = true;
        ++out.iterations;
        return out;
      }
    }
    return out;
  }

  static constexpr int MOST = 50;
  static constexpr double BEGIN = 1.5;   // factor of the excess at the start: initial value of t
  static constexpr double REACH = 0.95;  // fraction of the way to the boundary
  // smallest fraction of the gap that a step aims at: far off the centre iterates jam
  static constexpr double CENTRE = 0.1;
  static constexpr double ENOUGH = 0.5;  // fraction of the allowed gap: no step aims below it
  // the rest is for restoring the last digits of balance
  static constexpr double AIM = 0.9;

  static double allowed(double bound) { return std::max(EXCESS_WITHIN * bound, EXCESS_FLOOR); }

  struct At {
    Vec3<V> s, l, mixed;  // dual slack; scaled point; sum bend share a
    Scaling<V, 3> m;
    Sym3<V> inverse;    // (M^-1 + sum bend a a^T)^-1
    Vec3<V> dx, ds, d;  // steps; scaled right-hand side
  };
  Blocks<At, B> at_;

  // A central point: s = mu J x / (x . J x), y = mu / slack, with mu such that sum y share = 1.
  void begin(const Cones<V, B>& cones, const Field& x, double t) {
    V total{};
    for (int b = 0; b < int(x.size()); ++b)
      rows.for_each(b, [&](Pair<V>& p) {
        const V along = dot(p.a, x[b]);
        p.sides([&](Side<V>& side, double sign) {
          side.at(sign * along, t);
          side.multiplier = (side.present > 0.0 ? all<V>(1.0) : V{}) / side.slack;
          total += side.multiplier * side.share;
        });
      });
    const V mu = all<V>(1.0 / sum(total));
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      const V part = mu / lorentz(x[b], x[b]);
      at_[b].s = {part * x[b].u, -part * x[b].o, -part * x[b].t};
      rows.for_each(
          b, [&](Pair<V>& p) { p.sides([&](Side<V>& side, double) { side.multiplier *= mu; }); });
    }
  }

  // Slacks, scalings and blocks at x and t. Return the gap and the second derivative by t.
  struct Scaled {
    double gap, curvature;
  };
  Scaled scale(const Cones<V, B>& cones, const Field& x, double t) {
    V gap{}, curvature{};
    for (int b = 0; b < int(x.size()); ++b) {
      auto& at = at_[b];
      at.m = Scaling(x[b], at.s);
      at.l = at.m.scaled(at.s);
      const auto& [v, eta, shrink, root] = at.m;
      const V twice = 2.0 * eta;
      at.inverse = {twice * v.u * v.u - eta, twice * v.u * v.o, twice * v.u * v.t,
                    twice * v.o * v.o + eta, twice * v.o * v.t, twice * v.t * v.t + eta};
      at.mixed = {V{}, V{}, V{}};
      gap += cones.blocks[b].mask * dot(x[b], at.s);
      rows.for_each(b, [&](Pair<V>& p) {
        const V along = dot(p.a, x[b]);
        V mixed{};
        p.sides([&](Side<V>& side, double sign) {
          side.at(sign * along, t);
          side.bend = side.multiplier / side.slack;
          side.dslack = side.dmultiplier = V{};  // right-hand side of the predictor: zero
          const V share = side.bend * side.share;
          mixed += sign * share;
          curvature += share * side.share;
          gap += side.multiplier * side.slack;
        });
        at.mixed += mixed * p.a;
        p.update_inverse(at.inverse);
      });
      at.d = {V{}, V{}, V{}};
    }
    return {sum(gap), sum(curvature)};
  }

  // The border of t that extends S.
  struct Border {
    Vec6 side, across;
    double pivot;
  };
  Border bordered(const Cones<V, B>& cones, double curvature) {
    V sides[6] = {}, square{};
    for (int b = 0; b < int(at_.size()); ++b) {
      const Vec3<V> h = at_[b].inverse * at_[b].mixed;
      cones.blocks[b].add_wrench(h, sides);
      square += dot(at_[b].mixed, h);
    }
    const Vec6 side = sums(sides);
    const Vec6 across = system_.schur.solve(side);
    return {side, across, curvature - sum(square) + dot(side, across)};
  }

  // The whole step for the gradients in `system` and `slope`, that of t: new multipliers nu, dt,
  // and the largest steps of x and s.
  struct ExcessStep {
    Vec6 nu;
    double dt, primal, dual;
  };
  ExcessStep direct(const Cones<V, B>& cones, const Border& border, const Vec6& left, double slope,
                    const Field& x) {
    V cross{};
    for (int b = 0; b < int(at_.size()); ++b)
      cross -= dot(at_[b].inverse * at_[b].mixed, system_.gradient[b]);
    const Vec6 first = system_.multipliers(left);
    const double dt = (slope + sum(cross) + dot(border.side, first)) / border.pivot;
    const Vec6 nu = first - dt * border.across;
    V primal = all<V>(1e-9);
    V dual = all<V>(1e-9);
    for (int b = 0; b < int(at_.size()); ++b) {
      auto& at = at_[b];
      const auto& c = cones.blocks[b];
      const Vec3<V> y = c.transposed(nu);
      at.dx = c.mask * (at.inverse * (y - system_.gradient[b] + all<V>(dt) * at.mixed));
      at.ds = -y - at.s;
      rows.for_each(b, [&](Pair<V>& p) {
        const V along = dot(p.a, at.dx);
        V multiplier{};
        p.sides([&](Side<V>& side, double sign) {
          // dmultiplier holds the right-hand side, for an unchanged slack
          const V there = side.dmultiplier;
          side.dslack = all<V>(dt) * side.share - sign * along;
          side.dmultiplier = there - side.bend * side.dslack - side.multiplier;
          multiplier += sign * (side.multiplier + side.dmultiplier);
          primal = max(primal, -side.dslack / side.slack);
          dual = max(dual, side.present > 0.0 ? -side.dmultiplier / side.multiplier : V{});
        });
        at.ds += multiplier * p.a;
      });
      at.ds = c.mask * at.ds;
      primal = max(primal, Boundary(x[b]).per(at.dx));
      dual = max(dual, Boundary(at.s).per(at.ds));
    }
    return {nu, dt, 1.0 / largest(primal), 1.0 / largest(dual)};
  }

  // The gap after the predictor.
  double reached(const Cones<V, B>& cones, const Field& x, const ExcessStep& step) const {
    const V primal = all<V>(std::min(1.0, step.primal));
    const V dual = all<V>(std::min(1.0, step.dual));
    V gap{};
    for (int b = 0; b < int(x.size()); ++b) {
      gap += cones.blocks[b].mask * dot(x[b] + primal * at_[b].dx, at_[b].s + dual * at_[b].ds);
      rows.for_each(b, [&](const Pair<V>& p) {
        p.sides([&](const Side<V>& side, double) {
          gap += (side.slack + primal * side.dslack) * (side.multiplier + dual * side.dmultiplier);
        });
      });
    }
    return sum(gap);
  }

  // Right-hand sides of the corrector, from the predictor's steps: gradients go into `system`,
  // multipliers for an unchanged slack into dmultiplier. Return the slope of t.
  double correct(const Cones<V, B>& cones, double target) {
    V slope{}, pull[6] = {};
    for (int b = 0; b < int(at_.size()); ++b) {
      auto& at = at_[b];
      const Vec3<V> l = at.l;
      const Vec3<V> e = at.m.scaled(at.ds);
      const V square = at.m.root * at.m.root;
      at.d = corrector(l, e, all<V>(target) / at.m.eta, square, 1.0 / l.u);
      Vec3<V> gradient = -at.m.unscaled(at.d);
      rows.for_each(b, [&](Pair<V>& p) {
        p.sides([&](Side<V>& side, double sign) {
          const V aim = side.present > 0.0 ? all<V>(target) - side.dslack * side.dmultiplier : V{};
          side.dmultiplier = aim / side.slack;
          slope += side.dmultiplier * side.share;
          gradient += (sign * side.dmultiplier) * p.a;
        });
      });
      system_.gradient[b] = cones.blocks[b].mask * gradient;
      cones.blocks[b].add_wrench(at.inverse * system_.gradient[b], pull);
    }
    system_.pull = sums(pull);
    return sum(slope) - 1.0;
  }
};

}  // namespace grasp
