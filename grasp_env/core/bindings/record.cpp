// The layout of a solution, defined once for both languages.
#include <grasp/record.hpp>

#include "module.hpp"

using grasp::Summary;

namespace {

nb::typed<nb::dict, nb::str, int> record_fields() {
  nb::dict offsets;
  const auto place = [&](const char* name, std::size_t offset) {
    offsets[name] = int(offset / sizeof(double));
  };
  place("code", offsetof(Summary, code));
  place("iterations", offsetof(Summary, iterations));
  place("trials", offsetof(Summary, trials));
  place("objective", offsetof(Summary, objective));
  place("lower_bound", offsetof(Summary, lower_bound));
  place("residual", offsetof(Summary, residual));
  place("margin", offsetof(Summary, margin));
  place("limit_excess", offsetof(Summary, limit_excess));
  place("wrench", offsetof(Summary, wrench));
  place("wrench_with_preload", offsetof(Summary, wrench_with_preload));
  place("multipliers", offsetof(Summary, multipliers));
  place("start", offsetof(Summary, start));
  place("replaced", offsetof(Summary, replaced));
  place("outside", offsetof(Summary, outside));
  place("contacts", offsetof(Summary, contacts));
  place("joints", offsetof(Summary, joints));
  place("limits", offsetof(Summary, limits));
  place("force", sizeof(Summary));
  return offsets;
}

nb::typed<nb::dict, nb::str, int> codes() {
  nb::dict named;
  named["converged"] = int(grasp::CONVERGED);
  named["limit"] = int(grasp::LIMIT);
  named["stalled"] = int(grasp::STALLED);
  named["infeasible"] = int(grasp::INFEASIBLE);
  named["refused"] = int(grasp::REFUSED);
  named["limits_exceeded"] = int(grasp::LIMITS_EXCEEDED);
  named["rank_lost"] = int(grasp::RANK_LOST);
  named["undecided"] = int(grasp::UNDECIDED);
  named["started"] = int(grasp::STARTED);
  return named;
}

nb::typed<nb::tuple, int, nb::ellipsis> codes_with_a_force() {
  nb::list codes;
  for (int code = 0; code <= int(grasp::STARTED); ++code)
    if (grasp::Record::has_force(grasp::Code(code))) codes.append(code);
  return nb::tuple(codes);
}

}  // namespace

void bind_record(nb::module_& m) {
  m.def("record_fields", &record_fields,
        "Return the offsets of a solution's fields in its row; from `force` on: 3N force, 3N "
        "initial force, N torsion.");
  m.def("codes", &codes, "Return the outcomes of a solve by name.");
  m.def("codes_with_a_force", &codes_with_a_force,
        "Return the codes of the rows that contain a force.");
  m.def(
      "record_size",
      [](int contacts) {
        if (contacts < 0 || contacts > 1'000'000)
          throw nb::value_error("contacts must be 0 to 1,000,000");
        return grasp::record_size(contacts);
      },
      "contacts"_a, "Return the number of values in a row of N contacts.");
}
