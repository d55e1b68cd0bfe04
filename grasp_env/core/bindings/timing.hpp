// Times of compiled calls, for benchmarks.
#pragma once

#include <algorithm>
#include <chrono>

#include <grasp/record.hpp>

#include "buffers.hpp"

// Write the best times (M,) [s] of `passes` calls of solve(wrench, row) for each of (M, 6)
// wrenches.
template <class Solve> void time_calls(nb::handle wrenches, int passes, int size,
                                       nb::handle records, nb::handle best, Solve&& solve) {
  const Numbers loads = in(wrenches, -1, 6);
  const Py_ssize_t many = loads.length(0);
  const Numbers rows = out(records, many, size);
  const Numbers least = out(best, many);
  using clock = std::chrono::steady_clock;
  for (Py_ssize_t k = 0; k < many; ++k) least.data()[k] = std::numeric_limits<double>::infinity();
  for (int pass = 0; pass < passes; ++pass)
    for (Py_ssize_t k = 0; k < many; ++k) {
      const auto begin = clock::now();
      solve(loads.data() + 6 * k, rows.data() + size * k);
      const std::chrono::duration<double> spent = clock::now() - begin;
      least.data()[k] = std::min(least.data()[k], spent.count());
    }
}
