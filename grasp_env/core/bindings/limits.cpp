// Limits of a hand as rows.
#include <grasp/limits/force_limits.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

std::span<const double> span(const Numbers& numbers, Py_ssize_t count) { return {numbers.data(), size_t(count)}; }

// Write all finite limits as rows on force and torsion, (M, N, 4), with bounds and the size of each limit (M,). Return M.
int limit_rows(nb::handle least, nb::handle most, nb::handle jacobian, nb::handle torques, nb::handle biases, nb::handle matrix,
               nb::handle bounds, nb::handle limited) {
    const Numbers low = in(least, -1), limit = in(torques, -1);
    const Py_ssize_t count = low.length(0), joints = limit.length(0), most_rows = 2 * (count + joints);
    const Numbers high = in(most, count), jac = in(jacobian, count, 4, joints), bias = in(biases, joints);
    const Numbers to = out(matrix, most_rows, count, 4), bound = out(bounds, most_rows), size = out(limited, most_rows);
    const ForceLimits limits{span(low, count), span(high, count), span(jac, 4 * count * joints), span(limit, joints),
                             span(bias, joints)};
    std::vector<double> row(4 * count);
    int rows = 0;
    limits.rows(int(count), 4, row, [&](std::span<const double> made, double b, double whole) {
        std::copy(made.begin(), made.end(), to.data() + 4 * count * rows);
        bound.data()[rows] = b, size.data()[rows++] = whole;
    });
    return rows;
}

}  // namespace

void bind_limits(nb::module_& m) {
    m.def("limit_rows", &limit_rows, "least"_a, "most"_a, "jacobian"_a, "torques"_a, "biases"_a, "matrix"_a, "bounds"_a,
          "limited"_a,
          "Write finite limits of normal forces (N,) and, with a Jacobian (N, 4, J), of torques (J,), as rows A f <= b on force\n"
          "and torsion: A (R, N, 4), b (R,) and the size of each limit (R,), with R = 2 (N + J). Return the number of rows.");
}
