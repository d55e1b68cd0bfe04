// Problems on many grasps.
#include <grasp/many/grasps.hpp>

#include <nanobind/stl/pair.h>

#include "buffers.hpp"

using namespace grasp;

namespace {

using Solve = void (*)(const Grasps&, const StopRule&, const SolveBatch&);

void check_first(const Numbers& first, Py_ssize_t grasps, Py_ssize_t many) {
  bool rises = first.data()[0] == 0.0 && first.data()[grasps] == double(many);
  for (Py_ssize_t u = 0; u < grasps; ++u) {
    const double from = first.data()[u];
    const double until = first.data()[u + 1];
    rises = rises && from == std::floor(from) && from <= until;
  }
  if (!rises) throw nb::value_error("first must rise from 0 to the number of wrenches");
}

template <Solve solve, Start start>
void solve_contacts(nb::list contacts, nb::handle weights, nb::handle first,
                    std::pair<double, int> stop, nb::handle wrenches, nb::handle records) {
  const Numbers omega_lambda = in(weights, -1, 2);
  const Numbers loads = in(wrenches, -1, 6);
  const Py_ssize_t count = omega_lambda.length(0);
  const Py_ssize_t many = loads.length(0);
  const Py_ssize_t grasps = Py_ssize_t(contacts.size());
  const Numbers begins = in(first, grasps + 1);
  const Numbers rows = out(records, many, record_size(int(count), 0, 0));
  check_first(begins, grasps, many);
  std::vector<const Contacts*> placed;
  placed.reserve(grasps);
  for (const nb::handle object : contacts) {
    const Contacts* one = nullptr;
    if (!nb::try_cast(object, one) || !one || one->count != count)
      throw nb::type_error("contacts must have N contacts each");
    placed.push_back(one);
  }
  const Grasps problems(int(count), grasps, placed.data(), omega_lambda.data(), begins.data());
  const int size = record_size(int(count));
  const int whole = record_size(int(count), 0, 0);
  nb::gil_scoped_release free;
  std::vector<double> answers(size * many);
  solve(problems, {stop.first, stop.second}, {many, loads.data(), answers.data()});
  for (Py_ssize_t u = 0; u < grasps; ++u)
    for (auto k = Py_ssize_t(begins.data()[u]); k < Py_ssize_t(begins.data()[u + 1]); ++k) {
      double* row = std::copy_n(&answers[size * k], size, rows.data() + whole * k) - size;
      const Record record(row, int(count));
      Summary& s = record.summary();
      s.start = double(start);
      s.contacts = double(count);
      s.replaced = s.outside = s.joints = s.limits = 0.0;
      std::copy_n(placed[u]->frames.data(), 9 * count, record.frames());
    }
}

}  // namespace

void bind_grasps(nb::module_& m) {
  const char* arguments =
      "Solve wrenches on U placed contacts, with `weights` (N, 2) for all; wrenches first[u] to "
      "first[u + 1] - 1 belong to\n"
      "contacts u. stop: relative gap, and largest number of steps. Writes complete rows of "
      "solutions; releases the GIL.\n"
      "REFUSED: soft contacts, or no force closure.";
  const auto bind = [&](const char* name, auto solve) {
    m.def(name, solve, "contacts"_a, "weights"_a, "first"_a, "stop"_a, "wrenches"_a, "records"_a,
          arguments);
  };
  bind("newton_grasps", &solve_contacts<newton_grasps, Start::internal_force>);
  bind("conic_grasps", &solve_contacts<conic_grasps, Start::central>);
}
