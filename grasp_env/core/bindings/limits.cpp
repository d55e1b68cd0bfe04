// Limits of a hand as rows.
#include <grasp/limits/force_limits.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

int limit_rows(nb::tuple arrays, nb::handle matrix, nb::handle bounds, nb::handle limited) {
  if (arrays.size() != 5) throw nb::type_error("expected the five arrays of `ForceLimits`");
  const Numbers low = in(arrays[0], -1);
  const Numbers limit = in(arrays[3], -1);
  const Py_ssize_t count = low.length(0);
  const Py_ssize_t joints = limit.length(0);
  const Py_ssize_t most_rows = 2 * (count + joints);
  const Numbers high = in(arrays[1], count);
  const Numbers jac = in(arrays[2], count, 4, joints);
  const Numbers bias = in(arrays[4], joints);
  const Numbers to = out(matrix, most_rows, count, 4);
  const Numbers bound = out(bounds, most_rows);
  const Numbers size = out(limited, most_rows);
  const ForceLimits limits{low.numbers(), high.numbers(), jac.numbers(), limit.numbers(),
                           bias.numbers()};
  std::vector<double> row(4 * count);
  int rows = 0;
  limits.rows(int(count), 4, row,
              [&](std::span<const double> coefficients, double b, double whole) {
                std::ranges::copy(coefficients, to.data() + 4 * count * rows);
                bound.data()[rows] = b;
                size.data()[rows++] = whole;
              });
  return rows;
}

}  // namespace

void bind_limits(nb::module_& m) {
  m.def("limit_rows", &limit_rows, "limits"_a, "matrix"_a, "bounds"_a, "limited"_a,
        "Write the finite limits of (min_normal (N,), max_normal (N,), jacobian (N, 4, J), "
        "torque_limit (J,), torque_bias\n"
        "(J,)) as rows A f <= b on force and torsion: A (R, N, 4), b (R,) and the size of each "
        "limit (R,), R = 2 (N + J).\n"
        "Return the number of rows.");
}
