// The springs of the fingers in contact, and the normal forces that carry them.
#pragma once
#include <grasp/hand/hand_settings.hpp>
#include <grasp/hand/margin_cones.hpp>

namespace grasp {

class GripSprings {
 public:
  std::vector<Point> forces;    // (N,) [N], object frame
  std::vector<double> torques;  // (M,) of these [N m], in the posture at hand
  std::vector<double> preload;  // (N,) [N] for forces within the margin

  // Model and cones must outlive this object. margin: its preloads are the least ones.
  GripSprings(const HandModel& model, const MarginCones& cones, const Margin& margin,
              const HandControllerSettings& settings)
      : forces(model.tree->fingers()),
        torques(model.tree->joints()),
        preload(forces.size()),
        model_(model),
        cones_(cones),
        force_rate_(settings.force_rate),
        given_(forces.size()),
        whole_preload_(preload),
        whole_(forces),
        lasting_(forces) {
    set_own_preloads(margin.preload);
    reset();
  }

  void reset() {
    for (auto* numbers : {&torques, &preload, &whole_preload_})
      std::fill(numbers->begin(), numbers->end(), 0.0);
    for (auto* points : {&forces, &whole_, &lasting_})
      std::fill(points->begin(), points->end(), Point{0.0, 0.0, 0.0});
    share_ = 1.0;
  }
  // Set the least preloads [N].
  void set_own_preloads(const PerContact& least) {
    for (std::size_t i = 0; i < given_.size(); ++i) given_[i] = least[int(i)];
  }
  // Preload of a finger [N] without what carries its spring.
  double own_preload(int i) const { return std::min(preload[i], given_[i]); }
  // One of the springs pulls.
  bool any_pulls(std::uint64_t mask) const {
    return any(mask, [&](int i) { return dot(whole_[i], whole_[i]) > 0.0; });
  }
  // One of them needs more than the given preload.
  bool raise_preloads(std::uint64_t mask) const {
    return any(mask, [&](int i) { return whole_preload_[i] > given_[i]; });
  }
  // A preload differs from the given one.
  bool changes_preload(std::uint64_t mask) const {
    return any(mask, [&](int i) { return preload[i] != given_[i]; });
  }

  // Set the force of a spring [N], object frame, of a finger that pushes with a force (3,) [N],
  // contact frame, and a torsion [N m]. What would take more than half of its normal force is left
  // out. A spring balances errors of the motors and pushes, which are no part of the command, so
  // the two may leave the cone; but far outside it, the spring would only turn the object.
  void set(int i, const Point& spring, const double* force, double torsion) {
    constexpr double FAR = 4.0;    // times the distance of the force from the surface of its cone
    constexpr double SLACK = 1.0;  // [N] more
    const Point inward = model_.axis(i, 0);
    const double pull = dot(spring, inward) + 0.5 * force[0];
    const Point kept = pull < 0.0 ? spring - pull * inward : spring;
    const double beyond = cones_.beyond(i, kept);
    const double room = FAR * std::max(-cones_.beyond(i, force, torsion), 0.0) + SLACK;
    forces[i] = beyond > room ? room / beyond * kept : kept;
  }
  // Begin an update with `forces` of the fingers of a mask, less their share, and set their
  // preloads. The preload of a finger is that of the margin, or up to 1 N for a spring that pulls
  // for long. It grows as fast as a force may, from zero when a finger lands. period: [s]
  // since the last update. first: preloads are there at once.
  void begin(std::uint64_t mask, double period, bool first) {
    const double most = force_rate_ * period;
    const double part = period / (period + LASTING);
    for (std::size_t i = 0; i < preload.size(); ++i) {
      if (!(mask >> i & 1)) {
        forces[i] = whole_[i] = lasting_[i] = {0.0, 0.0, 0.0};
        preload[i] = whole_preload_[i] = 0.0;
        continue;
      }
      whole_[i] = forces[i] = share_ * forces[i];
      lasting_[i] += part * (forces[i] - lasting_[i]);
      const double wanted = std::max(given_[i], carrying(int(i)));
      whole_preload_[i] = preload[i] = first ? wanted : std::min(wanted, preload[i] + most);
    }
    push(mask);
  }
  // Set `torques` to those of `forces`.
  void push(std::uint64_t mask) {
    std::fill(torques.begin(), torques.end(), 0.0);
    each_finger(mask, [&](int i) {
      model_.posture.push(model_.tree->tips[i].link, model_.touch[i], model_.turn * forces[i],
                          torques.data());
    });
  }
  // Leave a share of what `begin` set: of the springs, and of the preload that carries them.
  void leave(std::uint64_t mask, double share) {
    each_finger(mask, [&](int i) {
      forces[i] = share * whole_[i];
      preload[i] = std::min(whole_preload_[i], std::max(given_[i], share * whole_preload_[i]));
    });
    push(mask);
  }
  // Let springs pull without the preloads that carry them.
  void keep_own_preloads(std::uint64_t mask) {
    each_finger(mask, [&](int i) { preload[i] = whole_preload_[i] = own_preload(i); });
  }
  // From now on springs have this share of the one that they had.
  void give_way(double share) {
    constexpr double LEAST = 1e-3;
    share_ *= share > 0.0 ? share : share_ > LEAST ? 0.5 : 0.0;
  }
  // Springs that gave way return. period: [s]
  void recover(double period) {
    constexpr double RETURNING = 1.0;  // [s]
    share_ = std::min(1.0, share_ + period / RETURNING);
  }

 private:
  // [s] a spring that pulls for longer than that gets normal force
  static constexpr double LASTING = 0.03;
  const HandModel& model_;
  const MarginCones& cones_;
  const double force_rate_;
  std::vector<double> given_, whole_preload_;  // (N,) [N]
  std::vector<Point> whole_, lasting_;         // (N,) [N], object frame: set by `begin`; filtered
  double share_ = 1.0;                         // less where they stand in the way of the forces

  template <class F> static bool any(std::uint64_t mask, F&& is) {
    bool found = false;
    each_finger(mask, [&](int i) { found = found || is(i); });
    return found;
  }
  // Normal force [N] with which the lasting force of a spring uses all of the friction. It is
  // bounded: errors of motors grow with the forces, and springs answer to these errors.
  double carrying(int i) const {
    constexpr double MOST = 1.0;  // [N]
    return std::clamp(cones_.lacking(i, lasting_[i]), 0.0, MOST);
  }
};

}  // namespace grasp
