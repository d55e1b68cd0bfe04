// The paper's gradient flows.
#include <nanobind/stl/unique_ptr.h>

#include <string>

#include <grasp/solvers.hpp>

#include "rule.hpp"

using namespace grasp;
using namespace grasp::generic;

namespace {

Form form_of(const std::string& name, const Contacts& contacts) {
    if (name == "reduced") return Form::reduced;
    if (name == "paper") return Form::paper;
    if (name != "full") throw nb::value_error("form: full, paper or reduced");
    if (contacts.count > FULL_CONTACTS) throw nb::value_error("the full flow is dense: at most 8 contacts");
    return Form::full;
}

std::unique_ptr<Flow> make(const Contacts& contacts, double tolerance, int limit, const char* form, nb::handle rule) {
    return Flow::make(contacts, {tolerance, limit}, form_of(form, contacts), rule_of(rule));
}

double repeat(Flow& flow, nb::handle x, int times) { return flow.repeat(in(x, 3 * flow.contacts.count).data(), times); }

}  // namespace

void bind_flow(nb::module_& m) {
    m.attr("FULL_CONTACTS") = FULL_CONTACTS;
    nb::class_<Flow, Newton>(m, "Flow", "The paper's flows: all of Newton's calls, with their steps.")
        .def_static("on", &make, "contacts"_a, "tolerance"_a, "limit"_a, "form"_a, "rule"_a,
                    "form: full (Eq. 12, up to FULL_CONTACTS), paper (Eq. 26) or reduced, the same in the fewest products.\n"
                    "rule: (5,) kind, first, grow, shrink, decrease, see `step_size.py`.")
        .def("repeat", &repeat, "x"_a, "times"_a, "Makes the step at x (3N,) so many times; for measurements.");
}
