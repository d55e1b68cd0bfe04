// Likely mistakes in contacts, limits and wrenches.
#include <grasp/advice.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

// Call f(limits, wrench) with a wrench (6,), a Jacobian (N, 3 or 6, J) and torque limits (J,), each an array or None.
template <class F>
auto with_limits(const Contacts& contacts, nb::handle wrench, nb::handle jacobian, nb::handle torque_limit, F&& f) {
    const auto numbers = [](nb::handle given, const Buffer& array, auto... shape) -> Doubles {
        if (given.is_none()) return {};
        if (!array.has(shape...)) throw nb::type_error("a C-contiguous float64 array of another shape is needed");
        return {array.data(),
                std::size_t((Py_ssize_t(1) * ... * (shape < 0 ? array.length(sizeof...(shape) == 1 ? 0 : 1) : shape)))};
    };
    const Buffer load(wrench), limit(torque_limit), rows(jacobian);
    const Doubles torques = numbers(torque_limit, limit, Py_ssize_t(-1)), w = numbers(wrench, load, Py_ssize_t(6)),
                  velocities = numbers(jacobian, rows, Py_ssize_t(contacts.count), Py_ssize_t(-1), Py_ssize_t(torques.size()));
    return f(ForceLimits{.jacobian = velocities, .torque_limit = torques}, w);
}
nb::list advice(const Contacts& contacts, nb::handle wrench, nb::handle jacobian, nb::handle torque_limit) {
    nb::list made;
    with_limits(contacts, wrench, jacobian, torque_limit, [&](const ForceLimits& limits, Doubles load) {
        for (const Advice& each : advise(contacts, limits, load))
            made.append(nb::make_tuple(each.near_certain, each.text.c_str()));
    });
    return made;
}
bool is_suspect(const Contacts& contacts, nb::handle wrench, nb::handle jacobian, nb::handle torque_limit) {
    return with_limits(contacts, wrench, jacobian, torque_limit,
                       [&](const ForceLimits& limits, Doubles load) { return looks_wrong(contacts, limits, load); });
}

}  // namespace

void bind_advice(nb::module_& m) {
    m.def("advise", &advice, "contacts"_a, "wrench"_a.none() = nb::none(), "jacobian"_a.none() = nb::none(),
          "torque_limit"_a.none() = nb::none(),
          nb::sig("def advise(contacts: Contacts, wrench: object = None, jacobian: object = None, torque_limit: object = None) "
                  "-> list[tuple[bool, str]]"),
          "Likely mistakes: whether each is near certain, and its text. float64 arrays: (6,), (N, 3 or 6, J), (J,).");
    m.def("looks_wrong", &is_suspect, "contacts"_a, "wrench"_a.none() = nb::none(), "jacobian"_a.none() = nb::none(),
          "torque_limit"_a.none() = nb::none(), "True if some of that advice is near certain.");
}
