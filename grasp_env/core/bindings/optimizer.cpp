// `grasp::ForceOptimizer`. Control loops call `solve`: it reads arrays in place and makes its solution without running Python. It
// returns None if it cannot read an argument, or if the outcome needs a message; Python then takes over.
#include "optimizer.hpp"

#include <grasp/many/basis.hpp>

#include "buffers.hpp"
#include "rule.hpp"
#include "solution.hpp"
#include "timing.hpp"

using namespace grasp;

namespace {

// The numbers of an array that can be read in place.
class ArrayArgument {
public:
    explicit ArrayArgument(nb::handle object) {
        if (object.is_none()) return;
        given_ = true;
        if (!PyArray_Check(object.ptr())) return;
        const PyArrayObject* a = reinterpret_cast<PyArrayObject*>(object.ptr());
        if (PyArray_TYPE(a) == NPY_DOUBLE && PyArray_ISCARRAY_RO(const_cast<PyArrayObject*>(a)))
            array_ = const_cast<PyArrayObject*>(a);
    }
    bool given() const { return given_; }
    // True if the array has this shape; -1: any length.
    bool has(std::initializer_list<npy_intp> shape) const {
        if (!array_ || PyArray_NDIM(array_) != int(shape.size())) return false;
        int axis = 0;
        for (npy_intp wanted : shape)
            if (const npy_intp size = PyArray_DIM(array_, axis++); wanted >= 0 && size != wanted) return false;
        return true;
    }
    const double* data() const { return static_cast<double*>(PyArray_DATA(array_)); }
    Doubles numbers() const { return {data(), std::size_t(PyArray_SIZE(array_))}; }

private:
    PyArrayObject* array_ = nullptr;
    bool given_ = false;
};

class Solver {
public:
    ForceOptimizer on;
    const int count, joints;
    nb::object previous = nb::none();  // last solution with a force

    // kind: the class of solutions; method: its name; starts: the name of each `Start` in solutions
    Solver(const Problem& problem, const Options& options, nb::object kind, nb::object method, nb::tuple starts, nb::object name,
           bool remembers)
        : on(problem, options), count(problem.contacts.count), joints(int(problem.limits.torque_limit.size())),
          remembers_(remembers), default_start_(options.start), kind_(kind), method_(method), name_(name), starts_(starts) {}

    // Return a solution; None if an argument cannot be read in place, or if there is no force, with its row in `ended`.
    nb::object solve(nb::handle wrench, nb::handle positions, nb::handle normals, nb::handle friction, nb::handle jacobian,
                     nb::handle torque_bias, nb::handle contacts) {
        ended = nb::none();
        Request ask{};
        if (!read(ask, wrench, positions, normals, friction, jacobian, torque_bias, contacts)) return nb::none();
        if (remembers_ && !previous.is_none()) ask.previous = row_of(previous.ptr());
        return made(ask, default_start_, nb::handle());
    }
    // The same from a start of this call. initial: name of the start for the solution; None: its own.
    nb::object solve_from(int start, nb::handle initial, nb::handle force, nb::handle before, double optimum, nb::handle trace,
                          nb::handle wrench, nb::handle positions, nb::handle normals, nb::handle friction, nb::handle jacobian,
                          nb::handle torque_bias, nb::handle contacts) {
        ended = nb::none();
        Request ask{};
        if (!read(ask, wrench, positions, normals, friction, jacobian, torque_bias, contacts))
            throw nb::type_error("expected C-contiguous float64 arrays");
        from(ask, start, force, before);
        ask.optimum = optimum;
        if (!trace.is_none()) ask.trace = {out(trace, -1).data(), std::size_t(out(trace, -1).length(0))};
        return made(ask, Start(start), initial);
    }
    // Return the start alone, as the force of a record with code LIMIT, or the reason why there is none.
    nb::object start(int start, nb::handle force, nb::handle before, nb::handle wrench, nb::handle positions, nb::handle normals,
                     nb::handle friction, nb::handle jacobian, nb::handle torque_bias, nb::handle contacts) {
        Request ask{};
        if (!read(ask, wrench, positions, normals, friction, jacobian, torque_bias, contacts))
            throw nb::type_error("expected C-contiguous float64 arrays");
        from(ask, start, force, before);
        nb::object row = new_row();
        on.start(ask, data(row.ptr()));
        return row;
    }
    bool update(nb::handle positions, nb::handle normals, nb::handle friction, nb::handle jacobian, nb::handle torque_bias) {
        Request ask{};
        if (!now(ask, positions, normals, friction, jacobian, torque_bias, nb::none()))
            throw nb::type_error("expected C-contiguous float64 arrays");
        return on.update(ask.now);
    }
    nb::object ended = nb::none();

private:
    const bool remembers_;
    const Start default_start_;
    nb::object kind_, method_, name_;
    nb::tuple starts_;

    static double* data(PyObject* array) { return static_cast<double*>(PyArray_DATA(reinterpret_cast<PyArrayObject*>(array))); }
    static const double* row_of(PyObject* solution) { return data(record_of(solution)); }
    nb::object new_row() const {
        npy_intp size = on.size();
        nb::object row = nb::steal(PyArray_SimpleNew(1, &size, NPY_DOUBLE));
        if (!row) throw nb::python_error();
        return row;
    }

    bool now(Request& ask, nb::handle positions, nb::handle normals, nb::handle friction, nb::handle jacobian,
             nb::handle torque_bias, nb::handle contacts) {
        const auto take = [](const ArrayArgument& given, std::initializer_list<npy_intp> shape, Doubles& to) {
            if (!given.given()) return true;
            if (!given.has(shape)) return false;
            to = given.numbers();
            return true;
        };
        if (!take(ArrayArgument(positions), {count, 3}, ask.now.positions) ||
            !take(ArrayArgument(normals), {count, 3}, ask.now.normals) ||
            !take(ArrayArgument(torque_bias), {joints}, ask.now.torque_bias))
            return false;
        if (!friction.is_none()) {
            if (PyFloat_CheckExact(friction.ptr())) {
                friction_ = PyFloat_AsDouble(friction.ptr()), ask.now.friction = {&friction_, 1};
            } else if (const ArrayArgument given(friction); given.has({count}) || given.has({count, 2})) {
                ask.now.friction = given.numbers();
            } else {
                return false;
            }
        }
        if (const ArrayArgument given(jacobian); given.given()) {
            if (!given.has({count, 3, joints}) && !given.has({count, 6, joints})) return false;
            ask.now.jacobian = given.numbers();
        }
        if (contacts.is_none()) return true;
        if (!PyArray_Check(contacts.ptr())) return false;
        PyArrayObject* which = reinterpret_cast<PyArrayObject*>(contacts.ptr());
        if (PyArray_TYPE(which) != NPY_BOOL || PyArray_NDIM(which) != 1 || PyArray_DIM(which, 0) != count || count > 64)
            return false;
        ask.now.contacts = 0;
        for (int i = 0; i < count; ++i)
            ask.now.contacts |= std::uint64_t(*static_cast<npy_bool*>(PyArray_GETPTR1(which, i)) != 0) << i;
        return true;
    }
    bool read(Request& ask, nb::handle wrench, nb::handle positions, nb::handle normals, nb::handle friction, nb::handle jacobian,
              nb::handle torque_bias, nb::handle contacts) {
        const ArrayArgument load(wrench);
        if (!load.has({6})) return false;
        ask.wrench = load.data();
        return now(ask, positions, normals, friction, jacobian, torque_bias, contacts);
    }
    void from(Request& ask, int start, nb::handle force, nb::handle before) const {
        if (start < 0 || start > int(Start::central)) throw nb::value_error("no such start");
        ask.start = Start(start);
        if (const ArrayArgument given(force); given.given()) {
            if (!given.has({count, 3})) throw nb::type_error("expected a C-contiguous float64 array (N, 3)");
            ask.force = given.numbers();
        }
        if (!before.is_none()) ask.previous = row_of(before.ptr());
    }
    nb::object made(const Request& ask, Start requested, nb::handle initial) {
        nb::object row = new_row();
        double* numbers = data(row.ptr());
        on.solve(ask, numbers);
        const Record record(numbers);
        if (!record.has_force()) {
            ended = row;
            return nb::none();
        }
        const Summary& s = record.summary();
        const int used = int(s.start);
        const bool named = initial.is_valid() && !initial.is_none();  // the start of this call has a name
        nb::handle name = named && used == int(Start::given) ? initial : starts_[used];
        nb::object noted_name;
        if (s.replaced != 0.0 || s.outside != 0.0) {
            const nb::handle wanted = named                                                         ? initial
                                      : requested == default_start_ || requested == Start::standard ? nb::handle(name_)
                                                                                                    : starts_[int(requested)];
            noted_name = nb::module_::import_("grasp_env.force.solution")
                             .attr("start_name")(name, wanted, s.replaced != 0.0, s.outside != 0.0);
            name = noted_name;
        }
        nb::object solution = nb::steal(new_solution(kind_.ptr(), row.ptr(), method_.ptr(), name.ptr()));
        if (!solution) throw nb::python_error();
        previous = solution;
        return solution;
    }
    double friction_ = 0.0;
};

// The numbers of an array of this shape, -1: any length; empty for None.
template <class... Sizes> std::vector<double> copied(nb::handle array, Sizes... sizes) {
    if (array.is_none()) return {};
    const Numbers given = in(array, sizes...);
    std::size_t total = 1;
    for (int a = 0; a < given.axes(); ++a) total *= std::size_t(given.length(a));
    return {given.data(), given.data() + total};
}

Solver* make(const Contacts& given, nb::handle weights, double force_weight, double barrier_weight, nb::handle min_normal,
             nb::handle max_normal, nb::handle jacobian, nb::handle torque_limit, nb::handle torque_bias, const char* method,
             bool largest, int start, double tolerance, int limit, bool elastic, nb::handle rule, const Model* model,
             nb::object kind, nb::object name, nb::tuple starts, nb::object asked_name, bool remembers) {
    Contacts contacts = given;
    if (weights.is_none()) contacts.set_weights(Objective{force_weight, barrier_weight});
    else contacts.set_weights(in(weights, contacts.count, 2).data());
    const int count = contacts.count;
    const std::vector<double> least = copied(min_normal, count), most = copied(max_normal, count),
                              torques = copied(torque_limit, -1), bias = copied(torque_bias, torques.size()),
                              moves = copied(jacobian, count, -1, torques.size());
    const std::string method_name = method;
    Options options{.method = method_name == "newton"         ? Method::newton
                              : method_name == "reduced_flow" ? Method::reduced_flow
                              : method_name == "full_flow"    ? Method::full_flow
                                                              : Method::conic,
                    .criterion = largest ? Criterion::largest : Criterion::sum,
                    .start = Start(start),
                    .tolerance = tolerance,
                    .limit = limit,
                    .elastic = elastic};
    if (!rule.is_none()) options.step_rule = rule_of(rule);
    if (model) options.model = std::make_shared<const Model>(*model);
    return new Solver({contacts, {least, most, moves, torques, bias}}, options, kind, name, starts, asked_name, remembers);
}

void solve_many(const Solver& solver, nb::handle wrenches, nb::handle rows) {
    const Doubles loads = [&] {
        const Numbers given = in(wrenches, -1, 6);
        return Doubles(given.data(), std::size_t(6 * given.length(0)));
    }();
    const Numbers to = out(rows, Py_ssize_t(loads.size() / 6), solver.on.size());
    const ForceOptimizer own = solver.on;  // copied while the GIL still protects it
    nb::gil_scoped_release free;
    own.solve_many(loads, {to.data(), loads.size() / 6 * solver.on.size()});
}

void times(Solver& solver, nb::handle wrenches, int passes, nb::handle rows, nb::handle best) {
    time_calls(wrenches, passes, solver.on.size(), rows, best, [&](const double* wrench, double* row) {
        Request ask{};
        ask.wrench = wrench;
        solver.on.solve(ask, row);
    });
}

nb::typed<nb::tuple, int, int, double> deepest(Solver& solver, nb::handle wrench, nb::handle force, nb::handle torsion,
                                               nb::handle twist) {
    const Numbers load = in(wrench, 6), to = out(force, solver.count, 3), turn = out(torsion, solver.count),
                  proof = out(twist, 6);
    const std::size_t count = solver.count;
    const Deepest found = solver.on.deepest(Wrench(load.data(), 6), {to.data(), 3 * count}, {turn.data(), count});
    std::copy(found.twist.begin(), found.twist.end(), proof.data());
    return nb::make_tuple(int(found.code), found.iterations, found.margin);
}

double fill_basis(Solver& solver, nb::handle basis, bool warm) {
    const std::size_t size = 39 * std::size_t(solver.count);
    return solver.on.make_basis({out(basis, 13, 3 * solver.count).data(), size}, warm);
}

// combine a 12-basis (13, M) into (M,)
void combine(nb::handle basis, nb::handle wrench, bool printed, nb::handle to) {
    const Numbers rows = in(basis, 13, -1), load = in(wrench, 6);
    const Py_ssize_t size = rows.length(1);
    const Numbers sum = out(to, size);
    const Combination made(load.data(), printed);
    std::fill(sum.data(), sum.data() + size, 0.0);
    for (int k = 0; k < 7; ++k)
        for (Py_ssize_t j = 0; j < size; ++j) sum.data()[j] += made.weights[k] * rows.data()[size * made.rows[k] + j];
}

}  // namespace

const ForceOptimizer& optimizer_of(nb::handle solver) { return nb::cast<const Solver&>(solver).on; }

void bind_optimizer(nb::module_& m) {
    if (_import_array() < 0) throw nb::python_error();
    m.attr("ACCEPTED_GAP") = ACCEPTED_GAP, m.attr("CLEAR") = CLEAR;
    m.def("combine", &combine, "basis"_a, "wrench"_a, "printed"_a, "to"_a,
          "Combine a 12-basis with the optimum at rest (13, M) for a wrench, into (M,). printed: without the optimum at rest\n"
          "(Eqs. 33, 34).");
    nb::class_<Solver>(m, "ForceOptimizer", "`grasp::ForceOptimizer`; use `grasp_env.force.ForceOptimizer`.")
        .def_static(
            "make", &make, "contacts"_a, "weights"_a.none() = nb::none(), "force_weight"_a = 1.0, "barrier_weight"_a = 0.01,
            "min_normal"_a.none() = nb::none(), "max_normal"_a.none() = nb::none(), "jacobian"_a.none() = nb::none(),
            "torque_limit"_a.none() = nb::none(), "torque_bias"_a.none() = nb::none(), "method"_a = "newton", "largest"_a = false,
            "start"_a = 0, "tolerance"_a = 0.0, "limit"_a = 20000, "elastic"_a = false, "rule"_a.none() = nb::none(),
            "model"_a.none() = nb::none(), "kind"_a = nb::none(), "name"_a = nb::none(), "starts"_a = nb::tuple(),
            "asked"_a = nb::none(), "remembers"_a = false,
            "See `Problem` and `Options`. start: index into `starts`, the names of each `Start`; kind: the class of solutions;\n"
            "asked: the name of the requested start; remembers: True if calls get the previous solution.")
        .def("solve", &Solver::solve, "wrench"_a.none(), "positions"_a.none(), "normals"_a.none(), "friction"_a.none(),
             "jacobian"_a.none(), "torque_bias"_a.none(), "contacts"_a.none(),
             "Return a solution; None if an argument cannot be read in place, or if there is no force and `ended` holds the row.")
        .def("solve_from", &Solver::solve_from, "start"_a, "initial"_a.none(), "force"_a.none(), "before"_a.none(), "optimum"_a,
             "trace"_a.none(), "wrench"_a, "positions"_a.none(), "normals"_a.none(), "friction"_a.none(), "jacobian"_a.none(),
             "torque_bias"_a.none(), "contacts"_a.none(),
             "The same from a start of this call. optimum: a known minimum or nan; trace: (T,) receives Phi of the first "
             "iterates.")
        .def("start", &Solver::start, "start"_a, "force"_a.none(), "before"_a.none(), "wrench"_a, "positions"_a.none(),
             "normals"_a.none(), "friction"_a.none(), "jacobian"_a.none(), "torque_bias"_a.none(), "contacts"_a.none(),
             "Return the row of the start alone.")
        .def("update", &Solver::update, "positions"_a.none(), "normals"_a.none(), "friction"_a.none(), "jacobian"_a.none(),
             "torque_bias"_a.none(),
             "Replace contacts and limits for later calls. Return False, with nothing changed, if they are not possible.")
        .def(
            "set_basis",
            [](Solver& s, nb::handle basis) { s.on.set_basis({in(basis, 13, 3 * s.count).data(), std::size_t(39 * s.count)}); },
            "basis"_a, "Set the 12-basis with the optimum at rest, (13, 3N) cone coordinates.")
        .def("make_basis", &fill_basis, "basis"_a, "warm"_a,
             "Compute that basis into `basis` and use it. Return the worst relative gap; inf: not converged, nan: no force "
             "closure.\n"
             "warm: `basis` holds that of nearby contacts.")
        .def(
            "deepest", &deepest, "wrench"_a, "force"_a, "torsion"_a, "twist"_a,
            "Find the force (N, 3) and torsion (N,) deepest inside cones and limits, or the twist (6,) that proves that none is\n"
            "inside. Return (code, iterations, margin).")
        .def("solve_many", &solve_many, "wrenches"_a, "rows"_a, "Solve (M, 6) wrenches into (M, size); releases the GIL.")
        .def("times", &times, "wrenches"_a, "passes"_a, "rows"_a, "best"_a,
             "Measure the best time (M,) [s] of `passes` independent calls for each of (M, 6) wrenches, and write the last rows.")
        .def_rw("previous", &Solver::previous, nb::for_setter(nb::arg("solution").none()), "Last solution with a force, or None.")
        .def_ro("ended", &Solver::ended,
                "Row of the last call that returned None without a force; None if it could not read its arguments.")
        .def_ro("count", &Solver::count, "Number of contacts.")
        .def_prop_ro("size", [](const Solver& s) { return s.on.size(); }, "Number of values in a row.");
}
