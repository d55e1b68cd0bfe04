// The friction cones of a hand's contacts within a margin.
#pragma once
#include <grasp/hand/hand_model.hpp>
#include <grasp/optimizer.hpp>

namespace grasp {

class MarginCones {
 public:
  Contacts contacts;  // those of the method, with a share of their friction

  // The model must outlive this object.
  MarginCones(const HandModel& model, const ForceOptimizer& method)
      : contacts(method.contacts()),
        model_(model),
        whole_(contacts),
        usual_(method.margin().friction) {
    reset();
  }
  // Take the share of the method's margin.
  void reset() {
    narrow(usual_);
    replaced_ = false;
  }
  // Take another share of the friction.
  void replace(double share) {
    narrow(share);
    replaced_ = true;
  }
  double share() const { return share_; }
  bool replaced() const { return replaced_; }

  // Friction of a finger times the share of the margin, in the coordinates of `beyond`.
  double friction(int i) const { return contacts.scale[3 * i]; }
  // Size of the tangential part of a force (3,) [N], contact frame, with a torsion [N m].
  double side(int i, const double* force, double torsion) const {
    const double* scale = &contacts.scale[3 * i];
    return std::hypot(scale[1] * force[1], scale[2] * force[2],
                      contacts.torsion_scale(i) * torsion);
  }
  // How far a force is outside the cone: friction times the normal force that is missing; below 0
  // inside.
  double beyond(int i, const double* force, double torsion) const {
    return side(i, force, torsion) - friction(i) * force[0];
  }
  // The same for a force in the object frame.
  double beyond(int i, const Point& force) const { return beyond(i, parts(i, force).data(), 0.0); }
  // Normal force [N] that a force in the object frame lacks to use all of the friction, and not
  // only the share of the margin; below 0: it has more. Infinite without friction.
  double lacking(int i, const Point& force) const {
    const std::array<double, 3> part = parts(i, force);
    const double across = side(i, part.data(), 0.0);
    return (across > 0.0 ? share_ * across / friction(i) : 0.0) - part[0];
  }
  // Share of all of the friction that a force uses; infinite without normal force.
  double used(int i, const double* force, double torsion) const {
    const double across = side(i, force, torsion);
    return across > 0.0 ? share_ * across / std::max(friction(i) * force[0], 0.0) : 0.0;
  }

 private:
  const HandModel& model_;
  const Contacts whole_;
  const double usual_;
  double share_ = 1.0;
  bool replaced_ = false;

  void narrow(double share) {
    contacts = whole_;
    contacts.narrow(share);
    share_ = share;
  }

  std::array<double, 3> parts(int i, const Point& force) const {
    return {dot(force, model_.axis(i, 0)), dot(force, model_.axis(i, 1)),
            dot(force, model_.axis(i, 2))};
  }
};

}  // namespace grasp
