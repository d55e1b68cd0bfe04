// From joint torques to the units of a hand's motors.
#pragma once
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <vector>
#include <grasp/hand/tree.hpp>

namespace grasp {

// Tables from torques [N m] to device units, piecewise linear for each joint and clipped at their
// ends, and what the joints lose. Empty vectors mean no loss.
struct Calibration {
  using Numbers = std::vector<double>;
  std::vector<Numbers> torques, units;  // of each joint: ascending through zero; as many
  Numbers friction;   // (M,) [N m] Coulomb friction: added in the direction of the wanted motion
  Numbers dead_band;  // (M,) device units that do not move the motor: added in that of the torque
  // [N m] torque of the springs, and torque, from which friction and dead band count in full; below
  // they fade, so that a joint at rest does not chatter
  double fade = 0.01;
  double resolution = 1.0;  // commands are multiples of it, in device units; 0: any number

  // The motors take N m.
  static Calibration newton_metres(const Tree& hand) {
    Calibration out;
    out.resolution = 0.0;
    for (const Link& link : hand.links) {
      const double limit = std::min(link.torque_limit, LARGEST);
      out.torques.push_back({-limit, limit});
      out.units.push_back({-limit, limit});
    }
    return out;
  }
  // The motors take currents. Each (M,): torque constants [N m/A], largest currents [A], device
  // units per ampere.
  static Calibration currents(const Numbers& torque_constant, const Numbers& largest,
                              const Numbers& units_per_ampere) {
    if (largest.size() != torque_constant.size() ||
        units_per_ampere.size() != torque_constant.size())
      throw std::invalid_argument(
          "torque constants, largest currents and units per ampere need one number for each joint");
    Calibration out;
    for (std::size_t j = 0; j < torque_constant.size(); ++j) {
      const double torque = torque_constant[j] * largest[j];
      const double unit = largest[j] * units_per_ampere[j];
      out.torques.push_back({-torque, torque});
      out.units.push_back({-unit, unit});
    }
    return out;
  }

  // Throws std::invalid_argument unless it fits a hand of so many joints.
  void check(int joints) const {
    const auto require = [](bool good, const char* message) {
      if (!good) throw std::invalid_argument(message);
    };
    require(int(torques.size()) == joints && int(units.size()) == joints,
            "a calibration needs a table of torques and one of units for each joint");
    for (int j = 0; j < joints; ++j) {
      bool ascends = torques[j].size() >= 2 && torques[j].size() == units[j].size();
      for (std::size_t k = 1; ascends && k < torques[j].size(); ++k)
        ascends = torques[j][k - 1] < torques[j][k];
      require(ascends && torques[j].front() < 0.0 && torques[j].back() > 0.0 &&
                  std::ranges::all_of(torques[j], is_finite) &&
                  std::ranges::all_of(units[j], is_finite),
              "a calibration needs for each joint finite torques that ascend through zero, and as "
              "many units");
    }
    for (const Numbers* loss : {&friction, &dead_band})
      require(loss->empty() ||
                  (int(loss->size()) == joints &&
                   std::ranges::all_of(*loss, [](double v) { return v >= 0.0 && is_finite(v); })),
              "friction and dead band of a calibration need one number >= 0 for each joint, or "
              "none");
    require(fade > 0.0 && is_finite(fade), "the fade of a calibration must be above 0");
    require(resolution >= 0.0 && is_finite(resolution),
            "the resolution of a calibration must be at least 0");
  }
  // Torque available in both directions [N m].
  double limit(int joint) const {
    const double end = std::min(-torques[joint].front(), torques[joint].back());
    return end < LARGEST ? end : infinity;
  }
  // Device units for a torque [N m]. wanted: torque of the springs [N m], whose sign is that of the
  // wanted motion.
  double operator()(int joint, double torque, double wanted) const {
    const auto faded = [&](double by) { return std::clamp(by / fade, -1.0, 1.0); };
    const Numbers& from = torques[joint];
    const Numbers& to = units[joint];
    double all = torque;
    if (!friction.empty()) all += friction[joint] * faded(wanted);
    double out = to[0];
    for (std::size_t k = 1; k < from.size(); ++k) {
      const double width = from[k] - from[k - 1];
      out += (to[k] - to[k - 1]) / width * std::clamp(all - from[k - 1], 0.0, width);
    }
    if (!dead_band.empty()) {
      const double rising = std::copysign(1.0, to.back() - to.front());
      const auto [least, most] = std::minmax(to.front(), to.back());
      out = std::clamp(out + rising * dead_band[joint] * faded(all), least, most);
    }
    return resolution > 0.0 ? resolution * std::nearbyint(out / resolution) : out;
  }

 private:
  static constexpr double LARGEST = 1e6;  // [N m] end of the table of a joint without limit
  static bool is_finite(double value) { return std::isfinite(value); }
};

}  // namespace grasp
