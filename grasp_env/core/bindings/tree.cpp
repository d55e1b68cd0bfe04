// Hands: their trees of links, and inverse kinematics.
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <grasp/hand/mobility.hpp>
#include <grasp/hand/reach.hpp>
#include <grasp/hand/tree_file.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

using Three = std::array<double, 3>;
using Nine = std::array<double, 9>;

void make_link(Link* link, int parent, const Three& offset, const Nine& rotation, const Three& axis,
               double mass, const Three& center, double lower, double upper, double torque_limit,
               bool sliding, int driver, double ratio, double shift,
               const std::array<double, 6>& inertia) {
  new (link) Link{parent,
                  point(offset.data()),
                  Rotation::from(rotation.data()),
                  point(axis.data()),
                  mass,
                  point(center.data()),
                  lower,
                  upper,
                  torque_limit,
                  sliding,
                  driver,
                  ratio,
                  shift,
                  inertia};
}

std::shared_ptr<Tree> make_tree(const std::vector<Link>& links, const std::vector<Tip>& tips) {
  auto tree = std::make_shared<Tree>(Tree{links, tips});
  if (const char* fault = tree->fault()) throw nb::value_error(fault);
  return tree;
}

nb::bytes save(const Tree& tree) {
  const std::string bytes = TreeFile::write(tree);
  return nb::bytes(bytes.data(), bytes.size());
}

std::shared_ptr<Tree> load(nb::bytes bytes) {
  auto tree = TreeFile::read({bytes.c_str(), bytes.size()});
  return tree ? std::make_shared<Tree>(*std::move(tree)) : nullptr;
}

Posture posture(const std::shared_ptr<Tree>& tree, nb::handle angles) {
  Posture result(tree);
  result.trace(in(angles, tree->joints()).data());
  return result;
}

void trace(const std::shared_ptr<Tree>& tree, nb::handle angles, nb::handle rotations,
           nb::handle origins) {
  const Posture at = posture(tree, angles);
  const int count = tree->joints();
  double* r = out(rotations, count, 3, 3).data();
  double* o = out(origins, count, 3).data();
  for (int j = 0; j < count; ++j)
    for (int k = 0; k < 3; ++k) {
      o[3 * j + k] = at.origins[j][k];
      for (int c = 0; c < 3; ++c) r[9 * j + 3 * k + c] = at.frames[j].rows[k][c];
    }
}

void tips(const std::shared_ptr<Tree>& tree, nb::handle angles, nb::handle centers) {
  const Posture at = posture(tree, angles);
  double* to = out(centers, tree->fingers(), 3).data();
  for (int i = 0; i < tree->fingers(); ++i)
    for (int k = 0; k < 3; ++k) to[3 * i + k] = at.tip(i)[k];
}

void jacobian(const std::shared_ptr<Tree>& tree, nb::handle angles, int link, nb::handle place,
              nb::handle to) {
  check_index(link, tree->joints(), "no such link");
  posture(tree, angles)
      .jacobian(link, point(in(place, 3).data()), out(to, 3, tree->joints()).data());
}

void mass_matrix(const std::shared_ptr<Tree>& tree, nb::handle angles, nb::handle matrix) {
  posture(tree, angles).mass_matrix(out(matrix, tree->joints(), tree->joints()).data());
}

void gravity_torques(const std::shared_ptr<Tree>& tree, nb::handle angles, nb::handle gravity,
                     nb::handle torques) {
  posture(tree, angles).support(point(in(gravity, 3).data()), out(torques, tree->joints()).data());
}

void statics(const std::shared_ptr<Tree>& tree, nb::handle angles, nb::handle points,
             nb::handle gravity, nb::handle moves, nb::handle torques) {
  const int fingers = tree->fingers();
  const int joints = tree->joints();
  Posture(tree).statics(in(angles, joints).data(), in(points, fingers, 3).numbers(),
                        point(in(gravity, 3).data()), out(moves, fingers, 3, joints).numbers(),
                        out(torques, joints).numbers());
}

void solve(Reach& reach, nb::handle targets, nb::handle starts, nb::handle angles,
           nb::handle missed) {
  const int joints = reach.tree().joints();
  const int fingers = reach.tree().fingers();
  const Numbers tips = in(targets, fingers, 3);
  const Numbers from = in(starts, -1, joints);
  std::vector<Point> places;
  for (int i = 0; i < fingers; ++i) places.push_back(point(tips.data() + 3 * i));
  reach.solve(places.data(), from.data(), int(from.length(0)), out(angles, joints).data(),
              out(missed, reach.groups.size()).data());
}

}  // namespace

void bind_tree(nb::module_& m) {
  m.attr("REACHED") = REACHED;
  nb::class_<Link>(m, "Link", "A link of a hand and the joint that moves it.")
      .def("__init__", &make_link, nb::kw_only(), "parent"_a, "offset"_a, "rotation"_a, "axis"_a,
           "mass"_a, "center"_a, "lower"_a, "upper"_a, "torque_limit"_a, "sliding"_a = false,
           "driver"_a = -1, "ratio"_a = 1.0, "shift"_a = 0.0, "inertia"_a = std::array<double, 6>{},
           "The members of `grasp::Link`, see hand/tree.hpp; rotation and inertia row by row.");
  nb::class_<Tip>(m, "Tip", "The sphere with which a finger touches.")
      .def(
          "__init__",
          [](Tip* tip, int link, const Three& center, double radius) {
            new (tip) Tip{link, point(center.data()), radius};
          },
          nb::kw_only(), "link"_a, "center"_a, "radius"_a, "center: [m] in the link's frame.");
  nb::class_<Tree>(m, "Tree", "A hand as an immutable tree of M links with N fingertips.")
      .def_static("make", &make_tree, "links"_a, "tips"_a,
                  "Make a hand. Parents must come before their links.")
      .def_prop_ro("joints", &Tree::joints)
      .def_prop_ro("fingers", &Tree::fingers)
      .def(
          "couple",
          [](const Tree& tree, nb::handle angles) {
            tree.couple(out(angles, tree.joints()).data());
          },
          "angles"_a, "Set the coupled joints in angles (M,) from their drivers.")
      .def("trace", &trace, "angles"_a, "rotations"_a, "origins"_a,
           "Write the frames of the links at angles (M,) [rad], world frame: rotations (M, 3, 3) "
           "and origins (M, 3) [m].")
      .def("tips", &tips, "angles"_a, "centers"_a,
           "Write the centres of the fingertips [m], world frame, into (N, 3).")
      .def("jacobian", &jacobian, "angles"_a, "link"_a, "place"_a, "jacobian"_a,
           "Write the velocity of a point (3,) [m] of a link per joint speed, world frame, into "
           "(3, M).")
      .def(
          "mobility",
          [](const std::shared_ptr<Tree>& tree, nb::handle angles) {
            const Mobility of(tree, in(angles, tree->joints()).data());
            return std::make_pair(of.tips, of.joints);
          },
          "angles"_a,
          "Mobility of tips (N,) [1/kg] and joints (M,) [1/(kg m^2)]: see mobility.hpp.")
      .def("mass_matrix", &mass_matrix, "angles"_a, "matrix"_a,
           "Write the mass matrix (M, M) [kg m^2]; rows and columns of coupled joints are zero.")
      .def("gravity_torques", &gravity_torques, "angles"_a, "gravity"_a, "torques"_a,
           "Write the torques that carry the weight of all links under a gravity (3,) [m/s^2], "
           "into (M,) [N m].")
      .def("statics", &statics, "angles"_a, "points"_a, "gravity"_a, "jacobian"_a, "torques"_a,
           "Write the Jacobians of the points (N, 3) [m] where the tips touch, into (N, 3, M), and "
           "`gravity_torques`, into (M,).")
      .def("save", &save, "Return the bytes of a hand file, which `grasp::TreeFile` reads in C++.")
      .def_static("load", &load, "bytes"_a, nb::sig("def load(bytes: bytes) -> Tree | None"),
                  "Return the hand that `save` wrote; None if the bytes are not a whole file.");
  nb::class_<Reach>(m, "Reach",
                    "Inverse kinematics of a hand: damped least squares within the joint limits.")
      .def_static(
          "make",
          [](const std::shared_ptr<Tree>& tree, bool limited) {
            return std::make_unique<Reach>(tree, limited);
          },
          "tree"_a, "limited"_a = true, "limited: True to stay within the joint limits.")
      .def_prop_ro(
          "groups",
          [](const Reach& reach) {
            std::vector<std::pair<std::vector<int>, std::vector<int>>> groups;
            for (const FingerGroup& group : reach.groups)
              groups.emplace_back(group.fingers, group.joints);
            return groups;
          },
          "Groups of fingers that share joints, and these joints.")
      .def("solve", &solve, "targets"_a, "starts"_a, "angles"_a, "missed"_a,
           "Bring the tips near targets (N, 3) [m], from starts (S, M) in this order; write the "
           "angles (M,) [rad] and\n"
           "for each group the distance (G,) of its worst tip from the target [m].");
}
