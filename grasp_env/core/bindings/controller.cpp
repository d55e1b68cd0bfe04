// The control loop of a hand.
#include <bit>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <grasp/hand/controller.hpp>

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
  Known(const Controller& controller, nb::handle reading, nb::handle external, nb::handle gravity,
        nb::handle target, nb::handle noise)
      : reading_(reading), external_(in(external, 6)), noise_(noise) {
    if (!reading.is_none() &&
        !(reading_.has(-1) && reading_.length(0) >= Reading::size(controller.tree->joints(), 0)))
      throw nb::type_error("reading must be (2M + 13 + 7 contacts,)");
    if (!controller.sensors.exact() && !noise_.has(3 + 3 * controller.tree->fingers()))
      throw nb::type_error("noise must be (3 + 3N,)");
    known = {reading.is_none() ? Doubles{} : reading_.numbers(), external_.data(),
             noise.is_none() ? nullptr : noise_.data(), point(in(gravity, 3).data()),
             target_of(target)};
  }
  Controller::Known known;

 private:
  Buffer reading_;
  Numbers external_;
  Buffer noise_;
};

// The same for an agent's step.
class AgentStep {
 public:
  AgentStep(const Controller& controller, nb::handle adjustment, nb::handle start,
            nb::handle command)
      : adjustment_(adjustment), start_(start), command_(command) {
    const auto forces = [&](const Buffer& from, nb::handle object) {
      if (object.is_none()) return Doubles{};
      if (!from.has(controller.tree->fingers(), 3)) throw nb::type_error("forces must be (N, 3)");
      return Doubles(from.numbers());
    };
    const std::size_t columns = controller.settings.directions.size() / controller.force.size();
    if (!adjustment.is_none()) {
      if (!adjustment_.has(columns)) throw nb::type_error("adjustment must be (K,)");
      step.adjustment = adjustment_.numbers();
    }
    step.force = forces(command_, command);
    if (!start.is_none()) {
      step.start = Start::given;
      step.force = forces(start_, start);
    }
  }
  Controller::StepRequest step;

 private:
  Buffer adjustment_, start_, command_;
};

nb::typed<nb::list, double> list_of(const std::vector<double>& numbers) {
  nb::list out;
  for (double number : numbers) out.append(number);
  return out;
}

nb::typed<nb::list, double> act(Controller& controller, bool due, nb::handle adjustment,
                                nb::handle start, nb::handle command) {
  if (due) {
    const AgentStep step(controller, adjustment, start, command);
    controller.act(&step.step);
  } else {
    controller.act();
  }
  return list_of(controller.torques);
}

bool see(Controller& controller, nb::handle reading, nb::handle external, nb::handle gravity,
         nb::handle target, nb::handle noise) {
  return controller.see(Known(controller, reading, external, gravity, target, noise).known);
}

Controller::Outcome outcome(const Controller& controller, nb::handle target, nb::handle error,
                            nb::handle measured) {
  const Controller::Outcome result =
      controller.outcome(target_of(target), out(measured, controller.tree->fingers(), 3).data());
  const double* first = &result.error.position.u;
  std::copy(first, first + 12, out(error, 12).data());
  return result;
}
static_assert(sizeof(PoseError) == 12 * sizeof(double));

// The data of a step that `step_info` reports.
struct StepReport {
  const Controller& c;
  const Controller::Outcome& outcome;
  const double* measured;
  Record solution{const_cast<double*>(c.solution.data())};  // read only
  bool solved = solution.has_force();
};

PyObject* new_array(const double* from, std::initializer_list<npy_intp> shape) {
  PyObject* result = PyArray_SimpleNew(int(shape.size()), shape.begin(), NPY_DOUBLE);
  if (!result) return nullptr;
  std::copy_n(from, PyArray_SIZE(reinterpret_cast<PyArrayObject*>(result)),
              data_of<double>(result));
  return result;
}
PyObject* touching(const Controller& c) {
  nb::object result = new_row(c.tree->fingers(), NPY_BOOL);
  npy_bool* to = data_of<npy_bool>(result.ptr());
  for (int i = 0; i < c.tree->fingers(); ++i) to[i] = c.scene->now.touching[i] > 0.0;
  return result.release().ptr();
}
PyObject* value(double number) { return PyFloat_FromDouble(number); }
PyObject* value(int number) { return PyLong_FromLong(number); }
PyObject* value(bool truth) { return PyBool_FromLong(truth); }

constexpr double LARGEST_GAP = 1e9;  // reported instead of an infinite gap

constexpr struct {
  const char* name;
  PyObject* (*make)(const StepReport&);
} REPORT_FIELDS[] = {
    {"iterations", [](const StepReport& t) { return value(t.c.effort.iterations); }},
    {"trials", [](const StepReport& t) { return value(t.c.effort.trials); }},
    {"objective",
     [](const StepReport& t) { return value(t.solved ? t.solution.summary().objective : 0.0); }},
    {"optimality_gap",
     [](const StepReport& t) {
       return value(t.solved ? std::min(t.solution.gap(), LARGEST_GAP) : 0.0);
     }},
    {"cone_margin",
     [](const StepReport& t) { return value(t.solved ? t.solution.summary().margin : 0.0); }},
    {"force_closure", [](const StepReport& t) { return value(t.c.closure); }},
    {"contacts", [](const StepReport& t) { return value(std::popcount(t.c.mask)); }},
    {"contact_changes", [](const StepReport& t) { return value(t.c.changes); }},
    {"wrench", [](const StepReport& t) { return new_array(t.c.wrench.data(), {6}); }},
    {"commanded_force",
     [](const StepReport& t) { return new_array(t.c.force.data(), {t.c.tree->fingers(), 3}); }},
    {"measured_force",
     [](const StepReport& t) { return new_array(t.measured, {t.c.tree->fingers(), 3}); }},
    {"force_error", [](const StepReport& t) { return value(t.outcome.force_error); }},
    {"touching", [](const StepReport& t) { return touching(t.c); }},
    {"stray_force", [](const StepReport& t) { return value(t.outcome.stray); }},
    {"slip", [](const StepReport& t) { return value(t.outcome.slip); }},
    {"slip_distance", [](const StepReport& t) { return value(t.outcome.worst.slide); }},
    {"overlap", [](const StepReport& t) { return value(t.outcome.worst.overlap); }},
    {"stray_share", [](const StepReport& t) { return value(t.outcome.worst.stray); }},
    {"drift", [](const StepReport& t) { return value(t.outcome.drift); }},
    {"tilt", [](const StepReport& t) { return value(t.outcome.tilt); }},
    {"peak_torque", [](const StepReport& t) { return value(t.c.peak); }},
    {"followed", [](const StepReport& t) { return value(t.c.effort.followed); }},
    {"limited", [](const StepReport& t) { return value(t.c.effort.limited); }},
    {"torque_margin", [](const StepReport& t) { return value(t.c.effort.margin); }},
    {"torque_share", [](const StepReport& t) { return value(t.c.effort.share); }},
    {"saturated", [](const StepReport& t) { return value(t.c.effort.saturated); }},
};

PyObject* field_names[std::size(REPORT_FIELDS)];  // the names, interned once

nb::typed<nb::dict, nb::str, nb::object> step_info(const Controller& c,
                                                   const Controller::Outcome& outcome,
                                                   nb::handle measured) {
  const StepReport report{c, outcome, in(measured, c.tree->fingers(), 3).data()};
  nb::dict out;
  for (std::size_t k = 0; k < std::size(REPORT_FIELDS); ++k) {
    const nb::object value = nb::steal(REPORT_FIELDS[k].make(report));
    if (!value || PyDict_SetItem(out.ptr(), field_names[k], value.ptr()) < 0)
      throw nb::python_error();
  }
  return out;
}

Arrays arrays(nb::handle self) {
  auto& c = nb::cast<Controller&>(self);
  const std::size_t fingers = c.tree->fingers();
  const std::size_t joints = c.tree->joints();
  nb::dict named;
  named["wrench"] = View(c.wrench.data(), {6}, self);
  named["torques"] = view(self, c.torques, {joints});
  named["force"] = view(self, c.force, {fingers, 3});
  named["frames"] = view(self, c.frames, {fingers, 3, 3});
  named["depths"] = view(self, c.depths, {fingers});
  named["home"] = view(self, c.home, {joints});
  named["goals"] = View(&c.goals.data()->u, {fingers, 3}, self);
  named["inwards"] = View(&c.inwards.data()->u, {fingers, 3}, self);
  named["solution"] = view(self, c.solution, {c.solution.size()});
  return named;
}

Arrays seen(nb::handle self) {
  return arrays_of(self, const_cast<Snapshot&>(nb::cast<Controller&>(self).seen()));
}

}  // namespace

void bind_controller(nb::module_& m) {
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
  nb::class_<Spring>(m, "Spring", "Draws a tip to its place.")
      .def(nb::init<double, double, double>(), "gain"_a, "damping"_a, "limit"_a,
           "[N/m], [N s/m], largest force [N]");
  nb::enum_<WrenchSource>(m, "WrenchSource", "Source of the external wrench.")
      .value("measured", WrenchSource::measured)
      .value("estimated", WrenchSource::estimated)
      .value("none", WrenchSource::none);
  nb::enum_<Hold>(m, "Hold", "Behaviour of the fingers in contact: see control_settings.hpp.")
      .value("optimized", Hold::optimized)
      .value("squeeze", Hold::squeeze)
      .value("place", Hold::place)
      .value("direct", Hold::direct)
      .value("reach", Hold::reach);
  nb::class_<ControlSettings>(m, "ControlSettings",
                              "Object model and gains of a control loop: see control_settings.hpp.")
      .def(nb::init<>())
      .def_rw("body", &ControlSettings::body)
      .def_rw("reach", &ControlSettings::reach)
      .def_rw("spring", &ControlSettings::spring)
      .def_rw("reach_depth", &ControlSettings::reach_depth)
      .def_rw("posture", &ControlSettings::posture)
      .def(
          "set_follow",
          [](ControlSettings& c, double tolerance, int limit, bool conic) {
            c.follow = {.method = conic ? Method::conic : Method::newton,
                        .tolerance = tolerance,
                        .limit = limit};
          },
          "tolerance"_a, "limit"_a, "conic"_a = false,
          "Set the solver between two solves of the method, Newton or conic: relative certified "
          "gap, most steps.")
      .def_rw("remembers", &ControlSettings::remembers)
      .def_rw("directions", &ControlSettings::directions)
      .def_rw("squeeze", &ControlSettings::squeeze)
      .def_rw("most_change", &ControlSettings::most_change)
      .def_rw("release", &ControlSettings::release);
  nb::class_<SensorSettings>(m, "SensorSettings",
                             "Delay and noise of the controller's sensors: see sensing.hpp.")
      .def(nb::init<>())
      .def_rw("wrench", &SensorSettings::wrench)
      .def_rw("tick", &SensorSettings::tick)
      .def_rw("keep", &SensorSettings::keep)
      .def_rw("delay", &SensorSettings::delay)
      .def_rw("wrench_delay", &SensorSettings::wrench_delay)
      .def_rw("pose_noise", &SensorSettings::pose_noise)
      .def_rw("tactile_noise", &SensorSettings::tactile_noise);
  nb::class_<Effort>(m, "Effort",
                     "Effort of solvers and motors since `begin_step`: see control_settings.hpp.")
      .def_ro("iterations", &Effort::iterations)
      .def_ro("trials", &Effort::trials)
      .def_ro("followed", &Effort::followed)
      .def_ro("limited", &Effort::limited)
      .def_ro("saturated", &Effort::saturated)
      .def_ro("margin", &Effort::margin)
      .def_ro("share", &Effort::share);
  nb::class_<Costs>(m, "Costs",
                    "Costs of an agent's step, each from 0 to 1: see control_settings.hpp.")
      .def_ro("force", &Costs::force)
      .def_ro("torque", &Costs::torque)
      .def_ro("change", &Costs::change);
  using Outcome = Controller::Outcome;
  nb::class_<Outcome>(m, "Outcome", "Quality of the hold: see controller.hpp.")
      .def_ro("drift", &Outcome::drift)
      .def_ro("tilt", &Outcome::tilt)
      .def_ro("force_error", &Outcome::force_error)
      .def_ro("slip", &Outcome::slip)
      .def_ro("stray", &Outcome::stray)
      .def_prop_ro("slide", [](const Outcome& o) { return o.worst.slide; })
      .def_prop_ro("overlap", [](const Outcome& o) { return o.worst.overlap; })
      .def_prop_ro("stray_share", [](const Outcome& o) { return o.worst.stray; });
  nb::class_<Controller>(m, "Controller",
                         "The control loop of a hand: from readings to joint torques.")
      .def_static(
          "make",
          [](const std::shared_ptr<Scene>& scene, nb::handle optimizer,
             const ControlSettings& settings, const SensorSettings& sensors) {
            return std::make_unique<Controller>(scene, optimizer_of(optimizer), settings, sensors);
          },
          "scene"_a, "optimizer"_a, "settings"_a, "sensors"_a,
          "optimizer: a `ForceOptimizer` for the contacts of all fingers; it is copied.")
      .def("reset", &Controller::reset,
           "Start a new episode; before its first tick the scene stands still.")
      .def(
          "rewind", [](Controller& c) { c.sensors.reset(); },
          "Reset the sensors to the state before the first tick.")
      .def("see", &see, "reading"_a.none(), "external"_a, "gravity"_a, "target"_a, "noise"_a.none(),
           "First half of a control tick: observe the scene and find the wrench to balance.\n"
           "Return False if the reading is not finite or the object is lost.\n"
           "reading: as for `Scene.read`; None: the scene has read it. external: the wrench (6,) "
           "that a perfect sensor reports;\n"
           "gravity (3,); target (19,); noise: standard normal numbers (3 + 3N,) if anything is "
           "noisy.")
      .def("act", &act, "due"_a, "adjustment"_a.none(), "start"_a.none(), "given"_a.none(),
           "Second half of a tick: find forces, and return the joint torques (M,) [N m] that "
           "produce them.\n"
           "due: True if an agent's step begins, with adjustment (K,) [N] of the start. start: (N, "
           "3) [N], contact frames,\n"
           "start of the method; given: (N, 3) [N], contact frames, forces for `Hold.direct`.")
      .def_rw("hold", &Controller::hold, "Behaviour of the fingers in contact.")
      .def("begin_step", &Controller::begin_step, "Begin an agent's step.")
      .def_ro("effort", &Controller::effort)
      .def("costs", &Controller::costs,
           "Return the costs of the step since `begin_step`, on the contacts currently seen.")
      .def_prop_ro(
          "code", [](const Controller& c) { return int(c.code()); },
          "Code of the method's last solve.")
      .def_ro("closure", &Controller::closure,
              "True if the last tick that optimised found a force.")
      .def("rest", &Controller::rest,
           "Set the measured forces as commanded ones, for a hand at rest.")
      .def("outcome", &outcome, "target"_a, "error"_a, "measured"_a,
           "Return the outcome from the true state; write the pose error (12,) against a target "
           "(19,), and the\n"
           "measured forces (N, 3) in the commanded contact frames [N].")
      .def("step_info", &step_info, "outcome"_a, "measured"_a,
           "Return the report of a step by name: the method's solution, contacts, forces [N], "
           "effort, and an\n"
           "outcome with its measured forces (N, 3). The arrays are copies.")
      .def("arrays", &arrays, "Views of the commands by name; overwritten in place.")
      .def("seen", &seen, "Views of the observed state by name; overwritten in place.")
      .def_prop_rw(
          "perfect", [](const Controller& c) { return c.sensors.perfect; },
          [](Controller& c, bool value) { c.sensors.perfect = value; },
          "True to ignore delay and noise of the sensors.")
      .def_prop_ro(
          "exact", [](const Controller& c) { return c.sensors.exact(); },
          "True if the scene is seen without delay and noise.")
      .def_ro("mask", &Controller::mask, "Fingers that count as in contact: 2^i for finger i.")
      .def_ro("changes", &Controller::changes, "Number of changes of `mask` since `reset`.")
      .def_ro("peak", &Controller::peak, "Largest torque since `reset` [N m].");
}
