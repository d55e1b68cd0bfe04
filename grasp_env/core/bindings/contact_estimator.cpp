// Contacts of a hand without tactile sensors.
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include <grasp/hand/contact_estimator.hpp>

#include "buffers.hpp"
#include "views.hpp"

using namespace grasp;

namespace {

using Settings = ContactEstimatorSettings;

void make(ContactEstimator* at, const std::shared_ptr<Tree>& hand, double touch, double release,
          double time_constant, double largest_gap) {
  new (at) ContactEstimator(hand, Settings{touch, release, time_constant, largest_gap});
}

bool update(ContactEstimator& estimator, HandState& state, nb::handle torques, double period) {
  const Numbers given = in(torques, -1);
  return estimator.update(state, given.numbers(), period);
}

ReadOnly forces(nb::handle self) {
  const auto& of = nb::cast<const ContactEstimator&>(self);
  return view(self, &of.forces.data()->u, {of.forces.size(), 3});
}

}  // namespace

void bind_contact_estimator(nb::module_& m) {
  nb::class_<ContactEstimator>(m, "ContactEstimator",
                               "Contacts from joint torques: see contact_estimator.hpp.")
      .def("__init__", &make, "hand"_a, "touch"_a, "release"_a, "time_constant"_a, "largest_gap"_a,
           "Settings: [N], [N], [s], [m].")
      .def("set_surface", &ContactEstimator::set_surface, "surface"_a,
           "The contacts follow from the surface of the object and its pose in the state.")
      .def(
          "set_normals",
          [](ContactEstimator& estimator, nb::handle normals) {
            estimator.set_normals(in(normals, -1, 3).numbers());
          },
          "normals"_a,
          "Without a surface: fingertips touch planes with these unit normals (N, 3) into the "
          "object, object frame.")
      .def("reset", &ContactEstimator::reset,
           "Forget all forces. The next update takes the hand to be at rest.")
      .def(
          "update", &update, "state"_a, "torques"_a, "period"_a,
          "Write `touching`, `positions` and `normals` of a state. torques: (M,) [N m] that the "
          "motors delivered since the last\n"
          "update; period: since then [s]. False, with the last estimate, for numbers that are not "
          "finite.")
      .def_prop_ro("forces", &forces, "(N, 3) of the fingertips ON the object [N], base frame.")
      .def_prop_ro(
          "residual",
          [](nb::handle self) {
            const auto& of = nb::cast<const ContactEstimator&>(self);
            return view(self, of.residual.data(), {of.residual.size()});
          },
          "(M,) torques of the contacts on the joints [N m].")
      .def_prop_ro(
          "gaps",
          [](nb::handle self) {
            const auto& of = nb::cast<const ContactEstimator&>(self);
            return view(self, of.gaps.data(), {of.gaps.size()});
          },
          "(N,) from tip to surface [m]; NaN: no surface is known.");
}
