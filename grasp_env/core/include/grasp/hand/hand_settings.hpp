// Settings of the hand controller, and what it reports of its work.
#pragma once
#include <grasp/problem.hpp>

namespace grasp {

// A spring and damper that draws a tip to its place.
struct Spring {
  double gain = 0.0, damping = 0.0, limit = infinity;  // [N/m], [N s/m], largest force [N]
};

struct HandControllerSettings {
  // Contacts, for the controller's own solver; a given method has its own.
  double friction = 0.8;            // coefficient
  double torsional_friction = 0.0;  // [m] of soft fingertips; 0: hard ones
  double friction_margin = 0.75;    // share of the friction that forces may use
  double preload = 0.5;             // [N] of each touching finger, which does not count for it

  double rate = 1000.0;  // [Hz] of `update`
  double budget = 1e-4;  // [s] longer updates are counted
  // solver between two steps of the method, and within torque limits; its limit bounds the steps
  Options follow{.tolerance = 1e-4, .limit = 40};

  // Springs: those that are stiffer than the rate and the delay of the joints allow are softened.
  double joint_delay = 0.0;         // [s] of the measured joints
  Spring grip{1500.0, 16.0, 10.0};  // of a touching fingertip to its place on the target
  double reach_stiffness = 60.0;    // [N/m] of a finger that does not touch to its place,
  double reach_force = 0.3;         // critically damped; [N] its force on the object and
  double reach_limit = 2.0;         // the largest one on the way
  // [N m/rad], [N m s/rad] towards the home posture, for joints that the tips leave free
  double posture_stiffness = 0.01, posture_damping = 0.001;
  double damping = 0.0;  // [N m s/rad] of every joint

  double force_rate = 1000.0;      // [N/s] fastest change of a force beyond what balance requires
  double torque_rate = 50.0;       // [1/s] fastest change of a torque relative to its limit
  int release = 2;                 // updates without contact until a finger counts as free
  double stale = 0.02;             // [s] largest age of joints and contacts that are used
  double stale_wrench = infinity;  // [s] the same of the wrench
  double grace = 0.1, fade = 0.2;  // [s] time to keep the last forces without knowledge; time in
                                   // which they then fade

  // Of agents and of the controllers that are compared with this one.
  bool remembers = true;               // the method gets the last command, for starts that use it
  std::vector<double> directions{};    // (N, 3, K) [1], object frame: internal forces that an
                                       // adjustment of the start combines
  double squeeze = 40.0;               // [N] total normal force for `Hold::squeeze`
  Spring place{800.0, 4.0, infinity};  // of all fingertips, for `Hold::place`: never softened

  // Throws std::invalid_argument.
  void check() const {
    const auto require = [](bool good, const char* message) {
      if (!good) throw std::invalid_argument(message);
    };
    const auto finite = [](double value) { return value >= 0.0 && value < infinity; };
    require(rate > 0.0 && rate < infinity, "rate must be above 0 Hz");
    require(finite(friction) && friction > 0.0 && finite(torsional_friction),
            "friction must be above 0, and torsional_friction at least 0 m");
    require(friction_margin > 0.0 && friction_margin <= 1.0,
            "friction_margin must be above 0 and at most 1");
    require(finite(preload) && finite(squeeze), "preload and squeeze must be at least 0 N");
    require(budget >= 0.0, "budget must be at least 0 s");
    require(follow.limit >= 0 && release >= 0, "max_iterations and release must be at least 0");
    for (const Spring* spring : {&grip, &place})
      require(finite(spring->gain) && finite(spring->damping) && spring->limit >= 0.0,
              "stiffness, damping and limit of springs must be at least 0");
    require(reach_stiffness > 0.0 && reach_stiffness < infinity && finite(reach_force) &&
                reach_limit >= 0.0,
            "reach_stiffness must be above 0, and the forces of reaching fingers at least 0");
    require(finite(posture_stiffness) && finite(posture_damping) && finite(damping),
            "stiffness and damping of joints must be at least 0");
    require(force_rate > 0.0 && torque_rate > 0.0 && finite(force_rate) && finite(torque_rate),
            "force_rate and torque_rate must be above 0");
    require(
        finite(stale) && stale_wrench >= 0.0 && finite(grace) && finite(fade) && fade > 0.0 &&
            finite(joint_delay),
        "stale, grace, joint_delay and fade must be finite and at least 0 s, fade above it, and "
        "stale_wrench at least 0 s");
  }
};

// Call f(name, value) for the settings of a controller with its own solver.
template <class Settings, class F> void each_setting(Settings& s, F&& f) {
  f("friction", s.friction);
  f("torsional_friction", s.torsional_friction);
  f("friction_margin", s.friction_margin);
  f("preload", s.preload);
  f("rate", s.rate);
  f("budget", s.budget);
  f("tolerance", s.follow.tolerance);
  f("max_iterations", s.follow.limit);
  f("joint_delay", s.joint_delay);
  f("grip", s.grip);
  f("place", s.place);
  f("squeeze", s.squeeze);
  f("reach_stiffness", s.reach_stiffness);
  f("reach_force", s.reach_force);
  f("reach_limit", s.reach_limit);
  f("posture_stiffness", s.posture_stiffness);
  f("posture_damping", s.posture_damping);
  f("damping", s.damping);
  f("force_rate", s.force_rate);
  f("torque_rate", s.torque_rate);
  f("release", s.release);
  f("stale", s.stale);
  f("stale_wrench", s.stale_wrench);
  f("grace", s.grace);
  f("fade", s.fade);
}

// Effort of solvers and motors since its owner last cleared it.
struct Effort {
  long long iterations = 0, trials = 0;  // of the method: accepted steps, and all steps tried
  long long followed = 0;                // iterations between two solves of the method
  long long limited = 0;     // those of Newton within the torque limits, when a force exceeded them
  bool saturated = false;    // torques were cut: no force within the limits was found
  double margin = infinity;  // smallest distance of a torque from its limit [N m]
  double share = 0.0;        // largest torque as a fraction of its limit
};

// How the forces of an update balance the wrench, the best first.
enum class Balance {
  within_margin,
  marginal,    // nearly, or beyond the margin
  overloaded,  // beyond the motors' limits, but least
  pivoting,    // all but a moment that no contact resists, as that about the line through two
  none         // the forces within the margin with the smallest imbalance
};

// Behaviour of the fingers in contact.
enum class Hold {
  optimized,  // the optimal force within the margin, and the grip's springs
  squeeze,    // a constant internal force plus the balancing force
  place,      // no force: every finger holds its place
  direct,     // forces that an agent's step gives
  reach,      // no force: every finger is drawn to its contact
};

// What an agent wants of an update. Every member is optional.
struct StepRequest {
  // (K,) [N] along `directions`: added to the start, which is then brought inside the cones
  Doubles adjustment{};
  Start start = Start::standard;  // of the method: by its own rule, or `Start::given`
  // (N, 3) [N], contact frames: the start for `Start::given`, or the command for `Hold::direct`
  Doubles force{};
  // (N, 3) [N], contact frames: moves the optimal forces to the nearest of their sum that balance
  // the wrench within the margin
  Doubles residual{};
  // from this update on, in place of that of the method; ignored unless `is_sound`
  struct GripMargin {
    double friction, preload;  // above 0, at most 1; [N] at least 0
    bool is_sound() const {
      return friction > 0.0 && friction <= 1.0 && preload >= 0.0 && std::isfinite(preload);
    }
  };
  std::optional<GripMargin> margin{};
};

}  // namespace grasp
