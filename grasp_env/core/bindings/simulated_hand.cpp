// The hand of a simulation beside its controller.
#include <bit>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <grasp/hand/simulated_hand.hpp>

#include "optimizer.hpp"
#include "scene.hpp"
#include "views.hpp"
#include "solution.hpp"

using namespace grasp;

namespace {

using Nine = std::array<double, 9>;

Target target_of(nb::handle row) {
  return *reinterpret_cast<const Target*>(in(row, Target::SIZE).data());
}

std::array<double, 6> wrench(const Body& body, const Scene& scene, nb::handle target,
                             nb::handle gravity) {
  return body.wrench(scene.now, target_of(target), point(in(gravity, 3).data()));
}

// The input of a tick, in arrays that live as long as the call.
class Known {
 public:
  Known(const SimulatedHand& hand, nb::handle reading, nb::handle external, nb::handle gravity,
        nb::handle target, nb::handle noise)
      : reading_(reading), external_(in(external, 6)), noise_(noise) {
    if (!reading.is_none() &&
        !(reading_.has(-1) && reading_.length(0) >= Reading::size(hand.scene->tree->joints(), 0)))
      throw nb::type_error("reading must be (2M + 13 + 7 contacts,)");
    if (!hand.sensors.exact() && !noise_.has(3 + 3 * hand.scene->tree->fingers()))
      throw nb::type_error("noise must be (3 + 3N,)");
    known = {reading.is_none() ? Doubles{} : reading_.numbers(), external_.data(),
             noise.is_none() ? nullptr : noise_.data(), point(in(gravity, 3).data()),
             target_of(target)};
  }
  SimulatedHand::Known known;

 private:
  Buffer reading_;
  Numbers external_;
  Buffer noise_;
};

bool see(SimulatedHand& hand, nb::handle reading, nb::handle external, nb::handle gravity,
         nb::handle target, nb::handle noise) {
  return hand.see(Known(hand, reading, external, gravity, target, noise).known);
}

void rest(SimulatedHand& hand, nb::handle external, nb::handle gravity, nb::handle target,
          nb::handle noise) {
  hand.rest(Known(hand, nb::none(), external, gravity, target, noise).known);
}

SimulatedHand::Outcome outcome(const SimulatedHand& hand, nb::handle target, nb::handle error,
                               nb::handle measured) {
  const SimulatedHand::Outcome result =
      hand.outcome(target_of(target), out(measured, hand.scene->tree->fingers(), 3).data());
  const double* first = &result.error.position.u;
  std::copy(first, first + 12, out(error, 12).data());
  return result;
}
static_assert(sizeof(PoseError) == 12 * sizeof(double));

// The data of a step that `step_info` reports.
struct StepReport {
  const SimulatedHand& hand;
  const SimulatedHand::Outcome& outcome;
  const double* measured;
  const HandController& c = *hand.controller;
  const GripForces& forces = c.forces();
  const Effort& effort = forces.effort;
  Record solution{const_cast<double*>(forces.solution.data())};  // read only
  int fingers = hand.scene->tree->fingers();
  bool solved = solution.has_force();
};

PyObject* new_array(const double* from, std::initializer_list<npy_intp> shape) {
  PyObject* result = PyArray_SimpleNew(int(shape.size()), shape.begin(), NPY_DOUBLE);
  if (!result) return nullptr;
  std::copy_n(from, PyArray_SIZE(reinterpret_cast<PyArrayObject*>(result)),
              data_of<double>(result));
  return result;
}
PyObject* touching(const StepReport& t) {
  nb::object result = new_row(t.fingers, NPY_BOOL);
  npy_bool* to = data_of<npy_bool>(result.ptr());
  for (int i = 0; i < t.fingers; ++i) to[i] = t.hand.scene->now.touching[i] > 0.0;
  return result.release().ptr();
}
PyObject* value(double number) { return PyFloat_FromDouble(number); }
PyObject* value(int number) { return PyLong_FromLong(number); }
PyObject* value(long long number) { return PyLong_FromLongLong(number); }
PyObject* value(bool truth) { return PyBool_FromLong(truth); }

constexpr double LARGEST_GAP = 1e9;  // reported instead of an infinite gap

constexpr struct {
  const char* name;
  PyObject* (*make)(const StepReport&);
} REPORT_FIELDS[] = {
    {"iterations", [](const StepReport& t) { return value(t.effort.iterations); }},
    {"trials", [](const StepReport& t) { return value(t.effort.trials); }},
    {"objective",
     [](const StepReport& t) { return value(t.solved ? t.solution.summary().objective : 0.0); }},
    {"optimality_gap",
     [](const StepReport& t) {
       return value(t.solved ? std::min(t.solution.gap(), LARGEST_GAP) : 0.0);
     }},
    {"cone_margin",
     [](const StepReport& t) { return value(t.solved ? t.solution.summary().margin : 0.0); }},
    {"force_closure", [](const StepReport& t) { return value(t.c.closure()); }},
    {"contacts", [](const StepReport& t) { return value(std::popcount(t.c.mask)); }},
    {"contact_changes", [](const StepReport& t) { return value(t.c.changes); }},
    {"wrench", [](const StepReport& t) { return new_array(t.c.state()[WRENCH].data(), {6}); }},
    {"commanded_force",
     [](const StepReport& t) { return new_array(t.c.force.data(), {t.fingers, 3}); }},
    {"measured_force", [](const StepReport& t) { return new_array(t.measured, {t.fingers, 3}); }},
    {"force_error", [](const StepReport& t) { return value(t.outcome.force_error); }},
    {"touching", [](const StepReport& t) { return touching(t); }},
    {"stray_force", [](const StepReport& t) { return value(t.outcome.stray); }},
    {"slip", [](const StepReport& t) { return value(t.outcome.slip); }},
    {"slip_distance", [](const StepReport& t) { return value(t.outcome.worst.slide); }},
    {"overlap", [](const StepReport& t) { return value(t.outcome.worst.overlap); }},
    {"stray_share", [](const StepReport& t) { return value(t.outcome.worst.stray); }},
    {"peak_force", [](const StepReport& t) { return value(t.outcome.worst.force); }},
    {"imbalance", [](const StepReport& t) { return value(t.outcome.imbalance); }},
    {"speed", [](const StepReport& t) { return value(t.outcome.speed); }},
    {"drift", [](const StepReport& t) { return value(t.outcome.drift); }},
    {"tilt", [](const StepReport& t) { return value(t.outcome.tilt); }},
    {"peak_torque", [](const StepReport& t) { return value(t.c.peak); }},
    {"followed", [](const StepReport& t) { return value(t.effort.followed); }},
    {"limited", [](const StepReport& t) { return value(t.effort.limited); }},
    {"torque_margin", [](const StepReport& t) { return value(t.effort.margin); }},
    {"torque_share", [](const StepReport& t) { return value(t.effort.share); }},
    {"saturated", [](const StepReport& t) { return value(t.effort.saturated); }},
};

PyObject* field_names[std::size(REPORT_FIELDS)];  // the names, interned once

nb::typed<nb::dict, nb::str, nb::object> step_info(const SimulatedHand& hand,
                                                   const SimulatedHand::Outcome& outcome,
                                                   nb::handle measured) {
  const StepReport report{hand, outcome, in(measured, hand.scene->tree->fingers(), 3).data()};
  nb::dict out;
  for (std::size_t k = 0; k < std::size(REPORT_FIELDS); ++k) {
    const nb::object value = nb::steal(REPORT_FIELDS[k].make(report));
    if (!value || PyDict_SetItem(out.ptr(), field_names[k], value.ptr()) < 0)
      throw nb::python_error();
  }
  return out;
}

Arrays seen(nb::handle self) {
  return arrays_of(self, const_cast<Snapshot&>(nb::cast<SimulatedHand&>(self).seen()));
}

View slid(nb::handle self) {
  std::vector<double>& numbers = nb::cast<SimulatedHand&>(self).sensors.slid;
  return view(self, numbers, {numbers.size()});
}

}  // namespace

void bind_simulated_hand(nb::module_& m) {
  if (_import_array() < 0) throw nb::python_error();
  for (std::size_t k = 0; k < std::size(REPORT_FIELDS); ++k)
    if (!(field_names[k] = PyUnicode_InternFromString(REPORT_FIELDS[k].name)))
      throw nb::python_error();
  nb::class_<Body>(m, "Body",
                   "Model of the object and gains of its pose feedback: see balance.hpp.")
      .def(nb::init<>())
      .def_rw("mass", &Body::mass)
      .def_prop_rw(
          "inertia",
          [](const Body& b) {
            Nine out;
            for (int k = 0; k < 9; ++k) out[k] = b.inertia.rows[k / 3][k % 3];
            return out;
          },
          [](Body& b, const Nine& a) { b.inertia = Rotation::from(a.data()); },
          "(9,) [kg m^2] about its centre, object frame")
      .def_rw("position_gain", &Body::position_gain)
      .def_rw("position_damping", &Body::position_damping)
      .def_rw("rotation_gain", &Body::rotation_gain)
      .def_rw("rotation_damping", &Body::rotation_damping)
      .def("wrench", &wrench, "scene"_a, "target"_a, "gravity"_a,
           "Weight - inertial wrench of the target motion + pose feedback (6,) [N, N m], object "
           "frame.");
  nb::enum_<WrenchSource>(m, "WrenchSource", "Source of the external wrench.")
      .value("measured", WrenchSource::measured)
      .value("estimated", WrenchSource::estimated)
      .value("none", WrenchSource::none);
  nb::class_<SensorSettings>(m, "SensorSettings",
                             "Delay and noise of the controller's sensors: see sensing.hpp.")
      .def(nb::init<>())
      .def_rw("wrench", &SensorSettings::wrench)
      .def_rw("tick", &SensorSettings::tick)
      .def_rw("keep", &SensorSettings::keep)
      .def_rw("joint_delay", &SensorSettings::joint_delay)
      .def_rw("delay", &SensorSettings::delay)
      .def_rw("wrench_delay", &SensorSettings::wrench_delay)
      .def_rw("pose_noise", &SensorSettings::pose_noise)
      .def_rw("tactile_noise", &SensorSettings::tactile_noise);
  nb::class_<Costs>(m, "Costs",
                    "Costs of an agent's step, each from 0 to 1: see simulated_hand.hpp.")
      .def_ro("force", &Costs::force)
      .def_ro("torque", &Costs::torque)
      .def_ro("change", &Costs::change);
  using Outcome = SimulatedHand::Outcome;
  nb::class_<Outcome>(m, "Outcome", "Quality of the hold: see simulated_hand.hpp.")
      .def_ro("drift", &Outcome::drift)
      .def_ro("tilt", &Outcome::tilt)
      .def_ro("force_error", &Outcome::force_error)
      .def_ro("slip", &Outcome::slip)
      .def_ro("stray", &Outcome::stray)
      .def_ro("imbalance", &Outcome::imbalance)
      .def_ro("speed", &Outcome::speed)
      .def_prop_ro("force", [](const Outcome& o) { return o.worst.force; })
      .def_prop_ro("slide", [](const Outcome& o) { return o.worst.slide; })
      .def_prop_ro("overlap", [](const Outcome& o) { return o.worst.overlap; })
      .def_prop_ro("stray_share", [](const Outcome& o) { return o.worst.stray; });
  nb::class_<SimulatedHand>(
      m, "SimulatedHand",
      "The hand of a simulation beside its controller: its sensors, and what is true of the hold.")
      .def_static(
          "make",
          [](const std::shared_ptr<Scene>& scene, const std::shared_ptr<HandController>& controller,
             nb::handle optimizer, double friction, const Body& body,
             const SensorSettings& sensors) {
            return std::make_unique<SimulatedHand>(scene, controller, optimizer_of(optimizer),
                                                   friction, body, sensors);
          },
          "scene"_a, "controller"_a, "optimizer"_a, "friction"_a, "body"_a, "sensors"_a,
          "controller: configured. optimizer: the `ForceOptimizer` of the contacts of all fingers. "
          "friction: the true one, over\n"
          "that of the optimizer.")
      .def("reset", &SimulatedHand::reset,
           "Start a new episode and activate the controller; before its first tick the scene\n"
           "stands still.")
      .def("see", &see, "reading"_a.none(), "external"_a, "gravity"_a, "target"_a, "noise"_a.none(),
           "First half of a control tick: read the scene and let the controller observe it.\n"
           "Return False if the reading is not finite or the object is lost.\n"
           "reading: as for `Scene.read`; None: the scene has read it. external: the wrench (6,) "
           "that a perfect sensor reports;\n"
           "gravity (3,); target (19,); noise: standard normal numbers (3 + 3N,) if anything is "
           "noisy.")
      .def("rest", &rest, "external"_a, "gravity"_a, "target"_a, "noise"_a.none(),
           "Set the measured forces as commanded ones, for a hand at rest; arguments as of `see`.")
      .def("begin_step", &SimulatedHand::begin_step, "Begin an agent's step.")
      .def("costs", &SimulatedHand::costs,
           "Return the costs of the step since `begin_step`, on the contacts currently seen.")
      .def("outcome", &outcome, "target"_a, "error"_a, "measured"_a,
           "Return the outcome from the true state; write the pose error (12,) against a target "
           "(19,), and the\n"
           "measured forces (N, 3) in the commanded contact frames [N].")
      .def("step_info", &step_info, "outcome"_a, "measured"_a,
           "Return the report of a step by name: the method's solution, contacts, forces [N], "
           "effort, and an\n"
           "outcome with its measured forces (N, 3). The arrays are copies.")
      .def("seen", &seen, "Views of the observed state by name; overwritten in place.")
      .def_prop_ro("slid", &slid,
                   "View of the distance (N,) that each tip slid on the object since `reset` [m], "
                   "as it feels it.")
      .def_prop_rw(
          "perfect", [](const SimulatedHand& h) { return h.sensors.perfect; },
          [](SimulatedHand& h, bool value) { h.sensors.perfect = value; },
          "True to ignore delay and noise of the sensors.")
      .def_prop_ro(
          "exact", [](const SimulatedHand& h) { return h.sensors.exact(); },
          "True if the scene is seen without delay and noise.");
}
