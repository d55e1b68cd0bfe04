// An agent's change of the optimal forces.
#pragma once
#include <grasp/hand/hand_model.hpp>
#include <grasp/hand/margin_cones.hpp>
#include <grasp/phi/nearest.hpp>

namespace grasp {

class ResidualForces {
 public:
  // The model must outlive this object.
  explicit ResidualForces(const HandModel& model)
      : model_(model),
        projection_(model.tree->fingers()),
        residual_(3 * model.tree->fingers()),
        moved_(residual_),
        torsion_(model.tree->fingers()),
        torques_(model.tree->joints()),
        more_(torques_) {}

  void reset() { asked_ = false; }
  // Set the change (N, 3) [N], contact frames, of an agent's step; empty: none.
  void set(Doubles residual) {
    asked_ = residual.size() == residual_.size() &&
             std::ranges::any_of(residual, [](double part) { return part != 0.0; });
    if (asked_) std::ranges::copy(residual, residual_.begin());
  }
  bool asked() const { return asked_; }
  // Move optimal forces (N, 3) [N], contact frames, and torsions (N,) [N m] of the fingers of a
  // mask towards the nearest ones to their sum with the change that balance a wrench within the
  // cones and preloads, as far as the motors can. Without such forces they stay.
  void add(const MarginCones& cones, std::uint64_t mask, const double* positions,
           const Vec6& wrench, const std::vector<double>& preload, std::vector<double>& force,
           std::vector<double>& torsion) {
    for (std::size_t j = 0; j < force.size(); ++j) moved_[j] = force[j] + residual_[j];
    torsion_ = torsion;
    if (!projection_.solve(cones.contacts, mask, positions, model_.frames.data(), wrench, preload,
                           moved_.data(), torsion_.data()))
      return;
    model_.torques_of(mask, force.data(), torsion.data(), torques_);
    model_.torques_of(mask, moved_.data(), torsion_.data(), more_);
    for (std::size_t j = 0; j < torques_.size(); ++j) more_[j] -= torques_[j];
    const double share = model_.share_within(more_, torques_);
    each_finger(mask, [&](int i) {
      for (int j = 3 * i; j < 3 * i + 3; ++j) force[j] += share * (moved_[j] - force[j]);
      torsion[i] += share * (torsion_[i] - torsion[i]);
    });
  }

 private:
  const HandModel& model_;
  NearestForces projection_;
  bool asked_ = false;
  std::vector<double> residual_, moved_, torsion_;  // (N, 3), (N, 3) [N], (N,) [N m]
  std::vector<double> torques_, more_;              // (M,) [N m]
};

}  // namespace grasp
