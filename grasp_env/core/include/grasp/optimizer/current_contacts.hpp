// The contacts and limits of one call: the problem's, with the changes of the call.
#pragma once
#include <grasp/problem.hpp>

namespace grasp::detail {

// A copy of the limits of a problem.
class StoredLimits {
 public:
  std::vector<double> min_normal, max_normal, jacobian, torque_limit, torque_bias;
  int rows = 0;  // number of finite limits

  StoredLimits() = default;
  // Throws std::invalid_argument.
  StoredLimits(const ForceLimits& from, int count)
      : min_normal(from.min_normal.begin(), from.min_normal.end()),
        max_normal(from.max_normal.begin(), from.max_normal.end()),
        jacobian(from.jacobian.begin(), from.jacobian.end()),
        torque_limit(from.torque_limit.begin(), from.torque_limit.end()),
        torque_bias(from.torque_bias.begin(), from.torque_bias.end()) {
    const std::size_t size = std::size_t(count);
    for (const auto* values : {&min_normal, &max_normal})
      if (!values->empty() && values->size() != size)
        throw std::invalid_argument("limits of normal forces must be one of each contact, or none");
    if (jacobian.size() != 3 * size * joints() && jacobian.size() != 6 * size * joints())
      throw std::invalid_argument(
          "the jacobian must be (N, 3, J) or (N, 6, J), and torque_limit (J,)");
    if (torque_bias.empty()) torque_bias.resize(joints());
    if (torque_bias.size() != joints())
      throw std::invalid_argument("torque_bias must be (J,), or none");
    for (const auto* values : {&min_normal, &max_normal, &torque_limit})
      for (double value : *values)
        if (!(value >= 0.0)) throw std::invalid_argument("limits must be numbers >= 0");
    for (const auto* values : {&jacobian, &torque_bias})
      for (double value : *values)
        if (!(std::abs(value) <= LARGEST))
          throw std::invalid_argument("the jacobian and torque_bias must be finite, up to 1e12");
    rows = view().many();
  }
  std::size_t joints() const { return torque_limit.size(); }
  ForceLimits view() const { return {min_normal, max_normal, jacobian, torque_limit, torque_bias}; }
};

class CurrentContacts {
 public:
  Contacts home, now;  // of the problem; of this call, without those that do not touch
  StoredLimits limits;
  double home_friction_margin;       // of the problem
  std::vector<double> home_preload;  // (N,) [N]
  double friction_margin = 1.0;      // of this call; `now` has the friction within it
  Preload preload;                   // of `now`
  int joints;
  bool tabulates = true;    // a call fills `table`
  LimitTable table;         // limits of the current contacts, if each acts on one contact
  std::vector<int> chosen;  // indices of the contacts that touch
  bool separate = true;     // `table` holds the limits: each acts on one contact

  explicit CurrentContacts(const Problem& problem)
      : home(problem.contacts),
        now(home),
        limits(problem.limits, home.count),
        home_friction_margin(problem.margin.friction),
        home_preload(home.count),
        preload({}, home.count),
        joints(int(limits.joints())),
        chosen(home.count),
        contact_jacobian_(4 * home.count * joints),
        gathered_(6 * home.count),
        min_normal_(home.count),
        max_normal_(home.count) {
    for (int i = 0; i < home.count; ++i) chosen[i] = i;
    if (!problem.margin.preload.fits(home.count))
      throw std::invalid_argument("the preload must be one number, or one of each contact");
    if (!load_margin(problem.margin, home.count))
      throw std::invalid_argument(
          "the friction margin must be above 0 and at most 1, preloads 0 to 1e12 and below the "
          "largest normal forces");
    home_preload = preload.each;
  }

  // The bits of a mask that belong to contacts; true if all of them are set.
  std::uint64_t touching(std::uint64_t mask) const {
    return home.count < 64 ? mask & ((std::uint64_t(1) << home.count) - 1) : mask;
  }
  bool all_touch(std::uint64_t mask) const { return touching(mask) == touching(~std::uint64_t(0)); }
  // Take over the contacts and limits of a call. Return CONVERGED, REFUSED, or RANK_LOST if no
  // contact makes a wrench.
  Code load_call(const Changes& changes) {
    const int all = home.count;
    const std::size_t triples = std::size_t(3 * all);
    if ((!changes.positions.empty() && changes.positions.size() != triples) ||
        (!changes.normals.empty() && changes.normals.size() != triples) ||
        (!changes.jacobian.empty() && changes.jacobian.size() != limits.jacobian.size()) ||
        (!changes.torque_bias.empty() && changes.torque_bias.size() != std::size_t(joints)))
      return REFUSED;
    const double* positions =
        changes.positions.empty() ? home.positions.data() : changes.positions.data();
    const double* normals = changes.normals.empty() ? home.normals.data() : changes.normals.data();
    const std::uint64_t mask = touching(changes.contacts);
    const bool whole = all_touch(mask);
    if (whole && !is_home_) {
      for (int i = 0; i < all; ++i) chosen[i] = i;
      now.select(home, {chosen.data(), std::size_t(all)});
    }
    is_home_ = whole;
    if (!whole) {
      if (all > 64) return REFUSED;
      int count = 0;
      for (int i = 0; i < all; ++i) {
        if (!(mask >> i & 1)) continue;
        std::copy_n(positions + 3 * i, 3, &gathered_[3 * count]);
        std::copy_n(normals + 3 * i, 3, &gathered_[3 * (all + count)]);
        chosen[count++] = i;
      }
      if (count == 0) return RANK_LOST;
      now.select(home, {chosen.data(), std::size_t(count)});
      positions = gathered_.data();
      normals = gathered_.data() + 3 * all;
    }
    if (const std::size_t size = changes.friction.size(); size > 0) {
      if (size != 1 && size != std::size_t(all) && size != 2 * std::size_t(all)) return REFUSED;
      for (std::size_t j = 0; j < size; ++j) {
        const bool touches =
            whole || size == 1 || mask >> (size == std::size_t(all) ? j : j / 2) & 1;
        if (touches && !(changes.friction[j] >= 0.0 && changes.friction[j] <= LARGEST))
          return REFUSED;
      }
      if (now.set_friction(changes.friction, {chosen.data(), std::size_t(now.count)}, all))
        is_home_ = false;
    }
    if (changes.margin && !changes.margin->preload.fits(all)) return REFUSED;
    if (!load_margin(changes.margin ? *changes.margin : home_margin(), now.count)) return REFUSED;
    if (friction_margin < 1.0) {
      now.narrow(friction_margin);
      is_home_ = false;
    }
    const Placing placed = now.place(positions, normals);
    if (placed == Placing::refused) return REFUSED;
    if (now.reach.rank == 0) return RANK_LOST;
    return load_limits(changes) ? CONVERGED : REFUSED;
  }

  // Make the contacts of the last `load_call`, all of which touch, the problem's, and its margin,
  // Jacobian and torque bias.
  void take_over(const Changes& changes) {
    is_home_ = false;
    home_friction_margin = friction_margin;
    home_preload = preload.each;
    if (!changes.friction.empty()) home.set_friction(changes.friction, chosen, home.count);
    home.place(now.positions.data(), now.normals.data());
    if (!changes.jacobian.empty())
      limits.jacobian.assign(changes.jacobian.begin(), changes.jacobian.end());
    if (!changes.torque_bias.empty())
      limits.torque_bias.assign(changes.torque_bias.begin(), changes.torque_bias.end());
  }

  // Limits of the current contacts, with the Jacobian (n, 4, J) in contact frames.
  ForceLimits limits_in_place() {
    const auto of = [&](const std::vector<double>& from, std::vector<double>& to) {
      if (from.empty()) return Doubles{};
      to.resize(now.count);
      for (int i = 0; i < now.count; ++i) to[i] = from[chosen[i]];
      return Doubles(to);
    };
    return {of(limits.min_normal, min_normal_), of(limits.max_normal, max_normal_),
            Doubles(contact_jacobian_).first(std::size_t(4) * now.count * joints),
            limits.torque_limit, bias_};
  }
  // Joint torques (J,) [N m] of a force, a record of the contacts `now`.
  void torques(const Record& from, double* to) const {
    for (int j = 0; j < joints; ++j) to[j] = bias_[j];
    for (int i = 0; i < now.count; ++i)
      for (int a = 0; a < 4; ++a) {
        const double force = a < 3 ? from.force()[3 * i + a] : from.torsion()[i];
        for (int j = 0; j < joints; ++j)
          to[j] += contact_jacobian_[joints * (4 * i + a) + j] * force;
      }
  }
  // Write the multipliers of all limits: `of(row)` for a row of the current contacts, 0 if its
  // contact does not touch.
  template <class F> void fill_multipliers(double* to, F&& of) const {
    int row = 0;
    for (const auto* limits : {&limits.min_normal, &limits.max_normal})
      for (int i = 0, k = 0; i < int(limits->size()); ++i) {
        const bool touches = k < now.count && chosen[k] == i;
        k += touches;
        if ((*limits)[i] > 0.0 && (*limits)[i] < infinity) *to++ = touches ? of(row++) : 0.0;
      }
    for (double limit : limits.torque_limit)
      if (limit < infinity) {
        *to++ = of(row++);
        *to++ = of(row++);
      }
  }
  // Largest excess of a limit by the final force, as a fraction of the limit.
  double excess(const Record& out) const {
    double most = 0.0;
    const auto exceeds = [&](double by, double limit) {
      if (by > 0.0) most = std::max(most, by / limit);  // infinite for a limit of zero
    };
    for (int k = 0; k < now.count; ++k) {
      const int i = chosen[k];
      const double normal = out.force()[3 * i];
      if (!limits.min_normal.empty() && limits.min_normal[i] < infinity)
        exceeds(limits.min_normal[i] - normal, limits.min_normal[i]);
      if (!limits.max_normal.empty() && limits.max_normal[i] > 0.0)
        exceeds(normal - limits.max_normal[i], limits.max_normal[i]);
    }
    for (int j = 0; j < joints; ++j)
      exceeds(std::abs(out.torques()[j]) - limits.torque_limit[j], limits.torque_limit[j]);
    return most;
  }

  Margin home_margin() const { return {home_friction_margin, home_preload}; }

 private:
  // The Jacobian (n, 4, J) in contact frames; the call's numbers of the contacts that touch.
  std::vector<double> contact_jacobian_, gathered_, min_normal_, max_normal_;
  Doubles jacobian_{}, bias_{};
  bool is_home_ = false;  // `now` has the friction and the weights of all contacts of the problem

  // Load the margin of the first `count` contacts of `chosen`. Return false if it is out of range.
  bool load_margin(const Margin& margin, int count) {
    friction_margin = margin.friction;
    if (!(friction_margin > 0.0 && friction_margin <= 1.0)) return false;
    preload.clear();
    for (int k = 0; k < count; ++k) {
      preload.set(k, margin.preload[chosen[k]]);
      const double most = limits.max_normal.empty() ? 0.0 : limits.max_normal[chosen[k]];
      if (!(preload.each[k] >= 0.0 && preload.each[k] <= LARGEST)) return false;
      if (most > 0.0 && preload.each[k] >= most) return false;
    }
    return true;
  }
  // Return false if the numbers are not finite.
  bool load_limits(const Changes& changes) {
    jacobian_ = changes.jacobian.empty() ? Doubles(limits.jacobian) : changes.jacobian;
    bias_ = changes.torque_bias.empty() ? Doubles(limits.torque_bias) : changes.torque_bias;
    separate = true;
    if (!joints && !limits.rows) return true;
    if (joints) turn_jacobian();
    const auto usable = [](Doubles numbers) {
      return std::ranges::all_of(numbers, [](double value) { return std::abs(value) <= LARGEST; });
    };
    const std::size_t per_contact = jacobian_.size() / home.count;
    for (int i : std::span(chosen).first(now.count))
      if (!usable(jacobian_.subspan(per_contact * i, per_contact))) return false;
    if (!usable(bias_)) return false;
    if (limits.rows && tabulates) separate = table.fill(now, limits_in_place(), 4, preload);
    return true;
  }
  // Jacobian (n, 4, J): velocities along (normal, o, t), and the angular velocity about the normal.
  void turn_jacobian() {
    const int rows = int(jacobian_.size()) / (home.count * joints);
    for (int i = 0; i < now.count; ++i) {
      const double* from = jacobian_.data() + std::size_t(rows) * joints * chosen[i];
      const double* f = &now.frames[9 * i];
      double* to = &contact_jacobian_[4 * joints * i];
      for (int a = 0; a < 3; ++a)
        for (int j = 0; j < joints; ++j)
          to[joints * a + j] =
              f[a] * from[j] + f[3 + a] * from[joints + j] + f[6 + a] * from[2 * joints + j];
      for (int j = 0; j < joints; ++j)
        to[3 * joints + j] = rows < 6 ? 0.0
                                      : f[0] * from[3 * joints + j] + f[3] * from[4 * joints + j] +
                                            f[6] * from[5 * joints + j];
    }
  }
};

}  // namespace grasp::detail
