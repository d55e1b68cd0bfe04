// Contacts of a hand without tactile sensors: the force of every fingertip, from joint angles,
// rates and the torques that the motors deliver.
//
// An observer of the generalised momentum p = M(q) q' finds the torques r of the contacts on the
// joints (De Luca and Mattone 2003; Haddadin, De Luca and Albu-Schaeffer 2017):
//
//     r = K (p - p(0) - integral of (torques - g(q) + r) dt),   K = 1 / `time_constant`
//
// It needs no accelerations. Torques of the order of q'^2 (Coriolis) are neglected. In an Allegro
// whose joints swing at 6 rad/s they are 8e-3 N m, or 0.03 N along the normals. They fall with the
// square of the rates. The inertia of rotors is neglected, too. The friction of the joints is not
// known: a friction of F N m hides F / L newtons at a lever of L m, and the joints of a finger add
// up.
//
// `ContactEstimator` and its setters allocate and throw std::invalid_argument. `update` and `reset`
// do neither.
#pragma once
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <grasp/hand/hand_state.hpp>
#include <grasp/hand/surface.hpp>
#include <grasp/hand/tree.hpp>
#include <grasp/math/cholesky.hpp>

namespace grasp {

struct ContactEstimatorSettings {
  // [N] along the normal: a finger touches from `touch` on, and until its force falls below
  // `release`
  double touch = 0.2, release = 0.1;
  double time_constant = 0.01;  // [s] of the observer
  // [m] a fingertip farther from the surface of the object does not touch it, whatever its force
  double largest_gap = 0.005;

  // Throws std::invalid_argument.
  void check() const {
    const auto require = [](bool good, const char* message) {
      if (!good) throw std::invalid_argument(message);
    };
    require(release >= 0.0 && touch > release && touch < infinity,
            "touch must be finite and above release, and release at least 0 N");
    require(time_constant >= 0.0 && time_constant < infinity,
            "time_constant must be finite and at least 0 s");
    require(largest_gap >= 0.0, "largest_gap must be at least 0 m");
  }
};

// N fingertips, M joints.
class ContactEstimator {
 public:
  std::vector<double> residual;  // (M,) torques of the contacts on the joints [N m]
  std::vector<Point> forces;     // (N,) of the fingertips ON the object [N], base frame
  std::vector<double> gaps;      // (N,) from tip to surface [m]; NaN: no surface is known

  ContactEstimator(std::shared_ptr<const Tree> hand, const ContactEstimatorSettings& settings)
      : residual(hand->joints()),
        forces(hand->fingers()),
        gaps(hand->fingers(), NOT_KNOWN),
        tree_(std::move(hand)),
        settings_(settings),
        posture_(tree_),
        momentum_(residual),
        last_momentum_(residual),
        support_(residual),
        touching_(gaps.size()),
        points_(forces),
        inwards_(forces),
        guesses_(forces),
        push_(3 * forces.size()),
        jacobian_(push_.size() * residual.size()),
        gram_(int(push_.size())) {
    settings.check();
  }

  // The contacts follow from the surface of the object and its pose in the state.
  void set_surface(Surface surface) { surface_ = std::move(surface); }
  // Without a surface: the contacts are where fingertips touch planes with these unit normals
  // (N, 3) into the object, object frame.
  void set_normals(std::span<const double> normals) {
    if (normals.size() != push_.size())
      throw std::invalid_argument("normals must be (N, 3), one for each fingertip");
    for (std::size_t i = 0; i < guesses_.size(); ++i)
      if (!HandState::is_unit(normals.subspan(3 * i, 3)))
        throw std::invalid_argument("normals must be finite and of length 1, to 1 %");
    for (std::size_t i = 0; i < guesses_.size(); ++i)
      guesses_[i] = normalised(point(&normals[3 * i]));
    surface_.reset();
    has_normals_ = true;
    std::fill(gaps.begin(), gaps.end(), NOT_KNOWN);
  }

  // Forget all forces. The next update takes the hand to be at rest.
  void reset() noexcept {
    std::fill(residual.begin(), residual.end(), 0.0);
    std::fill(forces.begin(), forces.end(), Point{0.0, 0.0, 0.0});
    std::fill(touching_.begin(), touching_.end(), 0.0);
    has_residual_ = has_momentum_ = is_placed_ = false;
  }

  // Write TOUCHING, POSITIONS and NORMALS of a state from its ANGLES, RATES, GRAVITY and OBJECT.
  // torques: (M,) mean of the torques that the motors delivered since the last update [N m]; those
  // of coupled joints count for nothing. period: since the last update [s]. False if the state is
  // of another hand, if a number is not finite or a quaternion not of length 1, or without surface
  // and normals: then the last estimate stays.
  bool update(HandState& state, std::span<const double> torques, double period) noexcept {
    if (!is_like(state)) return false;
    const bool good = is_good(state, torques, period) && (surface_ || has_normals_);
    if (good) {
      posture_.trace(state[ANGLES].data());
      observe(state, torques, period);
      place(state);
      find_forces();
      find_touching();
    } else {
      has_momentum_ = false;
    }
    write(state);
    return good;
  }

  const Tree& tree() const { return *tree_; }
  const ContactEstimatorSettings& settings() const { return settings_; }

 private:
  static constexpr double NOT_KNOWN = std::numeric_limits<double>::quiet_NaN();
  // [m] A force with a smaller lever on all joints of its finger is hardly seen, and counts as 0.
  static constexpr double SMALLEST_LEVER = 2e-3;

  std::shared_ptr<const Tree> tree_;
  ContactEstimatorSettings settings_;
  Posture posture_;
  std::optional<Surface> surface_;
  std::vector<double> momentum_, last_momentum_;  // (M,) [N m s]
  std::vector<double> support_;                   // (M,) torques that carry the links [N m]
  std::vector<double> touching_;                  // (N,) 1 or 0
  Rotation turn_;                                 // object frame to base frame
  std::vector<Point> points_, inwards_;           // (N,) contacts [m], normals, object frame
  std::vector<Point> guesses_;                    // (N,) normals without a surface
  std::vector<double> push_;                      // (3N,) right-hand side, then forces [N]
  std::vector<double> jacobian_;                  // (3N, M) of the contact points
  Cholesky gram_;
  bool has_normals_ = false;
  bool has_residual_ = false, has_momentum_ = false;  // of the last update
  bool is_placed_ = false;                            // points_ and inwards_ are set

  bool is_like(const HandState& state) const {
    return state[ANGLES].size() == residual.size() && state[TOUCHING].size() == forces.size();
  }
  bool is_good(const HandState& state, std::span<const double> torques, double period) const {
    const auto finite = [](double number) { return std::abs(number) <= LARGEST; };
    for (HandPart part : {ANGLES, RATES, GRAVITY, OBJECT})
      if (!std::ranges::all_of(state[part], finite)) return false;
    return HandState::is_unit(state.object().quaternion) && torques.size() == residual.size() &&
           std::ranges::all_of(torques, finite) && period >= 0.0 && period <= LARGEST;
  }

  static Rotation turn_of(BodyRow object) {
    HandState::make_unit(object.quaternion);
    return Rotation::of_quaternion(object.quaternion);
  }

  // The residual after a period. The observer's integral is exact for constant torques of the
  // contacts within it, so it is stable for any period.
  void observe(const HandState& state, std::span<const double> torques, double period) {
    posture_.support(point(state[GRAVITY].data()), support_.data());
    posture_.momentum(state[RATES].data(), momentum_.data());
    const double share =
        settings_.time_constant > 0.0 ? -std::expm1(-period / settings_.time_constant) : 1.0;
    for (int j = 0; j < tree_->joints(); ++j) {
      if (tree_->links[j].coupled()) continue;
      const double known = torques[j] - support_[j];
      double next = residual[j];
      if (!has_residual_)
        next = -known;
      else if (has_momentum_ && period > 0.0)
        next += share * ((momentum_[j] - last_momentum_[j]) / period - known - next);
      if (std::isfinite(next)) residual[j] = next;
    }
    last_momentum_ = momentum_;
    has_residual_ = has_momentum_ = true;
  }

  // The contacts, and the Jacobian of their points.
  void place(const HandState& state) {
    const BodyRow& object = state.object();
    const Rotation turn = turn_of(object);
    for (int i = 0; i < tree_->fingers(); ++i) {
      const Tip& tip = tree_->tips[i];
      const Point center = posture_.tip(i);
      inwards_[i] = guesses_[i];
      if (surface_) {
        const Nearest nearest = surface_->nearest(turn.transposed(center - object.position));
        inwards_[i] = nearest.inward;
        gaps[i] = nearest.distance - tip.radius;
      }
      const Point touch = center + tip.radius * (turn * inwards_[i]);
      points_[i] = turn.transposed(touch - object.position);
      posture_.jacobian(tip.link, touch, &jacobian_[3 * residual.size() * i]);
    }
    turn_ = turn;
    is_placed_ = true;
  }
  // The smallest forces of least squares with J^T forces = -residual. All fingers together, as they
  // may share joints.
  void find_forces() {
    const int rows = int(push_.size());
    const int joints = tree_->joints();
    for (int a = 0; a < rows; ++a) {
      const double* row = &jacobian_[std::size_t(joints) * a];
      push_[a] = 0.0;
      for (int j = 0; j < joints; ++j) push_[a] -= row[j] * residual[j];
      for (int b = 0; b <= a; ++b) {
        const double* other = &jacobian_[std::size_t(joints) * b];
        gram_(a, b) = a == b ? SMALLEST_LEVER * SMALLEST_LEVER : 0.0;
        for (int j = 0; j < joints; ++j) gram_(a, b) += row[j] * other[j];
      }
    }
    if (!gram_.factor()) return;
    gram_.solve(push_.data());
    if (!std::ranges::all_of(push_, [](double force) { return std::isfinite(force); })) return;
    for (std::size_t i = 0; i < forces.size(); ++i) forces[i] = point(&push_[3 * i]);
  }
  void find_touching() {
    for (std::size_t i = 0; i < forces.size(); ++i) {
      const double normal = dot(forces[i], turn_ * inwards_[i]);
      const double least = touching_[i] != 0.0 ? settings_.release : settings_.touch;
      touching_[i] = normal >= least && !(gaps[i] > settings_.largest_gap);
    }
  }
  void write(HandState& state) const {
    std::ranges::copy(touching_, state[TOUCHING].begin());
    if (!is_placed_) return;
    for (std::size_t i = 0; i < forces.size(); ++i)
      for (int k = 0; k < 3; ++k) {
        state[POSITIONS][3 * i + k] = points_[i][k];
        state[NORMALS][3 * i + k] = inwards_[i][k];
      }
  }
};

}  // namespace grasp
