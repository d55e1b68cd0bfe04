// Newton's step by QR, for forces that are very large compared with their distance to the cones,
// and for contacts that hardly span the wrench space.
#pragma once
#include <grasp/phi/cones.hpp>
#include <grasp/math/qr6.hpp>

namespace grasp {

// The step in scaled coordinates z, H^-1 = M M^T: minimise |z + M^T grad| subject to G M z = -left.
// Small eigenvalues of H^-1 keep their digits beside large ones, and S, whose condition number is
// the square of that of G M, is never formed.
//
// The squeezing cost is linear, so H is the barrier's alone. With a barrier t times as strong
// the step is centring + part * descent, part = 1 / t, from the same factorisation.
template <class V, int B, int D = 3> class QrSystem {
 public:
  using Field = typename Cones<V, B, D>::Field;

  explicit QrSystem(const Cones<V, B, D>& cones)
      : qr_(int(cones.blocks.size())),
        descent_(qr_.rows()),
        centring_(qr_.rows()),
        change_(qr_.rows()) {
    resize(axes_, cones.blocks.size());
  }

  // Both directions at x with the balance residual `left`. Return false if G M does not have rank 6
  // in floating point.
  bool assemble(const Cones<V, B, D>& cones, const Field& x, const Vec6& left, Field& descent,
                Field& centring) {
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      const auto& c = cones.blocks[b];
      const Axes<V, D>& a = axes_[b] = Axes<V, D>(x[b], c.weights);
      const V squeeze[D] = {c.mask * a.squeeze.along, c.mask * a.squeeze.inward};
      const V barrier[D] = {c.mask * a.barrier.along, c.mask * a.barrier.inward};
      for (int k = 0; k < D; ++k) {
        for (int r = 0; r < 6; ++r) qr_.set(b, k, r, dot(c.g[r], a[k]));
        qr_.put(descent_, b, k, -squeeze[k]);
        qr_.put(centring_, b, k, -barrier[k]);
      }
    }
    if (!qr_.factor()) return false;
    nu_descent_ = -1.0 * qr_.reject(descent_);
    nu_centring_ = -1.0 * qr_.reject(centring_);
    square_ = slope_ = rest_ = 0.0;
    for (int i = 0; i < int(descent_.size()); ++i) {
      square_ += descent_[i] * descent_[i];
      slope_ += descent_[i] * centring_[i];
      rest_ += centring_[i] * centring_[i];
    }
    nu_centring_ = nu_centring_ + qr_.least(-1.0 * left, change_);
    for (int b = 0; b < int(descent.size()); ++b) descent[b] = centring[b] = Vec<V, D>{};
    add(descent_, descent);
    add(centring_, centring);
    add(change_, centring);
    return true;
  }

  // Squared decrement, and multipliers of Phi, of the step for a part of the squeezing cost.
  double decrement(double part) const { return (part * square_ + 2.0 * slope_) * part + rest_; }
  Vec6 multipliers(double part) const { return nu_descent_ + (1.0 / part) * nu_centring_; }
  // The part of the squeezing cost at which the step is shortest; may be negative.
  double nearest_part() const { return -slope_ / square_; }

  // step += the smallest change in the metric of Phi that removes `missed` from G step.
  void restore(const Vec6& missed, Field& step) {
    qr_.least(-1.0 * missed, change_);
    add(change_, step);
  }

 private:
  LaneQr6<V, D> qr_;
  Blocks<Axes<V, D>, B> axes_;
  std::vector<double> descent_, centring_, change_;  // z
  Vec6 nu_descent_{}, nu_centring_{};
  double square_ = 0.0, slope_ = 0.0, rest_ = 0.0;  // |descent|^2, descent . centring, |centring|^2

  void add(const std::vector<double>& z, Field& step) const {
    for (int b = 0; b < int(step.size()); ++b)
      for (int k = 0; k < D; ++k) step[b] += qr_.get(z, b, k) * axes_[b][k];
  }
};

}  // namespace grasp
