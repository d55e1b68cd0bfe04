// The force that nearly balances a wrench.
#include <grasp/phi/elastic.hpp>

#include "arrays.hpp"

using namespace grasp;

namespace {

// (force (N, 3), torsion (N,), iterations), from a guess; touching: bits
nb::tuple elastic_balance(const Placement& p, std::uint64_t touching, const In& wrench, int limit,
                          const In& force, const In& torsion) {
  const size_t count = p.contacts.count;
  std::vector<double> f(numbers(force, 3 * count), numbers(force, 3 * count) + 3 * count);
  std::vector<double> turn(numbers(torsion, count), numbers(torsion, count) + count);
  Vec6 w;
  std::copy_n(numbers(wrench, 6), 6, w.begin());
  ElasticBalance balance(p.contacts.count);
  balance.solve(p.contacts, touching, p.contacts.positions.data(), p.contacts.frames.data(), w,
                limit, f.data(), turn.data());
  return nb::make_tuple(array(f, {count, 3}), array(turn), balance.iterations);
}

}  // namespace

void bind_elastic(nb::module_& m) {
  m.attr("SOFTNESS") = ElasticBalance::SOFTNESS;
  m.def("elastic_balance", &elastic_balance, "placement"_a, "touching"_a, "wrench"_a, "limit"_a,
        "force"_a, "torsion"_a);
}
