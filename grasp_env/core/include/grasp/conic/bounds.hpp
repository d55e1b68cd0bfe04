// Limits of the exact problem in the registers, with the state of its interior point.
#pragma once
#include <grasp/limits/packed_rows.hpp>
#include <grasp/math/row_block.hpp>

namespace grasp {

// One side of a row, a . x + slack = bound, or of its opposite. A missing side has present = 0.
template <class V> struct Bound {
  V present{}, bound{};
  V slack = all<V>(1.0), multiplier = all<V>(1.0);
  // `missed` = a . x + slack - bound; 1 / slack, 1 / multiplier, multiplier / slack
  V missed{}, per_slack{}, per_multiplier{}, bend{};
  V rate{}, dslack{}, dmultiplier{};  // the multiplier's change at an unchanged slack; the step

  V counted() const { return present * multiplier; }
  // Begin at a . x with a slack of at least `floor` and a multiplier of at most `most`, where
  // multiplier * slack = `product` if possible.
  void begin(const V& along, const V& floor, const V& product, const V& most) {
    slack = select(present > 0.0, max(bound - along, floor), all<V>(1.0));
    multiplier = select(present > 0.0, min(product / slack, most), all<V>(1.0));
  }
  // Take over a . x.
  void at(const V& along) {
    const V both = 1.0 / (slack * multiplier);
    per_slack = both * multiplier;
    per_multiplier = both * slack;
    bend = present * multiplier * per_slack;
    missed = present * (along + slack - bound);
  }
  V outside(const V& along) const {
    return select(present > 0.0, along - bound, all<V>(-infinity));
  }
  // Aim at multiplier * slack = target, with the second-order term of the last step.
  void aim(double target) {
    rate = present * ((target - dslack * dmultiplier) * per_slack - multiplier);
  }
  // Leave the residual as it is in the next step.
  void forgive() { missed = V{}; }
  // Forget the last step.
  void stay() {
    dslack = V{};
    dmultiplier = V{};
  }
  // The change of the slack that fits the multiplier's.
  V slack_step() const { return present * (rate - dmultiplier) * slack * per_multiplier; }
};
// A row's two sides.
template <class V> struct Bounds {
  static constexpr bool PAIRED = true;
  Bound<V> high, low;
  V bend{}, right{};  // of both sides: bend (a . dx - right) is the change of the multiplier

  Bound<V>& side(bool opposite) { return opposite ? low : high; }
  const Bound<V>& side(bool opposite) const { return opposite ? low : high; }
  V multiplier() const { return high.counted() - low.counted(); }
  V change() const { return high.dmultiplier - low.dmultiplier; }
  void begin(const V& along, const V& floor, const V& product, const V& most) {
    high.begin(along, floor, product, most);
    low.begin(-along, floor, product, most);
  }
  void at(const V& along) {
    high.at(along);
    low.at(-along);
    bend = high.bend + low.bend + NO_BEND;
  }
  // How far a . x exceeds a bound; < 0 within them.
  V outside(const V& along) const { return max(high.outside(along), low.outside(-along)); }
  // Take over the sides' rates.
  void take_rates() {
    right = ((low.rate + low.bend * low.missed) - (high.rate + high.bend * high.missed)) / bend;
  }
  // Set the step from left = a . dx - right. The nearer side has its multiplier from the other one,
  // and its slack from its multiplier, so that nothing cancels.
  void step(const V& left) {
    const V along = left + right;
    const V net = bend * left;
    const V high_slack = -high.present * (high.missed + along);
    const V low_slack = -low.present * (low.missed - along);
    const V high_multiplier = high.rate - high.bend * high_slack;
    const V low_multiplier = low.rate - low.bend * low_slack;
    const auto near = high.bend >= low.bend;
    high.dmultiplier = select(near, net + low_multiplier, high_multiplier);
    low.dmultiplier = select(near, low_multiplier, high_multiplier - net);
    high.dslack = select(near, high.slack_step(), high_slack);
    low.dslack = select(near, low_slack, low.slack_step());
  }

 private:
  static constexpr double NO_BEND = 1e-300;  // where both sides are missing
};

// A joint torque as a row, divided by its length: the cost is weight (a . x - bound)^2 / 2, and the
// multiplier is its derivative at the optimum.
template <class V> struct Torque {
  static constexpr bool PAIRED = false;
  V present{}, weight{}, per_weight{}, bound{}, multiplier{};
  V bend{}, right{}, dmultiplier{};  // as in `Bounds`
  V value{};                         // weight (a . x - bound)

  Torque& side(bool) { return *this; }
  const Torque& side(bool) const { return *this; }
  void at(const V& along) {
    bend = weight + NO_BEND;
    value = weight * (along - bound);
    right = (multiplier - value) / bend;
  }
  void forget() { multiplier = V{}; }
  void take_rates() {}
  void step(const V& left) { dmultiplier = bend * left; }
  V change() const { return dmultiplier; }

 private:
  static constexpr double NO_BEND = 1e-300;
};
// A row of one contact in each lane, with the shares of T shared variables.
template <class V, int D, int T, class Row> struct OwnRow : Row {
  Vec<V, D> a;
  Tuple<V, T> share{};
  RowUpdate<V, D, T> update;
  V left;
};
template <class V, int B, int D, int T> using ConicLimits =
    PackedRows<V, B, D, OwnRow<V, D, T, Bounds<V>>, Bounds<double>>;
template <class V, int B, int D> using ConicTorques =
    PackedRows<V, B, D, OwnRow<V, D, 0, Torque<V>>, Torque<double>>;

}  // namespace grasp
