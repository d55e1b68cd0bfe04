// Problems on many grasps.
#include <grasp/many/grasps.hpp>

#include <nanobind/stl/pair.h>

#include "buffers.hpp"
#include "problem.hpp"

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

// Copies of placed contacts with a share of their friction; `placed` then points to them.
std::vector<Contacts> narrow(std::vector<const Contacts*>& placed, double share) {
  std::vector<Contacts> narrowed;
  narrowed.reserve(placed.size());
  for (const Contacts*& one : placed) {
    Contacts& copy = narrowed.emplace_back(*one);
    copy.narrow(share);
    copy.place(one->positions.data(), one->normals.data());
    one = &copy;
  }
  return narrowed;
}

template <Solve solve, Method method, Start start>
void solve_contacts(nb::list contacts, nb::handle weights, nb::handle first,
                    std::pair<double, int> stop, nb::handle wrenches, nb::handle records,
                    nb::handle given_margin) {
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
  const Margin margin = margin_of(given_margin, int(count));
  const int size = record_size(int(count));
  const int whole = record_size(int(count), 0, 0);
  nb::gil_scoped_release free;
  std::vector<Contacts> narrowed;
  if (margin.friction < 1.0) narrowed = narrow(placed, margin.friction);
  Preload preload(margin.preload, int(count));
  std::vector<double> shifted(loads.data(), loads.data() + 6 * many);
  const auto each = [&](auto&& f) {
    for (Py_ssize_t u = 0; u < grasps; ++u)
      for (auto k = Py_ssize_t(begins.data()[u]); k < Py_ssize_t(begins.data()[u + 1]); ++k)
        f(*placed[u], k);
  };
  if (preload.any)
    each([&](const Contacts& at, Py_ssize_t k) {
      std::ranges::copy(preload.added_to(&shifted[6 * k], at), &shifted[6 * k]);
    });
  const Grasps problems(int(count), grasps, placed.data(), omega_lambda.data(), begins.data());
  std::vector<double> answers(size * many);
  solve(problems, {stop.first, stop.second}, {many, shifted.data(), answers.data()});
  each([&](const Contacts& at, Py_ssize_t k) {
    double* row = std::copy_n(&answers[size * k], size, rows.data() + whole * k) - size;
    const Record record(row, int(count));
    Summary& s = record.summary();
    s.start = double(start);
    s.contacts = double(count);
    s.replaced = s.outside = s.joints = s.limits = 0.0;
    std::copy_n(&loads.data()[6 * k], 6, s.wrench.begin());
    std::copy_n(&shifted[6 * k], 6, s.wrench_with_preload.begin());
    const double offset = preload.cost(int(count), [&](int i) {
      return cost_of_normal_force(method, omega_lambda.data()[2 * i], at.scale[3 * i]);
    });
    s.objective += offset;
    s.lower_bound += offset;
    preload.add_to(record.force(), int(count));
    preload.add_to(record.initial_force(), int(count));
    std::copy_n(at.frames.data(), 9 * count, record.frames());
    write_friction_used(at, margin.friction, record, record.friction_used());
  });
}

}  // namespace

void bind_grasps(nb::module_& m) {
  const char* arguments =
      "Solve wrenches on U placed contacts, with `weights` (N, 2) for all; wrenches first[u] to "
      "first[u + 1] - 1 belong to\n"
      "contacts u. stop: relative gap, and largest number of steps. margin: as for `Problem`.\n"
      "Writes complete rows of solutions; releases the GIL.\n"
      "REFUSED: soft contacts, or no force closure.";
  const auto bind = [&](const char* name, auto solve) {
    m.def(name, solve, "contacts"_a, "weights"_a, "first"_a, "stop"_a, "wrenches"_a, "records"_a,
          "margin"_a.none() = nb::none(), arguments);
  };
  bind("newton_grasps", &solve_contacts<newton_grasps, Method::newton, Start::internal_force>);
  bind("conic_grasps", &solve_contacts<conic_grasps, Method::conic, Start::central>);
}
