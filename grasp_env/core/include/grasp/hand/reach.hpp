// Inverse kinematics: damped least squares within the joint limits.
//
// Fingers that share a joint are solved together, as a group. With J the Jacobian of a group's
// tips, e their remaining error and f the joints that may move, a step is J_f^T (J_f J_f^T + d
// I)^-1 e, the shortest with this effect, so redundant joints stay near their start. The damping d
// shrinks with |e|^2, so the last steps are Newton's. A joint that would pass its limit stops there
// and the others compensate.
#pragma once
#include <grasp/math/cholesky.hpp>
#include <grasp/hand/tree.hpp>

namespace grasp {

inline constexpr double REACHED = 1e-9;  // [m] accepted distance of a tip from its target

struct FingerGroup {
  std::vector<int> fingers, joints;
};

class Reach {
 public:
  std::vector<FingerGroup> groups;

  explicit Reach(std::shared_ptr<const Tree> tree, bool limited = true)
      : groups(groups_of(*tree)),
        tree_(tree),
        posture_(tree),
        trial_(tree->joints()),
        best_(trial_) {
    for (const Link& link : tree->links) {
      lower_.push_back(limited ? link.lower : -infinity);
      upper_.push_back(limited ? link.upper : infinity);
    }
    for (const FingerGroup& group : groups) work_.emplace_back(group);
  }

  const Tree& tree() const { return *tree_; }

  // Find the angles (M,) at which the tips are nearest to their targets (N,) [m], from starts (S,
  // M) in order. missed: (G,) distance of the worst tip of each group [m]. Joints that move no
  // finger stay as in the first start.
  void solve(const Point* targets, const double* starts, int count, double* angles,
             double* missed) {
    const int joints = tree_->joints();
    std::copy(starts, starts + joints, angles);
    for (std::size_t g = 0; g < groups.size(); ++g) {
      missed[g] = infinity;
      for (int s = 0; s < count && missed[g] > REACHED; ++s) {
        std::copy(starts + joints * s, starts + joints * (s + 1), best_.begin());
        const double distance = move_to_targets(groups[g], work_[g], targets);
        if (!(distance < missed[g])) continue;
        missed[g] = distance;
        for (int j : groups[g].joints) angles[j] = best_[j];
      }
    }
    tree_->couple(angles);
  }

 private:
  static constexpr double EXACT = 1e-14;  // [m]; rounding of positions of 0.1 m
  // [rad] so that a step does not skip the nearest solution
  static constexpr double LARGEST_STEP = 0.6;
  static constexpr double SLOW = 0.98;  // a step that leaves more of |e|^2 than this is slow
  // slow steps, or steps that come no nearer, in a row: a dead end
  static constexpr int MOST_STEPS = 80, MOST_SLOW = 3, MOST_REFUSED = 8;

  struct Work {
    // (3 tips, joints), (3 tips,) each, (joints,)
    std::vector<double> jacobian, error, rest, vector, step;
    std::vector<char> free;
    Cholesky matrix;

    explicit Work(const FingerGroup& group)
        : jacobian(3 * group.fingers.size() * group.joints.size()),
          error(3 * group.fingers.size()),
          rest(error),
          vector(error),
          step(group.joints.size()),
          free(group.joints.size()),
          matrix(int(error.size())) {}
  };
  std::shared_ptr<const Tree> tree_;
  Posture posture_;
  std::vector<double> trial_, best_, lower_, upper_;  // (M,)
  std::vector<Work> work_;

  // Move the joints of a group in `best_` until its tips are at their targets. Return the distance
  // of the worst tip [m].
  double move_to_targets(const FingerGroup& group, Work& work, const Point* targets) {
    trial_ = best_;
    double missed = infinity, best = infinity, factor = 0.5;
    for (int round = 0, slow = 0, refused = 0; round < MOST_STEPS; ++round) {
      tree_->couple(trial_.data());
      posture_.trace(trial_.data());
      double total = 0.0, worst = 0.0;
      for (std::size_t i = 0; i < group.fingers.size(); ++i) {
        const Point away = targets[group.fingers[i]] - posture_.tip(group.fingers[i]);
        for (int k = 0; k < 3; ++k) work.rest[3 * i + k] = away[k];
        total += dot(away, away);
        worst = std::max(worst, dot(away, away));
      }
      if (total < best) {
        slow = total > SLOW * best ? slow + 1 : 0;
        refused = 0;
        missed = std::sqrt(worst);
        best = total;
        factor *= 0.2;
        for (int j : group.joints) best_[j] = trial_[j];
        if (missed <= EXACT || slow == MOST_SLOW) break;
        work.error = work.rest;
        differentiate(group, work);
      } else {
        factor = 8.0 * std::max(factor, 1e-3);
        if (++refused == MOST_REFUSED || missed <= REACHED) break;
      }
      const double largest = write_step(group, work, factor * best);
      const double scale = largest > LARGEST_STEP ? LARGEST_STEP / largest : 1.0;
      for (std::size_t a = 0; a < group.joints.size(); ++a) {
        const int j = group.joints[a];
        trial_[j] = std::min(std::max(best_[j] + scale * work.step[a], lower_[j]), upper_[j]);
      }
    }
    return missed;
  }

  void differentiate(const FingerGroup& group, Work& work) const {
    const std::size_t joints = group.joints.size();
    std::fill(work.jacobian.begin(), work.jacobian.end(), 0.0);
    for (std::size_t i = 0; i < group.fingers.size(); ++i) {
      const int finger = group.fingers[i];
      posture_.each_moving_joint(
          tree_->tips[finger].link, posture_.tip(finger), [&](int j, const Point& moves) {
            const auto a = std::lower_bound(group.joints.begin(), group.joints.end(), j) -
                           group.joints.begin();
            for (int k = 0; k < 3; ++k) work.jacobian[(3 * i + k) * joints + a] += moves[k];
          });
    }
  }

  // Write the damped step of the free joints, which stop at their limits. Return the largest turn.
  double write_step(const FingerGroup& group, Work& work, double damping) {
    const int rows = int(work.error.size());
    const int joints = int(group.joints.size());
    const auto entry = [&](int i, int a) { return work.jacobian[i * joints + a]; };
    work.rest = work.error;
    for (int a = 0; a < joints; ++a) {
      double pull = 0.0;
      for (int i = 0; i < rows; ++i) pull += entry(i, a) * work.error[i];
      const double at = best_[group.joints[a]];
      work.step[a] = 0.0;
      work.free[a] = !((at <= lower_[group.joints[a]] && pull < 0.0) ||
                       (at >= upper_[group.joints[a]] && pull > 0.0));
    }
    for (int round = 0, stopped = 1; stopped && round <= joints; ++round) {
      stopped = 0;
      double trace = 0.0;
      for (int i = 0; i < rows; ++i) {
        for (int k = 0; k <= i; ++k) {
          double total = 0.0;
          for (int a = 0; a < joints; ++a)
            if (work.free[a]) total += entry(i, a) * entry(k, a);
          work.matrix(i, k) = total;
        }
        trace += work.matrix(i, i);
      }
      for (int i = 0; i < rows; ++i) work.matrix(i, i) += damping + 1e-12 * trace + 1e-18;
      work.matrix.factor(1e-30);
      work.vector = work.rest;
      work.matrix.solve(work.vector.data());
      for (int a = 0; a < joints; ++a) {
        if (!work.free[a]) continue;
        work.step[a] = 0.0;
        for (int i = 0; i < rows; ++i) work.step[a] += entry(i, a) * work.vector[i];
        const double at = best_[group.joints[a]];
        const double low = lower_[group.joints[a]] - at;
        const double high = upper_[group.joints[a]] - at;
        if (work.step[a] >= low && work.step[a] <= high) continue;
        work.step[a] = std::min(std::max(work.step[a], low), high);
        work.free[a] = 0;
        stopped = 1;
        for (int i = 0; i < rows; ++i) work.rest[i] -= entry(i, a) * work.step[a];
      }
    }
    double largest = 0.0;
    for (double turn : work.step) largest = std::max(largest, std::abs(turn));
    return largest;
  }

  static std::vector<FingerGroup> groups_of(const Tree& tree) {
    std::vector<FingerGroup> out;
    for (int finger = 0; finger < tree.fingers(); ++finger) {
      const std::vector<int> joints = tree.movers(finger);
      FingerGroup merged{{finger}, joints};
      std::vector<FingerGroup> rest;
      for (FingerGroup& group : out) {
        const bool shares = std::any_of(joints.begin(), joints.end(), [&](int j) {
          return std::binary_search(group.joints.begin(), group.joints.end(), j);
        });
        if (!shares) {
          rest.push_back(std::move(group));
          continue;
        }
        merged.fingers.insert(merged.fingers.end(), group.fingers.begin(), group.fingers.end());
        merged.joints.insert(merged.joints.end(), group.joints.begin(), group.joints.end());
      }
      std::sort(merged.fingers.begin(), merged.fingers.end());
      std::sort(merged.joints.begin(), merged.joints.end());
      merged.joints.erase(std::unique(merged.joints.begin(), merged.joints.end()),
                          merged.joints.end());
      rest.push_back(std::move(merged));
      out = std::move(rest);
    }
    std::sort(out.begin(), out.end(),
              [](const auto& a, const auto& b) { return a.fingers[0] < b.fingers[0]; });
    return out;
  }
};

}  // namespace grasp
