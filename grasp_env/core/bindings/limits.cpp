// Limits of a hand as rows.
#include <grasp/limits/force_limits.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

std::span<const double> span(const Numbers& numbers, Py_ssize_t count) {
  return {numbers.data(), size_t(count)};
}

// Write all finite limits as rows on force and torsion, (M, N, 4), with bounds and the size of each
// limit (M,). Return M.
int limit_rows(nb::tuple given, nb::handle matrix, nb::handle bounds, nb::handle limited) {
  if (given.size() != 5) throw nb::type_error("expected the five arrays of `ForceLimits`");
  const Numbers low = in(given[0], -1);
  const Numbers limit = in(given[3], -1);
  const Py_ssize_t count = low.length(0);
  const Py_ssize_t joints = limit.length(0);
  const Py_ssize_t most_rows = 2 * (count + joints);
  const Numbers high = in(given[1], count);
  const Numbers jac = in(given[2], count, 4, joints);
  const Numbers bias = in(given[4], joints);
  const Numbers to = out(matrix, most_rows, count, 4);
  const Numbers bound = out(bounds, most_rows);
  const Numbers size = out(limited, most_rows);
  const ForceLimits limits{span(low, count), span(high, count), span(jac, 4 * count * joints),
                           span(limit, joints), span(bias, joints)};
  std::vector<double> row(4 * count);
  int rows = 0;
  limits.rows(int(count), 4, row,
              [&](std::span<const double> coefficients, double b, double whole) {
                std::copy(coefficients.begin(), coefficients.end(), to.data() + 4 * count * rows);
                bound.data()[rows] = b;
                size.data()[rows++] = whole;
              });
  return rows;
}

}  // namespace

void bind_limits(nb::module_& m) {
  m.def("limit_rows", &limit_rows, "limits"_a, "matrix"_a, "bounds"_a, "limited"_a,
        "Write the finite limits of (min_normal (N,), max_normal (N,), jacobian (N, 4, J), "
        "torque_limit (J,), torque_bias "
        "(J,)) as rows\n"
        "A f <= b on force and torsion: A (R, N, 4), b (R,) and the size of each limit (R,), with "
        "R = 2 (N + J). Return the "
        "number of rows.");
}
