// Newton with soft contacts in every layout.
#include "calls.hpp"

using namespace grasp;
using namespace grasp::generic;

namespace {

std::unique_ptr<Calls<SoftNewton>> make(int lanes, int blocks, const Placement& p, double tolerance, int limit, const In& divisor,
                                        const In& basis) {
    return std::make_unique<Calls<SoftNewton>>(
        instance_of<detail::SoftAny, SoftNewton>(lanes, blocks, p.contacts, Stop{tolerance, limit},
                                                 numbers(divisor, p.contacts.count), numbers(basis, 39 * p.contacts.count)));
}

}  // namespace

void bind_soft(nb::module_& m) { bind_calls(m, "AnySoft", &make); }
