// The paper's flows in every form, for studies; `ForceOptimizer` offers two of them as methods.
#include <string>

#include <grasp/flow/flow.hpp>
#include <grasp/math/dispatch.hpp>

#include "rule.hpp"

using namespace grasp;

namespace {

Form form_of(const std::string& name, const Contacts& contacts) {
    if (name == "reduced") return Form::reduced;
    if (name == "paper") return Form::paper;
    if (name != "full") throw nb::value_error("form must be full, paper or reduced");
    if (contacts.count > FULL_CONTACTS) throw nb::value_error("the full flow is dense: at most 8 contacts");
    return Form::full;
}

// Run a flow in the given form from a force (N, 3).
int descend(const Contacts& contacts, const char* name, nb::handle rule, double tolerance, int limit, nb::handle wrench,
            nb::handle force, double optimum, nb::handle trace, nb::handle record) {
    const Form form = form_of(name, contacts);
    const StepRule steps = rule_of(rule);
    const int count = contacts.count;
    const Numbers load = in(wrench, 6), start = in(force, count, 3), values = out(trace, -1),
                  row = out(record, record_size(count));
    const Call call{.wrench = load.data(), .optimum = optimum, .trace = values.data(), .traced = int(values.length(0))};
    Code code = REFUSED;
    dispatch(count, [&]<class V, int B>() {
        NewtonSolver<V, B> on(count, {tolerance, limit});
        on.cones.pack(contacts);
        on.cones.load_force(start.data(), on.x);
        const Vec6 w = on.cones.unit.of(load.data());
        FlowSolver<V, B> flow(on.cones, steps, form);
        if (is_valid_wrench(load.data()) && on.is_start(w) && flow.place(on.cones))
            code = flow.descend(on, call, w, Record(row.data(), count));
    });
    return code;
}

double repeat(const Contacts& contacts, const char* name, nb::handle x, int times) {
    const Form form = form_of(name, contacts);
    const double* at = in(x, 3 * contacts.count).data();
    double last = 0.0;
    dispatch(contacts.count, [&]<class V, int B>() {
        Cones<V, B> cones(contacts.count);
        cones.pack(contacts);
        auto from = cones.field();
        cones.load(at, from);
        FlowSolver<V, B> flow(cones, StepRule{}, form);
        if (flow.place(cones)) last = flow.repeat(cones, from, times);
    });
    return last;
}

}  // namespace

void bind_flow(nb::module_& m) {
    m.attr("FULL_CONTACTS") = FULL_CONTACTS;
    m.def("descend_flow", &descend, "contacts"_a, "form"_a, "rule"_a, "tolerance"_a, "limit"_a, "wrench"_a, "force"_a,
          "optimum"_a, "trace"_a, "record"_a,
          "Run a flow from a balanced force (N, 3) inside the cones; write the record and return the code. rule: (5,) kind, "
          "first,\n"
          "grow, shrink, decrease, see `step_size.py`; optimum: a known min Phi or nan; trace: (T,) receives Phi of iterates "
          "0..T-1.");
    m.def("repeat_step", &repeat, "contacts"_a, "form"_a, "x"_a, "times"_a,
          "Compute the step of a flow at x (3N,), cone coordinates, `times` times; return its last number.\n"
          "form: full (Eq. 12, up to FULL_CONTACTS), paper (Eq. 26) or reduced, the same in the cheapest form.");
}
