// The margin of a problem: how far its forces stay inside the friction cones.
#pragma once
#include <grasp/contacts/contacts.hpp>
#include <grasp/record.hpp>

namespace grasp {

// One number for all contacts, or one of each; the caller owns an array.
class PerContact {
 public:
  constexpr PerContact(double all = 0.0) : all_(all) {}
  template <class Array>
    requires std::convertible_to<const Array&, std::span<const double>>
  constexpr PerContact(const Array& each) : each_(each) {}

  double operator[](int i) const { return each_.empty() ? all_ : each_[i]; }
  bool fits(int count) const { return each_.empty() || each_.size() == std::size_t(count); }

 private:
  double all_ = 0.0;
  std::span<const double> each_{};
};

// A contact's cone is |t| / mu <= friction * (n - preload); with the torsion m of a soft contact,
// sqrt((|t| / mu)^2 + (m / gamma)^2) <= friction * (n - preload).
struct Margin {
  double friction = 1.0;  // share of the friction that forces may use: above 0, at most 1
  PerContact preload{};   // [N] normal force that each touching contact has in addition, >= 0
};

// Preloads s (N,) shift the cones: f = g + s n, where g solves an ordinary problem with the wrench
// w + G s n.
class Preload {
 public:
  std::vector<double> each;  // (n,) [N] of the current contacts
  bool any = false;          // one of them is above 0

  Preload() = default;
  Preload(const PerContact& from, int count) : each(count) {
    for (int i = 0; i < count; ++i) set(i, from[i]);
  }
  // Begin again; room for `count` contacts must be there.
  void clear() { any = false; }
  void set(int contact, double preload) {
    each[contact] = preload;
    any = any || preload > 0.0;
  }
  // w + G s n. Where contacts cannot make all wrenches, G s n is within their reach: what rounding
  // adds beyond it is left out.
  Vec6 added_to(const double* to, const Contacts& contacts) const {
    Vec6 wrench{to[0], to[1], to[2], to[3], to[4], to[5]};
    if (!any) return wrench;
    double total = 0.0;
    for (int i = 0; i < contacts.count; ++i) {
      wrench = wrench + each[i] * column(contacts.matrix.data(), 3 * contacts.count, 3 * i);
      total += each[i];
    }
    const WrenchSpace& reach = contacts.reach;
    if (reach.full()) return wrench;
    const double rounding = BOUNDARY * size(contacts.unit.of(to)) + reach.rounding * total;
    const bool rounded = size(reach.beyond(contacts.unit.of(wrench))) <= rounding;
    return rounded ? contacts.within_reach(wrench.data()) : wrench;
  }
  // (n, 3) forces g of the shifted problem from f, and back
  void subtract_from(double* force, int count) const { add(force, count, -1.0); }
  void add_to(double* force, int count) const { add(force, count, 1.0); }
  // Sum of weights * preloads: what a linear objective of f has more than one of g.
  template <class F> double cost(int count, F&& weight) const {
    double total = 0.0;
    if (any)
      for (int i = 0; i < count; ++i) total += weight(i) * each[i];
    return total;
  }

 private:
  void add(double* force, int count, double sign) const {
    if (any)
      for (int i = 0; i < count; ++i) force[3 * i] += sign * each[i];
  }
};

// Write the share of friction (N,) that each force and torsion of a record uses: 1 on the cone, inf
// if there is no normal force for what is tangential. contacts: those of the record, with a share
// `margin` of the friction that counts.
inline void write_friction_used(const Contacts& contacts, double margin, const Record& record,
                                double* __restrict used) {
  const double* __restrict scale = contacts.scale.data();
  const double* __restrict force = record.force();
  const double* __restrict torsion = record.torsion();
  const auto part = [](double of, double all) { return of > 0.0 ? of / std::max(all, 0.0) : 0.0; };
  for (int i = 0; i < contacts.count; ++i) {
    const double o = scale[3 * i + 1] * force[3 * i + 1];
    const double t = scale[3 * i + 2] * force[3 * i + 2];
    double square = o * o + t * t;
    if (contacts.torsion[i] > 0.0) {
      const double v = contacts.torsion_scale(i) * torsion[i];
      square += v * v;
    }
    used[i] = margin * part(std::sqrt(square), scale[3 * i] * force[3 * i]);
  }
}

}  // namespace grasp
