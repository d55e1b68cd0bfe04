// Likely mistakes in contacts, limits and wrenches.
#include <grasp/advice.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

// Call f(limits, wrench) with a wrench (6,), a Jacobian (N, 3 or 6, J) and torque limits (J,), each an array or None.
template <class F>
auto with_limits(const Contacts& contacts, nb::handle wrench, nb::handle jacobian, nb::handle torque_limit, F&& f) {
    const Buffer load(wrench), limit(torque_limit), rows(jacobian);
    if (!((wrench.is_none() || load.has(6)) && (torque_limit.is_none() || limit.has(-1)) &&
          (jacobian.is_none() || rows.has(contacts.count, -1, -1))))
        throw nb::type_error("a C-contiguous float64 array of another shape is needed");
    const auto numbers = [](nb::handle given, const Buffer& array, auto size) {
        return given.is_none() ? Doubles{} : Doubles{array.data(), std::size_t(size())};
    };
    return f(ForceLimits{.jacobian = numbers(jacobian, rows, [&] { return contacts.count * rows.length(1) * rows.length(2); }),
                         .torque_limit = numbers(torque_limit, limit, [&] { return limit.length(0); })},
             numbers(wrench, load, [] { return 6; }));
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
