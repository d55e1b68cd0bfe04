// The controller of a hand.
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <grasp/hand/hand_controller.hpp>

#include "optimizer.hpp"
#include "scene.hpp"
#include "views.hpp"
#include "solution.hpp"

using namespace grasp;

namespace {

// The controller, or a ValueError before `configure`.
HandController& configured(nb::handle self) {
  auto& controller = nb::cast<HandController&>(self);
  if (controller.torques.empty()) throw nb::value_error("configure the controller first");
  return controller;
}

// What an agent wants of an update, in arrays that live as long as the call.
class AgentStep {
 public:
  AgentStep(const HandController& controller, nb::handle adjustment, nb::handle start,
            nb::handle command, nb::handle residual, nb::handle margin)
      : adjustment_(adjustment),
        start_(start),
        command_(command),
        residual_(residual),
        margin_(margin) {
    const int fingers = controller.model().tree->fingers();
    const auto forces = [&](const Buffer& from, nb::handle object) {
      if (object.is_none()) return Doubles{};
      if (!from.has(fingers, 3)) throw nb::type_error("forces must be (N, 3)");
      return Doubles(from.numbers());
    };
    const std::size_t columns = controller.settings().directions.size() / (3 * fingers);
    if (!adjustment.is_none()) {
      if (!adjustment_.has(columns)) throw nb::type_error("adjustment must be (K,)");
      step.adjustment = adjustment_.numbers();
    }
    step.force = forces(command_, command);
    step.residual = forces(residual_, residual);
    if (!margin.is_none()) {
      if (!margin_.has(2)) throw nb::type_error("margin must be (2,)");
      step.margin = {margin_.data()[0], margin_.data()[1]};
      if (!step.margin->is_sound())
        throw nb::value_error(
            "margin must be a friction above 0 and at most 1, and a preload of at least 0 N");
    }
    if (!start.is_none()) {
      step.start = Start::given;
      step.force = forces(start_, start);
    }
  }
  StepRequest step;

 private:
  Buffer adjustment_, start_, command_, residual_, margin_;
};

nb::typed<nb::list, double> act(nb::handle self, bool due, nb::handle adjustment, nb::handle start,
                                nb::handle command, nb::handle residual, nb::handle margin) {
  HandController& controller = configured(self);
  if (due) {
    const AgentStep step(controller, adjustment, start, command, residual, margin);
    controller.act(&step.step);
  } else {
    controller.act();
  }
  nb::list out = nb::steal<nb::list>(PyList_New(Py_ssize_t(controller.torques.size())));
  if (!out.is_valid()) throw nb::python_error();
  for (std::size_t j = 0; j < controller.torques.size(); ++j)
    PyList_SET_ITEM(out.ptr(), Py_ssize_t(j), PyFloat_FromDouble(controller.torques[j]));
  return out;
}

nb::object commands(HandController& controller) {
  nb::object out = new_row(npy_intp(controller.commands.size()));
  std::ranges::copy(controller.commands, data_of<double>(out.ptr()));
  return out;
}

View part(nb::handle self, HandPart which, const HandState& state) {
  const std::span<const double> numbers = state[which];
  double* first = const_cast<double*>(numbers.data());
  const auto& of = HandState::TABLE[which];
  if (of.per_tip == 3) return View(first, {numbers.size() / 3, 3}, self);
  return View(first, {numbers.size()}, self);
}

// Python holds views of what `configure` makes.
void configure(HandController& controller, const std::shared_ptr<Tree>& tree,
               const HandControllerSettings& settings, const Calibration& calibration,
               const std::vector<double>& home, nb::handle optimizer) {
  if (!controller.torques.empty())
    throw nb::value_error("this controller is configured already: make a new one");
  if (optimizer.is_none())
    controller.configure(tree, settings, calibration, home);
  else
    controller.configure(tree, settings, calibration, optimizer_of(optimizer), home);
}

template <int PART> void bind_part(nb::class_<HandState>& to) {
  to.def_prop_rw(
      HandState::TABLE[PART].name,
      [](nb::handle self) { return part(self, HandPart(PART), nb::cast<HandState&>(self)); },
      [](HandState& state, nb::handle value) {
        const std::span<double> numbers = state[HandPart(PART)];
        const Buffer given(value);
        if (!given.holds(Py_ssize_t(numbers.size()))) {
          const std::string wanted = std::string(HandState::TABLE[PART].name) +
                                     " of this HandState takes a float64 array of " +
                                     std::to_string(numbers.size()) + " numbers";
          throw nb::type_error(wanted.c_str());
        }
        std::ranges::copy(given.numbers(), numbers.begin());
      });
}
template <int... PARTS_>
void bind_parts(nb::class_<HandState>& to, std::integer_sequence<int, PARTS_...>) {
  (bind_part<PARTS_>(to), ...);
}

Arrays arrays(nb::handle self) {
  auto& c = configured(self);
  GripForces& forces = c.forces();
  Springs& springs = c.springs();
  const std::size_t fingers = c.model().tree->fingers();
  const std::size_t joints = c.torques.size();
  nb::dict named;
  named["wrench"] = part(self, WRENCH, c.state());
  named["positions"] = part(self, POSITIONS, c.state());
  named["normals"] = part(self, NORMALS, c.state());
  named["torques"] = view(self, c.torques, {joints});
  named["preload"] =
      view(self, const_cast<std::vector<double>&>(forces.springs().preload), {fingers});
  named["springs"] = view(self, c.spring_torques, {joints});
  named["force"] = view(self, c.force, {fingers, 3});
  named["optimal"] = view(self, forces.force, {fingers, 3});
  named["frames"] = view(self, const_cast<std::vector<double>&>(c.model().frames), {fingers, 3, 3});
  named["goals"] = View(&springs.goals.data()->u, {fingers, 3}, self);
  named["inwards"] = View(&springs.inwards.data()->u, {fingers, 3}, self);
  named["solution"] = view(self, forces.solution, {forces.solution.size()});
  return named;
}

}  // namespace

void bind_hand_controller(nb::module_& m) {
  if (_import_array() < 0) throw nb::python_error();
  nb::class_<HandState> state(m, "HandState", "What a hand and its sensors know at an update.");
  state.def(nb::init<int, int>(), "joints"_a, "fingers"_a)
      .def_prop_ro(
          "numbers",
          [](nb::handle self) {
            const std::span<double> all = nb::cast<HandState&>(self).numbers();
            return View(all.data(), {all.size()}, self);
          },
          "All parts in one row, for messages.");
  bind_parts(state, std::make_integer_sequence<int, PARTS>());
  nb::class_<Spring>(m, "Spring", "Draws a tip to its place.")
      .def(nb::init<double, double, double>(), "gain"_a, "damping"_a, "limit"_a,
           "[N/m], [N s/m], largest force [N]");
  nb::class_<Calibration>(m, "Calibration", "From joint torques to units of motors.")
      .def(nb::init<>())
      .def_static("newton_metres", &Calibration::newton_metres, "hand"_a)
      .def_static("currents", &Calibration::currents, "torque_constant"_a, "largest"_a,
                  "units_per_ampere"_a)
      .def_rw("torques", &Calibration::torques)
      .def_rw("units", &Calibration::units)
      .def_rw("friction", &Calibration::friction)
      .def_rw("dead_band", &Calibration::dead_band)
      .def_rw("fade", &Calibration::fade)
      .def_rw("resolution", &Calibration::resolution)
      .def("check", &Calibration::check, "joints"_a, "Raise a ValueError unless it fits a hand.")
      .def("limit", &Calibration::limit, "joint"_a, "Torque available in both directions [N m].")
      .def("__call__", &Calibration::operator(), "joint"_a, "torque"_a, "wanted"_a = 0.0);
  nb::enum_<Hold>(m, "Hold", "Behaviour of the fingers in contact: see hand_settings.hpp.")
      .value("optimized", Hold::optimized)
      .value("squeeze", Hold::squeeze)
      .value("place", Hold::place)
      .value("direct", Hold::direct)
      .value("reach", Hold::reach);
  using Settings = HandControllerSettings;
  nb::class_<Settings>(m, "HandControllerSettings", "See hand_settings.hpp.")
      .def(nb::init<>())
      .def_rw("friction", &Settings::friction)
      .def_rw("torsional_friction", &Settings::torsional_friction)
      .def_rw("friction_margin", &Settings::friction_margin)
      .def_rw("preload", &Settings::preload)
      .def_rw("rate", &Settings::rate)
      .def_rw("budget", &Settings::budget)
      .def(
          "set_follow",
          [](Settings& c, double tolerance, int limit, bool conic) {
            c.follow = {.method = conic ? Method::conic : Method::newton,
                        .tolerance = tolerance,
                        .limit = limit};
          },
          "tolerance"_a, "limit"_a, "conic"_a = false,
          "Set the solver between two solves of the method, Newton or conic: relative certified "
          "gap, most steps.")
      .def_rw("joint_delay", &Settings::joint_delay)
      .def_rw("grip", &Settings::grip)
      .def_rw("place", &Settings::place)
      .def_rw("reach_stiffness", &Settings::reach_stiffness)
      .def_rw("reach_force", &Settings::reach_force)
      .def_rw("reach_limit", &Settings::reach_limit)
      .def_rw("posture_stiffness", &Settings::posture_stiffness)
      .def_rw("posture_damping", &Settings::posture_damping)
      .def_rw("damping", &Settings::damping)
      .def_rw("force_rate", &Settings::force_rate)
      .def_rw("torque_rate", &Settings::torque_rate)
      .def_rw("release", &Settings::release)
      .def_rw("stale", &Settings::stale)
      .def_rw("stale_wrench", &Settings::stale_wrench)
      .def_rw("grace", &Settings::grace)
      .def_rw("fade", &Settings::fade)
      .def_rw("remembers", &Settings::remembers)
      .def_rw("directions", &Settings::directions)
      .def_rw("squeeze", &Settings::squeeze);
  nb::class_<Effort>(m, "Effort",
                     "Effort of solvers and motors since an agent's step began: see "
                     "hand_settings.hpp.")
      .def_ro("iterations", &Effort::iterations)
      .def_ro("trials", &Effort::trials)
      .def_ro("followed", &Effort::followed)
      .def_ro("limited", &Effort::limited)
      .def_ro("saturated", &Effort::saturated)
      .def_ro("margin", &Effort::margin)
      .def_ro("share", &Effort::share);
  nb::class_<HandRecording>(m, "HandRecording", "Rows of a hand controller: see recording.hpp.")
      .def_prop_ro("columns", &HandRecording::columns, "Names of the columns, with their units.")
      .def_prop_ro("header", &HandRecording::header, "JSON of all that a replay needs.")
      .def_prop_ro("full", &HandRecording::full, "True if no row fits any more.")
      .def(
          "rows",
          [](const HandRecording& r) {
            return array_of({r.numbers().begin(), r.numbers().end()}, {r.rows(), r.width()});
          },
          "Return a copy of the rows.")
      .def("write", &HandRecording::write, "path"_a, "Write CSV; the file appears when complete.");
  nb::list statuses;
  for (const char* status : HandController::STATUSES) statuses.append(status);
  nb::class_<HandController> controller(
      m, "HandController", "The controller of a torque-controlled hand: see hand_controller.hpp.");
  controller.attr("STATUSES") = nb::tuple(statuses);
  controller.def(nb::init<>())
      .def("configure", &configure, "hand"_a, "settings"_a, "calibration"_a, "home"_a,
           "optimizer"_a.none() = nb::none(),
           "Make all objects of an update. home: (M,) posture of the gains. optimizer: the "
           "`ForceOptimizer` of agents' steps\n"
           "for the contacts of all fingers, which is copied; None: Newton with the friction and "
           "the margin of the settings.")
      .def("activate", &HandController::activate, "state"_a,
           "Start at a state, from which torques rise from zero; False: it is not of this hand or "
           "not finite.")
      .def("take_hold", &HandController::take_hold,
           "Make the places of the touching fingers where they are now, once a grasp has settled.")
      .def("deactivate", &HandController::deactivate, "Command zero torque from now on.")
      .def(
          "update",
          [](HandController& c, const HandState& state, double period) {
            c.update(state, period);
            return commands(c);
          },
          "state"_a, "period"_a,
          "Return commands (M,) in device units for the newest state; period: since the last "
          "update [s].")
      .def("record", &HandController::record, "seconds"_a,
           "Record from the next `activate` on, for as many seconds at most.")
      .def_prop_ro(
          "recording",
          [](const HandController& c) -> const HandRecording& { return c.recording(); },
          nb::rv_policy::reference_internal, "What was recorded since `activate`.")
      .def_prop_ro(
          "torque_limits", [](nb::handle self) { return configured(self).model().limits; },
          "(M,) torques that motors and calibration give [N m].")
      .def_prop_ro(
          "friction_used",
          [](nb::handle self) {
            const auto& c = nb::cast<HandController&>(self);
            return view(self, c.friction_used().data(), {c.friction_used().size()});
          },
          "(N,) share of the friction that each commanded force uses.")
      .def("observe", &HandController::observe, "state"_a, "period"_a,
           "First half of `update`: take the state and count the fingers in contact.")
      .def("act", &act, "due"_a, "adjustment"_a = nb::none(), "start"_a = nb::none(),
           "given"_a = nb::none(), "residual"_a = nb::none(), "margin"_a = nb::none(),
           "Second half of `update`: find forces, and return the joint torques (M,) [N m] that "
           "produce them.\n"
           "due: True if an agent's step begins, with adjustment (K,) [N] of the start. start: (N, "
           "3) [N], contact frames,\n"
           "start of the method; given: (N, 3) [N], contact frames, forces for `Hold.direct`. "
           "residual: (N, 3) [N], contact\n"
           "frames: moves the optimal forces to the nearest balanced ones of their sum. margin: "
           "(2,) friction [1] and preload [N].")
      .def_rw("hold", &HandController::hold, "Behaviour of the fingers in contact.")
      .def_prop_ro(
          "status", [](const HandController& c) { return HandController::STATUSES[c.status]; },
          "What the torques do.")
      .def_ro("duration", &HandController::duration, "Time of the last update [s].")
      .def_ro("late", &HandController::late, "Number of updates after a missed deadline.")
      .def_ro("over_budget", &HandController::over_budget,
              "Number of updates longer than the budget.")
      .def_prop_ro("effort", [](nb::handle self) { return configured(self).forces().effort; })
      .def_prop_ro(
          "code", [](nb::handle self) { return int(configured(self).code()); },
          "Code of the method's last solve.")
      .def_prop_ro(
          "closure", [](nb::handle self) { return configured(self).closure(); },
          "True if forces balance the wrench.")
      .def("arrays", &arrays, "Views of the commands by name; overwritten in place.")
      .def_ro("mask", &HandController::mask, "Fingers that count as in contact: 2^i for finger i.")
      .def_ro("changes", &HandController::changes, "Number of changes of `mask`.")
      .def_ro("rising", &HandController::rising,
              "True if torques are on their way, as fast as they may change.")
      .def_ro("peak", &HandController::peak, "Largest torque since `activate` [N m].");
}
