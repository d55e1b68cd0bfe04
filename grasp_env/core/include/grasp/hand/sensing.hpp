// The controller's view of a scene, with delay and noise, and the external wrench as far as known.
#pragma once
#include <grasp/hand/balance.hpp>

namespace grasp {

// Estimates the external wrench from the object's motion, less contacts and gravity, with a filter:
// force = d(m v)/dt - sum f - m g and moment = d(R I R^T omega)/dt - sum p x f over one tick, in
// the object frame at its end. The forces must be means over that tick: those of the last physics
// step ring if contacts are stiff. Errors of the modelled mass or gravity appear as a wrench.
class WrenchEstimator {
 public:
  double tick = 1.0, keep = 0.0;  // [s]; fraction of its value that the filter keeps over a tick
  Vec6 estimate{};                // [N, N m], object frame

  // After a reset, the first call only records the momentum.
  void reset() { *this = {tick, keep}; }
  WrenchEstimator() = default;
  WrenchEstimator(double tick, double keep) : tick(tick), keep(keep) {}

  const Vec6& operator()(const Snapshot& seen, const Body& body, const Point& gravity) {
    const Point linear = body.mass * seen.linear;
    const Point angular = seen.rotation * (body.inertia * seen.to_object(seen.angular));
    if (started_) {
      const double rate = 1.0 / tick;
      Point force = seen.to_object(rate * (linear - linear_) - body.mass * gravity);
      Point moment = seen.to_object(rate * (angular - angular_));
      for (std::size_t i = 0; i < seen.forces.size(); ++i) {
        force -= seen.forces[i];
        moment -= cross(seen.points[i], seen.forces[i]);
      }
      estimate = keep * estimate +
                 (1.0 - keep) * Vec6{force.u, force.o, force.t, moment.u, moment.o, moment.t};
    }
    linear_ = linear;
    angular_ = angular;
    started_ = true;
    return estimate;
  }

 private:
  bool started_ = false;
  Point linear_{}, angular_{};  // momentum [N s], [N m s], world
};

// Paths of the tips on the object by sliding, since `reset`.
class Slides {
 public:
  explicit Slides(int fingers) : paths_(fingers) {}
  void reset() { std::fill(paths_.begin(), paths_.end(), Point{0.0, 0.0, 0.0}); }
  void add(const Snapshot& now, double tick) {
    for (std::size_t i = 0; i < paths_.size(); ++i)
      if (now.touching[i] > 0.0) paths_[i] += tick * now.sliding[i];
  }
  double operator[](std::size_t finger) const { return length(paths_[finger]); }  // [m]
  std::size_t size() const { return paths_.size(); }

 private:
  std::vector<Point> paths_;  // (N,) [m], object frame
};

enum class WrenchSource { measured, estimated, none };

struct SensorSettings {
  WrenchSource wrench = WrenchSource::measured;
  double tick = 0.0, keep = 0.0;  // [s]; filter of the estimate: see `WrenchEstimator`
  // ticks: of joints; of everything else; of measured wrenches in addition to that
  int joint_delay = 0, delay = 0, wrench_delay = 0;
  // standard deviations per axis: [m], fraction of the force
  double pose_noise = 0.0, tactile_noise = 0.0;
};

class Sensors {
 public:
  const SensorSettings settings;

  Sensors(std::shared_ptr<const Scene> scene, const SensorSettings& settings)
      : settings(settings),
        slid(scene->tree->fingers()),
        scene_(std::move(scene)),
        estimator_(settings.tick, settings.keep),
        seen_(scene_->now),
        slides_(scene_->tree->fingers()),
        reported_(settings.delay + settings.wrench_delay + 1) {
    if (!exact())  // `perfect` is not set yet
      delayed_.assign(std::max(settings.delay, settings.joint_delay) + 1, seen_);
  }
  Sensors(const Sensors&) = delete;

  bool perfect = false;  // ignore delay and noise, while the hand takes over the object
  bool exact() const {
    return perfect || !(settings.delay || settings.joint_delay || settings.pose_noise > 0.0 ||
                        settings.tactile_noise > 0.0);
  }
  const Snapshot& seen() const { return exact() ? scene_->now : seen_; }
  Vec6 external{};  // known wrench on the object [N, N m], object frame
  // (N,) distance that each tip slid on the object since `reset`, as the tip feels it [m]
  std::vector<double> slid;

  void reset() {
    estimator_.reset();
    std::fill(delayed_.begin(), delayed_.end(), scene_->now);
    std::fill(reported_.begin(), reported_.end(), Vec6{});
    slides_.reset();
    std::fill(slid.begin(), slid.end(), 0.0);
    tick_ = 0;
  }

  // Observe the scene of this tick. wrench: (6,) that a perfect sensor reports. noise: (3 + 3N,)
  // standard normal numbers if anything is noisy. gravity: as far as known.
  void see(const double* wrench, const double* noise, const Body& body, const Point& gravity) {
    if (!exact()) observe_with_delay(noise);
    feel(exact() ? scene_->now : ago(settings.delay));
    std::copy(wrench, wrench + 6, reported_[tick_ % reported_.size()].begin());
    ++tick_;
    switch (settings.wrench) {
      case WrenchSource::measured:
        external = reported_[tick_ % reported_.size()];
        break;
      case WrenchSource::estimated:
        external = estimator_(seen(), body, gravity);
        break;
      case WrenchSource::none:
        external = {};
        break;
    }
  }

 private:
  std::shared_ptr<const Scene> scene_;
  WrenchEstimator estimator_;
  std::vector<Snapshot> delayed_;
  Snapshot seen_;  // what is seen, unless it is the scene itself
  Slides slides_;  // what the tips feel
  std::vector<Vec6> reported_;
  std::size_t tick_ = 0;

  const Snapshot& ago(int ticks) const {
    return delayed_[(tick_ + delayed_.size() - ticks) % delayed_.size()];
  }
  void feel(const Snapshot& then) {
    slides_.add(then, settings.tick);
    for (std::size_t i = 0; i < slid.size(); ++i) slid[i] = slides_[i];
  }
  void observe_with_delay(const double* noise) {
    delayed_[tick_ % delayed_.size()] = scene_->now;
    seen_ = ago(settings.delay);
    seen_.angles = ago(settings.joint_delay).angles;
    seen_.rates = ago(settings.joint_delay).rates;
    seen_.position += settings.pose_noise * point(noise);
    for (std::size_t i = 0; i < seen_.forces.size(); ++i)
      seen_.forces[i] +=
          settings.tactile_noise * length(seen_.forces[i]) * point(noise + 3 + 3 * i);
    if (settings.delay || settings.joint_delay)
      seen_.advance(*scene_->tree, scene_->surface, scene_->gravity,
                    settings.joint_delay * settings.tick, settings.delay * settings.tick);
  }
};

}  // namespace grasp
