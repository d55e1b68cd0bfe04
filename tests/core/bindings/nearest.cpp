// The balanced forces inside the cones that are nearest to given ones.
#include <grasp/phi/nearest.hpp>

#include "arrays.hpp"

using namespace grasp;

namespace {

// (force (N, 3), torsion (N,), iterations, -1 if there are no such forces) of all contacts
nb::tuple nearest_forces(const Placement& p, const In& wrench, const In& preload, const In& force) {
  const size_t count = p.contacts.count;
  std::vector<double> f(numbers(force, 3 * count), numbers(force, 3 * count) + 3 * count);
  std::vector<double> turn(count);
  Vec6 w;
  std::copy_n(numbers(wrench, 6), 6, w.begin());
  NearestForces nearest(p.contacts.count);
  const bool found = nearest.solve(p.contacts, ~std::uint64_t(0), p.contacts.positions.data(),
                                   p.contacts.frames.data(), w, {numbers(preload, count), count},
                                   f.data(), turn.data());
  return nb::make_tuple(array(f, {count, 3}), array(turn), found ? nearest.iterations : -1);
}

}  // namespace

void bind_nearest(nb::module_& m) {
  m.def("nearest_forces", &nearest_forces, "placement"_a, "wrench"_a, "preload"_a, "force"_a);
}
