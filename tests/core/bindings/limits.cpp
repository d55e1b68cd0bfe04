// Newton within limits in every layout.
#include "calls.hpp"

using namespace grasp;
using namespace grasp::generic;

namespace {

// rows: (M, 7) a, b, share, lambda, contact
std::unique_ptr<Calls<LimitedNewton>> make(int lanes, int blocks, const Placement& p, double tolerance, int limit, const In& rows,
                                           const In& basis, bool elastic) {
    const size_t many = rows.shape(0);
    const double* from = numbers(rows, 7 * many);
    std::vector<double> normals, bounds, shares, weights;
    std::vector<int> contacts;
    for (size_t m = 0; m < many; ++m, from += 7) {
        normals.insert(normals.end(), from, from + 3);
        bounds.push_back(from[3]), shares.push_back(from[4]), weights.push_back(from[5]), contacts.push_back(int(from[6]));
    }
    const LimitRows given{int(many), normals.data(), bounds.data(), shares.data(), weights.data(), contacts.data()};
    return std::make_unique<Calls<LimitedNewton>>(instance_of<detail::LimitedAny, LimitedNewton>(
        lanes, blocks, p.contacts, Stop{tolerance, limit}, given, numbers(basis, 39 * p.contacts.count), elastic));
}

}  // namespace

void bind_limits(nb::module_& m) { bind_calls(m, "AnyLimited", &make); }
