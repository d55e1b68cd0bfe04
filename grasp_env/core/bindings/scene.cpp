// Scenes: readings of a simulator, and the state that follows from them.
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include <grasp/hand/snapshot.hpp>

#include "scene.hpp"
#include "views.hpp"
#include "solution.hpp"

using namespace grasp;

namespace {

// Item k of a tuple, borrowed; throws if there is none.
PyObject* item(PyObject* tuple, Py_ssize_t k) {
  PyObject* result = PyTuple_GetItem(tuple, k);
  if (!result) throw nb::python_error();
  return result;
}
double number(PyObject* object) {
  const double value = PyFloat_AsDouble(object);
  if (value == -1.0 && PyErr_Occurred()) throw nb::python_error();
  return value;
}
Point vector(PyObject* tuple) {
  return {number(item(tuple, 0)), number(item(tuple, 1)), number(item(tuple, 2))};
}

// Positions of the numbers in the nested tuples that an engine returns.
struct Answers {
  int link, place;  // items of a contact: see `bind_scene`
  std::vector<std::pair<int, int>> forces;
  double factor;
  int first;
  std::vector<int> links;

  nb::object read(nb::handle joints, nb::handle pose, nb::handle velocity,
                  nb::handle contacts) const {
    const Py_ssize_t count = PyTuple_Size(joints.ptr());
    const Py_ssize_t rows = PyTuple_Size(contacts.ptr());
    if (count < 0 || rows < 0) throw nb::python_error();
    nb::object reading = new_row(Reading::size(int(count), int(rows)));
    double* numbers = data_of<double>(reading.ptr());
    for (Py_ssize_t j = 0; j < count; ++j) {
      PyObject* row = item(joints.ptr(), j);
      numbers[j] = number(item(row, 0));
      numbers[count + j] = number(item(row, 1));
    }
    BodyRow& body = *reinterpret_cast<BodyRow*>(numbers + 2 * count);
    PyObject* turn = item(pose.ptr(), 1);
    body.position = vector(item(pose.ptr(), 0));
    for (int k = 0; k < 4; ++k) body.quaternion[k] = number(item(turn, k));
    body.linear = vector(item(velocity.ptr(), 0));
    body.angular = vector(item(velocity.ptr(), 1));
    ContactRow* next = reinterpret_cast<ContactRow*>(&body + 1);
    for (Py_ssize_t i = 0; i < rows; ++i, ++next) {
      PyObject* row = item(contacts.ptr(), i);
      const int index = int(number(item(row, link))) - first;
      next->link = index >= 0 && index < int(links.size()) ? links[index] : -1;
      next->place = vector(item(row, place));
      Point total{};
      for (const auto& [amount, direction] : forces)
        total += number(item(row, amount)) * vector(item(row, direction));
      next->force = factor * total;
    }
    return reading;
  }
};

void make_answers(Answers* answers, int link, int place,
                  const std::vector<std::pair<int, int>>& forces, double factor, int first,
                  const std::vector<int>& links) {
  new (answers) Answers{link, place, forces, factor, first, links};
}

std::shared_ptr<Scene> make_scene(const std::shared_ptr<Tree>& tree, const Surface& surface,
                                  const std::array<double, 3>& gravity, double mass) {
  return std::make_shared<Scene>(tree, surface, point(gravity.data()), mass);
}

bool read_scene(Scene& scene, nb::handle numbers) {
  const Numbers reading = in(numbers, -1);
  if (reading.length(0) < Reading::size(scene.tree->joints(), 0))
    throw nb::value_error("the reading is too short");
  return scene.read(reading.data(), std::size_t(reading.length(0)));
}

Arrays scene_arrays(nb::handle self) { return arrays_of(self, nb::cast<Scene&>(self).now); }

}  // namespace

Arrays arrays_of(nb::handle owner, Snapshot& s) {
  const std::size_t tips = s.tips.size();
  const std::size_t joints = s.angles.size();
  const auto at = [&](double* first, std::initializer_list<std::size_t> shape) {
    return View(first, shape, owner);
  };
  const auto points = [&](std::vector<Point>& rows) {
    return at(&rows.data()->u, {rows.size(), 3});
  };
  nb::dict named;
  named["position"] = at(&s.position.u, {3});
  named["rotation"] = at(&s.rotation.rows[0].u, {3, 3});
  named["linear"] = at(&s.linear.u, {3});
  named["angular"] = at(&s.angular.u, {3});
  named["points"] = points(s.points);
  named["normals"] = points(s.normals);
  named["touch"] = points(s.touch);
  named["tips"] = points(s.tips);
  named["gaps"] = at(s.gaps.data(), {tips});
  named["slip"] = at(s.slip.data(), {tips});
  named["touching"] = at(s.touching.data(), {tips});
  named["forces"] = points(s.forces);
  named["stray"] = at(&s.stray, {1});
  named["gravity_torques"] = at(s.gravity_torques.data(), {joints});
  named["angles"] = at(s.angles.data(), {joints});
  named["rates"] = at(s.rates.data(), {joints});
  named["frames"] = at(&s.posture.frames.data()->rows[0].u, {joints, 3, 3});
  named["origins"] = points(s.posture.origins);
  named["axes"] = points(s.posture.axes);
  return named;
}

void bind_scene(nb::module_& m) {
  if (_import_array() < 0) throw nb::python_error();
  nb::class_<Answers>(m, "Answers",
                      "Positions of the numbers in the nested tuples that a simulator returns.")
      .def("__init__", &make_answers, nb::kw_only(), "link"_a, "place"_a, "forces"_a, "factor"_a,
           "first"_a, "links"_a,
           "For a contact: items of the engine's link number and of the point, pairs of items that "
           "hold amounts and directions\n"
           "of forces; factor of all amounts, below 0 if they push the hand. links: the hand's "
           "link for each of the engine's,\n"
           "from number `first` on; -1: none.")
      .def(
          "read", &Answers::read, "joints"_a, "pose"_a, "velocity"_a, "contacts"_a,
          nb::sig(
              "def read(self, joints: object, pose: object, velocity: object, contacts: object) -> "
              "numpy.typing.NDArray[numpy.float64]"),
          "Return joints ((angle, rate, ...), ...), pose (position, quaternion), velocity (linear, "
          "angular) and contacts\n"
          "as the flat numbers of `Scene.read`, a new array.");
  m.def("reading_size", &Reading::size, "joints"_a, "contacts"_a,
        "Return the number of values in a reading.");
  nb::class_<Scene>(m, "Scene", "A hand and an object in a simulator, as last read.")
      .def_static("make", &make_scene, "tree"_a, "surface"_a, "gravity"_a, "mass"_a,
                  "gravity: (3,) [m/s^2], world frame. mass: of the object [kg].")
      .def_rw("mass", &Scene::mass, "Mass of the object [kg].")
      .def(
          "set_gravity",
          [](Scene& scene, const std::array<double, 3>& g) { scene.gravity = point(g.data()); },
          "gravity"_a, "Set the gravity (3,) [m/s^2], world frame.")
      .def("read", &read_scene, "numbers"_a,
           "Read angles (M,), rates (M,), the object's position, quaternion (x y z w), linear and "
           "angular velocity, and per\n"
           "contact the hand's link, the point [m] and the force ON the object [N]; world frame. "
           "Return False if numbers are\n"
           "not finite or the object is lost.")
      .def("arrays", &scene_arrays,
           "Views of the scene's state by name; overwritten at each reading.");
}
