// Limits as terms of Phi: it gains lambda / slack for each row. A row of one contact is a rank-one
// change of the contact's inverse Hessian; a joint row borders the 6 x 6 system (`System`).
#pragma once
#include <grasp/limits/packed_rows.hpp>

namespace grasp {

// a . x <= bound, or -a . x for the other side. A missing side has no weight.
template <class V> struct Barrier {
  V present{}, weight{}, bound = all<V>(UNBOUNDED);
  V per_slack{}, multiplier{};  // at x: 1 / slack, weight / slack^2

  // growth of the multiplier as the slack shrinks
  V bend() const { return 2.0 * multiplier * per_slack; }
  void at(const V& per) {
    per_slack = per;
    multiplier = weight * per * per;
  }
  // Minimum over the slack of weight / slack + multiplier (slack - bound).
  V dual() const { return 2.0 * sqrt(weight * multiplier) - multiplier * bound; }
  // Change the multiplier as Newton's model does where a . x grows. Return 1 / (largest step
  // inside) of such a step.
  V predict(const V& growth) {
    const V part = growth * per_slack;
    const V grown = multiplier + 2.0 * multiplier * part;
    multiplier = grown > 0.0 ? grown : V{};
    return part;
  }
};
// The two sides of a row.
template <class V> struct Barriers2 {
  static constexpr bool PAIRED = true;
  Barrier<V> high, low;

  Barrier<V>& side(bool opposite) { return opposite ? low : high; }
  const Barrier<V>& side(bool opposite) const { return opposite ? low : high; }
  V multiplier() const { return high.multiplier - low.multiplier; }
  V bend() const { return high.bend() + low.bend(); }
  void at(const V& along) {
    const V above = high.bound - along;
    const V below = low.bound + along;
    const V both = 1.0 / (above * below);  // one division for two
    high.at(both * below);
    low.at(both * above);
  }
  // infinite unless a . x is inside
  V value(const V& along) const {
    const V above = high.bound - along;
    const V below = low.bound + along;
    const V sum = (high.weight * below + low.weight * above) / (above * below);
    return select(min(above, below) > 0.0, sum, all<V>(infinity));
  }
  V dual() const { return high.dual() + low.dual(); }
  V predict(const V& growth) { return max(high.predict(growth), low.predict(-growth)); }
};
template <class V, int D> struct OwnBarriers : Barriers2<V> {
  Vec<V, D> a;
};

template <class V, int B, int D = 3> class Barriers
    : public PackedRows<V, B, D, OwnBarriers<V, D>, Barriers2<double>> {
 public:
  using Rows = PackedRows<V, B, D, OwnBarriers<V, D>, Barriers2<double>>;
  using typename Rows::X;
  using Field = typename Cones<V, B, D>::Field;
  static constexpr bool has_terms = true;

  // lambda: (N,) weights of Phi
  bool pack(const Cones<V, B, D>& cones, const ForceLimits& limits, const Preload& preload,
            std::span<const double> lambda) {
    if (!Rows::pack(cones, limits, preload, lambda)) return false;
    this->scale(1.0);
    this->each_place([](auto& side, int n, const auto& row) { set(side.weight, n, row.weight); });
    return true;
  }

  // --- block by block: the rows of one contact, and all rows in gradient and dual value

  V value(int b, const X& x) const {
    V total{};
    this->each_own(b, [&](const auto& row) { total += row.value(dot(row.a, x)); });
    return total;
  }
  // Add to the gradient and the inverse Hessian at the last measured x. The joint rows' part of the
  // Hessian is the border.
  void add_to_gradient_and_hessian(int b, X& gradient, Sym<V, D>& inverse) const {
    this->each_own(b, [&](const auto& row) {
      gradient += row.multiplier() * row.a;
      const V bend = row.bend();
      const X h = inverse * row.a;
      inverse.subtract(bend / (1.0 + bend * dot(row.a, h)), h);
    });
    for (int j = 0; j < this->joint_rows(); ++j)
      gradient += all<V>(this->joints[j].multiplier()) * this->column(j, b);
  }
  V predict(int b, const X& step) {
    V reach{};
    this->each_own(b, [&](auto& row) { reach = max(reach, row.predict(dot(row.a, step))); });
    return reach;
  }
  // Subtract the rows from y = G^T nu. Return the part of this contact's rows in the dual value.
  V dual(int b, X& y) const {
    V total{};
    this->each_own(b, [&](const auto& row) {
      y -= row.multiplier() * row.a;
      total += row.dual();
    });
    for (int j = 0; j < this->joint_rows(); ++j)
      y -= all<V>(this->joints[j].multiplier()) * this->column(j, b);
    return total;
  }

  // --- over all contacts

  // Take over x, strictly inside.
  void measure(const Field& x) {
    for (int b = 0; b < int(x.size()); ++b)
      this->each_own(b, [&](auto& row) { row.at(dot(row.a, x[b])); });
    for (int j = 0; j < this->joint_rows(); ++j)
      this->joints[j].at(this->along(j, [&](int b) { return x[b]; }));
  }
  // x(b): force of block b
  template <class F> double joint_value(F&& x) const {
    double total = 0.0;
    for (int j = 0; j < this->joint_rows(); ++j) total += this->joints[j].value(this->along(j, x));
    return total;
  }
  double predict_joint(const Field& step) {
    double reach = 0.0;
    for (int j = 0; j < this->joint_rows(); ++j)
      reach =
          std::max(reach, this->joints[j].predict(this->along(j, [&](int b) { return step[b]; })));
    return reach;
  }
  double joint_dual() const {
    double total = 0.0;
    for (const auto& row : this->joints) total += row.dual();
    return total;
  }
};

}  // namespace grasp
