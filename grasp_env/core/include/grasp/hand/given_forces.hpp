// Forces of the fingers in contact that are not optimised: an agent's own, and a constant squeeze.
#pragma once
#include <grasp/hand/hand_model.hpp>
#include <grasp/hand/hand_settings.hpp>
#include <grasp/optimizer.hpp>

namespace grasp {

class GivenForces {
 public:
  // The model must outlive this object. method: one contact per finger
  GivenForces(const HandModel& model, const ForceOptimizer& method,
              const HandControllerSettings& settings)
      : model_(model),
        squeeze_(settings.squeeze),
        solver_({method.contacts(), {}, method.margin()}, settings.follow),
        row_(solver_.size()),
        direct_(3 * model.tree->fingers()),
        squeezed_(direct_) {}

  void reset() {
    std::fill(direct_.begin(), direct_.end(), 0.0);
    mask_ = 0;
  }
  // force (N, 3) [N], contact frames: of the fingers of a mask, under `Hold::direct` or
  // `Hold::squeeze`. step: an agent's step that begins.
  void find(Hold hold, const HandState& state, std::uint64_t mask, const StepRequest* step,
            std::vector<double>& force) {
    const auto finite = [](double number) { return std::isfinite(number); };
    if (hold == Hold::direct && step && step->force.size() == direct_.size() &&
        std::ranges::all_of(step->force, finite))
      std::ranges::copy(step->force, direct_.begin());
    if (hold == Hold::squeeze && mask_ != mask) squeeze(state, mask);
    const std::vector<double>& from = hold == Hold::direct ? direct_ : squeezed_;
    each_finger(mask, [&](int i) { std::copy_n(&from[3 * i], 3, &force[3 * i]); });
    if (hold == Hold::squeeze) restore_balance(state, mask, force);
  }

 private:
  const HandModel& model_;
  const double squeeze_;   // [N] sum of the normal forces
  ForceOptimizer solver_;  // finds the internal force
  std::vector<double> row_;
  std::vector<double> direct_, squeezed_;  // (N, 3) [N], contact frames
  std::uint64_t mask_ = 0;                 // fingers for which `squeezed_` was computed

  // Compute an internal force of the fingers of a mask, where they are now.
  void squeeze(const HandState& state, std::uint64_t mask) {
    const double nothing[6] = {};
    solver_.solve(
        {.wrench = nothing,
         .now = {.positions = state[POSITIONS], .normals = state[NORMALS], .contacts = mask}},
        row_.data());
    const Record row(row_.data());
    double total = 0.0;
    each_finger(mask, [&](int i) {
      for (int a = 0; a < 3; ++a)
        squeezed_[3 * i + a] = row.has_force() ? row.force()[3 * i + a] : a == 0;
      total += squeezed_[3 * i];
    });
    for (double& f : squeezed_) f *= squeeze_ / total;
    mask_ = mask;
  }
  // Restore balance by the least-norm change of the forces, as far as these contacts can.
  void restore_balance(const HandState& state, std::uint64_t mask, std::vector<double>& force) {
    // relative to the largest entry: with two contacts the matrix is singular
    constexpr double SHIFT = 1e-9;
    const auto column = [&](int i, int a) {
      return unit_wrench(state.position(i), model_.axis(i, a));
    };
    Packed6 gram{};
    Vec6 missed = state.wrench();
    each_finger(mask, [&](int i) {
      for (int a = 0; a < 3; ++a) {
        missed = missed + force[3 * i + a] * column(i, a);
        add_gram(gram, column(i, a));
      }
    });
    double largest = 0.0;
    for (int r = 0; r < 6; ++r) largest = std::max(largest, gram[packed(r, r)]);
    for (int r = 0; r < 6; ++r) gram[packed(r, r)] += SHIFT * largest;
    Ldl6 factor;
    if (!(factor.factor(gram) > 0.0)) return;
    const Vec6 pull = factor.solve(missed);
    each_finger(mask, [&](int i) {
      for (int a = 0; a < 3; ++a) force[3 * i + a] -= dot(column(i, a), pull);
    });
  }
};

}  // namespace grasp
