// `grasp::Problem`, `grasp::Options` and `grasp::Request`.
#include "problem.hpp"

#include <array>
#include <string_view>

#include <nanobind/stl/pair.h>

#include "solution.hpp"

using namespace grasp;

namespace {

// The numbers of an array; empty for None.
template <class... Sizes> std::vector<double> copied(nb::handle array, Sizes... sizes) {
  if (array.is_none()) return {};
  const Numbers values = in(array, sizes...);
  return {values.numbers().begin(), values.numbers().end()};
}

StepRule rule_of(nb::handle numbers) {
  const Numbers rule = in(numbers, 5);
  const double* p = rule.data();
  if (!(p[0] >= 0.0 && p[0] <= double(StepRule::EXACT)))
    throw nb::value_error("no such kind of step rule");
  return {int(p[0]), p[1], p[2], p[3], p[4]};
}

void make_problem(OwnProblem* self, const Contacts& contacts, nb::handle weights, nb::handle limits,
                  nb::handle margin) {
  OwnProblem problem{contacts};
  if (weights.is_none()) {
    problem.contacts.set_weights(Objective{});
  } else if (PyTuple_Check(weights.ptr())) {
    const auto [omega, lambda] = nb::cast<std::pair<double, double>>(weights);
    problem.contacts.set_weights(Objective{omega, lambda});
  } else {
    problem.contacts.set_weights(in(weights, contacts.count, 2).data());
  }
  if (!limits.is_none()) {
    const nb::tuple arrays = nb::cast<nb::tuple>(limits);
    if (arrays.size() != 5) throw nb::type_error("expected the five arrays of `ForceLimits`");
    problem.min_normal = copied(arrays[0], contacts.count);
    problem.max_normal = copied(arrays[1], contacts.count);
    problem.torque_limit = copied(arrays[3], -1);
    problem.jacobian = copied(arrays[2], contacts.count, -1, problem.torque_limit.size());
    problem.torque_bias = copied(arrays[4], problem.torque_limit.size());
  }
  const Margin read = margin_of(margin, contacts.count);
  problem.friction_margin = read.friction;
  for (int i = 0; i < contacts.count; ++i) problem.preload.push_back(read.preload[i]);
  new (self) OwnProblem(std::move(problem));
}

template <class T, std::size_t N>
T named(const std::pair<std::string_view, T> (&all)[N], std::string_view name) {
  for (const auto& [known, value] : all)
    if (name == known) return value;
  throw nb::value_error("no such name");
}
constexpr std::pair<std::string_view, Method> METHODS[] = {{"newton", Method::newton},
                                                           {"reduced_flow", Method::reduced_flow},
                                                           {"full_flow", Method::full_flow},
                                                           {"conic", Method::conic}};
constexpr std::pair<std::string_view, Criterion> CRITERIA[] = {
    {"sum", Criterion::sum}, {"max", Criterion::largest}, {"torque", Criterion::torque}};
Start start_of(int start) {
  if (start < 0 || start > int(Start::central)) throw nb::value_error("no such start");
  return Start(start);
}

void make_options(Options* self, const char* method, const char* criterion, int start,
                  double tolerance, int limit, bool elastic, nb::handle step_rule,
                  const Model* model, bool remembers) {
  Options options{.method = named(METHODS, method),
                  .criterion = named(CRITERIA, criterion),
                  .start = start_of(start),
                  .tolerance = tolerance,
                  .limit = limit,
                  .elastic = elastic,
                  .remembers = remembers};
  if (!step_rule.is_none()) options.step_rule = rule_of(step_rule);
  if (model) options.model = std::make_shared<const Model>(*model);
  new (self) Options(std::move(options));
}

void make_request(OwnRequest* self, int start, nb::object force, nb::object previous,
                  double optimum, nb::object trace) {
  OwnRequest own{.force = force, .previous = previous, .trace = trace};
  own.request.start = start_of(start);
  own.request.optimum = optimum;
  if (!force.is_none()) own.request.force = in(force, -1, 3).numbers();
  if (!previous.is_none()) own.request.previous = row_of(previous);
  if (!trace.is_none()) own.request.trace = out(trace, -1).numbers();
  new (self) OwnRequest(std::move(own));
}

}  // namespace

void bind_problem(nb::module_& m) {
  nb::class_<OwnProblem>(
      m, "Problem",
      "`grasp::Problem`: contacts with the weights of Phi, and limits besides friction.")
      .def("__init__", &make_problem, "contacts"_a, "weights"_a.none() = nb::none(),
           "limits"_a.none() = nb::none(), "margin"_a.none() = nb::none(),
           "weights: omega and lambda of all contacts, or an array (N, 2); None: 1 and 0.01.\n"
           "limits: (min_normal, max_normal, jacobian, torque_limit, torque_bias), each an array "
           "or None.\n"
           "margin: None, a float, or an object with `friction` and `preload`.");
  nb::class_<Options>(m, "Options", "`grasp::Options`.")
      .def("__init__", &make_options, nb::kw_only(), "method"_a = "newton", "criterion"_a = "sum",
           "start"_a = 0, "tolerance"_a = 0.0, "limit"_a = 20000, "elastic"_a = false,
           "step_rule"_a.none() = nb::none(), "model"_a.none() = nb::none(), "remembers"_a = true,
           "criterion: sum, max or torque; start: index into the names of `Start`;\n"
           "step_rule: (5,) kind, first, grow, shrink, decrease.");
  nb::class_<OwnRequest>(
      m, "Request",
      "`grasp::Request` without its wrench and changes: the start of a call, and a study of it.")
      .def("__init__", &make_request, nb::kw_only(), "start"_a = 0, "force"_a.none() = nb::none(),
           "previous"_a.none() = nb::none(), "optimum"_a = std::numeric_limits<double>::quiet_NaN(),
           "trace"_a.none() = nb::none(),
           "force: (N, 3) [N]; previous: a solution; optimum: a known minimum of Phi;\n"
           "trace: (T,) receives Phi of the first iterates.");
}
