// The paper's flows in every form, for studies; `ForceOptimizer` offers two of them as methods.
#include <string>

#include <grasp/flow/flow.hpp>
#include <grasp/math/dispatch.hpp>

#include "problem.hpp"

using namespace grasp;

// The descents of grasp::compiled: studies of a flow have the bits of the method.
#define GRASP_FLOW(...)                                                                          \
  extern template Code FlowSolver<__VA_ARGS__>::descend(NewtonSolver<__VA_ARGS__>&, const Call&, \
                                                        const Vec6&, const Record&);
namespace grasp {
GRASP_FLOW(Lanes<FOUR>, 4 / FOUR)
GRASP_FLOW(Lanes<REGISTER>, 8 / REGISTER)
GRASP_FLOW(Lanes<REGISTER>, 0)
}  // namespace grasp

namespace {

Form form_of(const std::string& name, const Contacts& contacts) {
  if (name == "reduced") return Form::reduced;
  if (name == "paper") return Form::paper;
  if (name != "full") throw nb::value_error("form must be full, paper or reduced");
  if (contacts.count > FULL_CONTACTS)
    throw nb::value_error("the full flow is dense: at most 8 contacts");
  return Form::full;
}

int descend(const Contacts& contacts, const char* name, const Options& options, nb::handle wrench,
            const OwnRequest& request, nb::handle record) {
  const Form form = form_of(name, contacts);
  const int count = contacts.count;
  const Numbers load = in(wrench, 6);
  const Numbers row = out(record, record_size(count));
  const Request& start = request.request;
  if (start.force.size() != std::size_t(3 * count)) throw nb::type_error("expected a force (N, 3)");
  const Call call{.wrench = load.data(),
                  .stop = {options.gap(), options.limit},
                  .optimum = start.optimum,
                  .trace = start.trace.data(),
                  .traced = int(start.trace.size())};
  Code code = REFUSED;
  dispatch(count, [&]<class V, int B>() {
    NewtonSolver<V, B> on(count);
    on.cones.pack(contacts);
    on.cones.load_force(start.force.data(), on.x);
    const Vec6 w = on.cones.unit.of(load.data());
    FlowSolver<V, B> flow(on.cones, options.step_rule, form);
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
  m.def("descend_flow", &descend, "contacts"_a, "form"_a, "options"_a, "wrench"_a, "request"_a,
        "record"_a,
        "Run a flow from the force of a request, balanced and inside the cones; write the record "
        "and return the code.");
  m.def("repeat_step", &repeat, "contacts"_a, "form"_a, "x"_a, "times"_a,
        "Compute the step of a flow at x (3N,), cone coordinates, `times` times; return its last "
        "number.\n"
        "form: full (Eq. 12, up to FULL_CONTACTS), paper (Eq. 26) or reduced, the same in the "
        "cheapest form.");
}
