// Cones, the linear system and the starts, on registers of so many lanes: x in and out as (3N,) cone coordinates.
#include <nanobind/stl/vector.h>

#include <grasp/terms/limits.hpp>

#include "arrays.hpp"

using namespace grasp;

namespace {

template <class V> class Insides {
public:
    using Field = typename Cones<V, 0>::Field;

    explicit Insides(const Placement& p) : contacts_(p.contacts), newton_(contacts_.count, StopRule{}) {
        newton_.cones.pack(contacts_);
        starter().tangents.load(contacts_.frames.data(), contacts_.count);
    }

    double phi(const In& x) const { return cones().phi(field(x)); }
    nb::tuple along(const In& x, const In& step, double alpha) const {
        const Field a = field(x), b = field(step, 0.0);
        return nb::make_tuple(cones().phi_along(a, b, alpha), cones().slope_along(a, b, alpha));
    }
    nb::object wrench(const In& x) const { return array(cones().wrench(field(x))); }
    nb::object balance(const In& x, const In& w) const {
        Field a = field(x);
        cones().balance(a, six(w));
        return out(a);
    }
    double reach(const In& x, const In& step) const { return cones().reach(field(x), field(step, 0.0)); }
    double margin(const In& x) const { return cones().margin(field(x)); }
    double lower_bound(const In& nu, const In& w) const { return cones().lower_bound(six(nu), six(w)); }
    double lower_bound_near(const In& nu, const In& w, const In& x, double tight) const {
        return cones().lower_bound(six(nu), six(w), field(x), tight);
    }
    nb::object certified(const In& x, const In& w) const {
        std::vector<double> row(record_size(contacts_.count));
        cones().certify(field(x), six(w), Record(row.data(), contacts_.count));
        return array(row);
    }

    // whether S is definite, G H^-1 grad, G x, the multipliers, the step at them, G step
    nb::tuple system(const In& x, const In& w) {
        const Field at = field(x);
        auto& system = newton_.system;
        const bool good = system.assemble(cones(), at);
        const Vec6 nu = system.multipliers(system.made + six(w));
        Field step = cones().field();
        const Vec6 moved = system.direction(cones(), nu, step);
        return nb::make_tuple(good, array(system.pull), array(system.made), array(nu), out(step), array(moved));
    }
    // x corrected by the change that is least in the Hessian at `at`, and its G x
    nb::tuple restore(const In& at, const In& missed, const In& x) {
        Field changed = field(x);
        newton_.system.assemble(cones(), field(at));
        const Vec6 made = newton_.system.restore(cones(), six(missed), changed);
        return nb::make_tuple(out(changed), array(made));
    }
    double squeezed(const In& x) const { return best_scale(cones(), field(x)); }
    nb::tuple inside(const In& point, const In& ray) const {
        const Interval found = grasp::inside(cones(), field(point), field(ray));
        return nb::make_tuple(found.low, found.high);
    }

    nb::object rest() {
        Field found = cones().field();
        return newton_.find_rest(found) ? out(found) : nb::none();
    }
    nb::object begun(const In& rest, const In& w) const {
        Field x = cones().field();
        begin(cones(), field(rest), six(w), x);
        return out(x);
    }
    // one problem from the internal force; none without one
    nb::object solved(const In& wrench, double tolerance) {
        Field found = cones().field();
        if (!newton_.find_rest(found)) return nb::none();
        newton_.options.tolerance = tolerance;
        std::vector<double> row(record_size(contacts_.count));
        newton_.solve_from(found, {.wrench = numbers(wrench, 6)}, Record(row.data(), contacts_.count));
        return array(row);
    }

    // Rows (M, 3) on contacts with bounds, shares and weights (3, M): what prices of the rows at x prove with nu, and the prices' sums
    // over each pair (N, 3); see `LimitTerms::farkas`.
    nb::tuple farkas(const In& rows, const std::vector<int>& owners, const In& table, const In& x, const In& nu,
                     const In& w) const {
        const int many = int(owners.size());
        const double* t = numbers(table, 3 * many);
        LimitTerms<V, 0> terms;
        terms.reserve(cones(), many);
        terms.pack(cones(), {many, numbers(rows, 3 * many), t, t + many, t + 2 * many, owners.data()});
        const Field at = field(x);
        Field slope = cones().field();
        for (auto& each : slope) each = {V{}, V{}, V{}};
        for (int b = 0; b < int(at.size()); ++b) {
            Sym3<V> unused{};
            terms.bend(b, at[b], slope[b], unused);
        }
        const auto found = terms.farkas(cones(), six(nu), six(w));
        Vec6 proof = six(nu);
        const bool hopeless = terms.proves_infeasible(cones(), proof, six(w));
        return nb::make_tuple(hopeless, found.value, found.share, found.size, array(found.nu), out(slope));
    }

    // basis (13, 3N) in cone coordinates; frames (N, 3, 3) it is written in
    void set_basis(const In& basis, const In& frames) {
        starter().set_basis(cones(), numbers(basis, 13 * size()), numbers(frames, 3 * size()));
    }
    nb::object combine(const In& wrench) {
        Field x = cones().field();
        starter().combine(numbers(wrench, 6), x);
        return out(x);
    }
    // found or not, and the combination carried to the current contacts
    nb::tuple combination(const In& wrench, bool moved) {
        Field x = cones().field();
        starter().moved = moved;
        const Vec6 w = contacts_.unit.of(numbers(wrench, 6));
        const bool found = starter().combination(cones(), newton_.system, wrench.data(), w, x);
        return nb::make_tuple(found, out(x));
    }
    nb::object turned(const In& x, const In& frames) {
        Tangents<V, 0> from(cones());
        from.load(numbers(frames, 3 * size()), contacts_.count);
        Field turned = cones().field();
        starter().turn(cones(), field(x), from, turned);
        return out(turned);
    }
    nb::tuple segment(const In& safe, const In& x) {
        Field end = field(x);
        const double theta = starter().segment(cones(), field(safe), end);
        return nb::make_tuple(theta, out(end));
    }
private:
    Contacts contacts_;
    NewtonSolver<V, 0> newton_;

    const Cones<V, 0>& cones() const { return newton_.cones; }
    Starter<V, 0>& starter() { return newton_.starter; }
    size_t size() const { return 3 * contacts_.count; }
    // empty: what stands in the lanes that hold no contact, as a force (1, 0, 0) or as a step (0, 0, 0)
    Field field(const In& x, double empty = 1.0) const {
        Field made = cones().field();
        for (auto& triple : made) triple.u = all<V>(empty);
        cones().load(numbers(x, size()), made);
        return made;
    }
    nb::object out(const Field& x) const {
        std::vector<double> stored(size());
        cones().store(x, stored.data());
        return array(stored);
    }
};

template <class V> void bind(nb::module_& m, const char* name) {
    using I = Insides<V>;
    nb::class_<I>(m, name)
        .def(nb::init<const Placement&>())
        .def("phi", &I::phi)
        .def("along", &I::along)
        .def("wrench", &I::wrench)
        .def("balance", &I::balance)
        .def("reach", &I::reach)
        .def("margin", &I::margin)
        .def("lower_bound", &I::lower_bound)
        .def("lower_bound_near", &I::lower_bound_near)
        .def("certified", &I::certified)
        .def("system", &I::system)
        .def("restore", &I::restore)
        .def("squeezed", &I::squeezed)
        .def("inside", &I::inside)
        .def("rest", &I::rest)
        .def("begun", &I::begun)
        .def("solved", &I::solved)
        .def("farkas", &I::farkas)
        .def("set_basis", &I::set_basis)
        .def("combine", &I::combine)
        .def("combination", &I::combination)
        .def("turned", &I::turned)
        .def("segment", &I::segment);
}

}  // namespace

void bind_insides(nb::module_& m) { bind<Lanes<1>>(m, "Insides1"), bind<Lanes<4>>(m, "Insides4"), bind<Lanes<8>>(m, "Insides8"); }
