// The engine behind `ForceOptimizer`, with its rows and starts as they are.
#include <grasp/optimizer.hpp>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include "allocations.hpp"
#include "arrays.hpp"

using namespace grasp;

namespace {

using Some = std::optional<In>;

Doubles all(const Some& a) { return a ? Doubles(a->data(), a->size()) : Doubles(); }

std::vector<float> singles(const In& a, size_t size) {
  const double* from = numbers(a, size);
  return {from, from + size};
}
// sizes, weights: of the network; pairs: (2 M, 6); null_space: in forces
std::shared_ptr<const Model> model(const std::vector<int>& sizes, const In& weights,
                                   const In& pairs, const In& null_space) {
  auto model = std::make_shared<Model>();
  model->network = Network(sizes, singles(weights, Network::numbers(sizes)).data());
  model->normalisation = {0.2, 0.05, 0.5, 1.3, 0.4, 0.12};
  const int rows = int(pairs.size() / 6);
  std::vector<float> flat(7 * rows);  // inputs x outputs, then no bias
  for (int k = 0; k < rows; ++k)
    for (int r = 0; r < 6; ++r) flat[rows * r + k] = float(pairs.data()[6 * k + r]);
  model->pairs = Network(std::vector{6, rows}, flat.data());
  model->friction = 0.5;
  model->largest = 20.0;
  model->null_space.assign(null_space.data(), null_space.data() + null_space.size());
  return model;
}
struct Predicts {
  std::shared_ptr<const Model> model;
};

class AnyOptimizer {
 public:
  explicit AnyOptimizer(std::unique_ptr<detail::Engine> on) : on_(std::move(on)) {}
  // limits: min_normal, max_normal (N,), jacobian (N, 3 or 6, J), torque_limit, torque_bias (J,);
  // rule: (5,) of `StepRule`
  static std::unique_ptr<AnyOptimizer> make(const Placement& p, int method, int criterion,
                                            int start, double tolerance, int limit, bool elastic,
                                            const Some& min_normal, const Some& max_normal,
                                            const Some& jacobian, const Some& torque_limit,
                                            const Some& torque_bias, const Some& rule,
                                            const Predicts* predicts) {
    Options options{.method = Method(method),
                    .criterion = Criterion(criterion),
                    .start = Start(start),
                    .tolerance = tolerance,
                    .limit = limit,
                    .elastic = elastic};
    if (const Doubles r = all(rule); !r.empty())
      options.step_rule = {int(r[0]), r[1], r[2], r[3], r[4]};
    if (predicts) options.model = predicts->model;
    const Problem problem{
        p.contacts,
        {all(min_normal), all(max_normal), all(jacobian), all(torque_limit), all(torque_bias)}};
    return std::make_unique<AnyOptimizer>(detail::make_engine<REGISTER>(problem, options));
  }
  std::unique_ptr<AnyOptimizer> clone() const {
    return std::make_unique<AnyOptimizer>(on_->clone());
  }

  // The row, and Phi of the first `traced` iterates.
  nb::tuple solve(const In& wrench, int start, const Some& force, const Some& torsion,
                  const Some& previous, double optimum, int traced, const Some& positions,
                  const Some& normals) {
    std::vector<double> row(on_->size());
    std::vector<double> trace(traced, -1.0);
    Request request{.wrench = numbers(wrench, 6),
                    .now = {.positions = all(positions), .normals = all(normals)},
                    .start = Start(start),
                    .force = all(force),
                    .torsion = all(torsion),
                    .optimum = optimum,
                    .trace = trace};
    if (previous) request.previous = numbers(*previous, row.size());
    on_->solve(request, row.data());
    return nb::make_tuple(array(row), array(trace));
  }
  nb::object start(const In& wrench, int start, const Some& force, const Some& previous) {
    std::vector<double> row(on_->size());
    Request request{.wrench = numbers(wrench, 6), .start = Start(start), .force = all(force)};
    if (previous) request.previous = numbers(*previous, row.size());
    on_->start(request, row.data());
    return array(row);
  }
  nb::object solve_many(const In& wrenches) {
    const size_t many = wrenches.shape(0);
    const size_t size = on_->size();
    std::vector<double> rows(many * size);
    on_->solve_many(std::ptrdiff_t(many), numbers(wrenches, 6 * many), rows.data());
    return array(rows, {many, size});
  }
  nb::tuple make_basis() {
    std::vector<double> basis(39 * on_->home().count);
    const double gap = on_->make_basis(basis.data(), false);
    return nb::make_tuple(gap, array(basis, {13, size_t(3 * on_->home().count)}));
  }
  // Solves with and without the row of the solve before; positions and normals (M, N, 3) or none.
  long allocations_in(const In& wrenches, const Some& positions, const Some& normals, int calls) {
    const int many = int(wrenches.shape(0));
    const int size = on_->size();
    const size_t triples = 3 * on_->home().count;
    std::vector<double> row(size);
    std::vector<double> before(size);
    const double* w = numbers(wrenches, 6 * many);
    on_->solve({.wrench = w}, before.data());
    const auto of = [&](const Some& a, int k) {
      return a ? all(a).subspan(triples * k, triples) : Doubles();
    };
    return counted([&] {
      for (int k = 0; k < calls; ++k) {
        const int j = k % many;
        Request request{.wrench = w + 6 * j,
                        .now = {.positions = of(positions, j), .normals = of(normals, j)}};
        if (k % 2) {
          request.previous = before.data();
          request.start = Start::previous;
        }
        on_->solve(request, row.data());
        if (Record(row.data()).has_force()) std::swap(row, before);
      }
    });
  }

 private:
  std::unique_ptr<detail::Engine> on_;
};

}  // namespace

void bind_optimizer(nb::module_& m) {
  using A = AnyOptimizer;
  const auto none = nb::none();
  nb::class_<Predicts>(m, "Model")
      .def_static("make", [](const std::vector<int>& sizes, const In& weights, const In& pairs,
                             const In& null_space) {
        return Predicts{model(sizes, weights, pairs, null_space)};
      });
  nb::class_<A>(m, "AnyOptimizer")
      .def_static("make", &A::make, "placement"_a, "method"_a = 0, "criterion"_a = 0, "start"_a = 0,
                  "tolerance"_a = 0.0, "limit"_a = 20000, "elastic"_a = false,
                  "min_normal"_a = none, "max_normal"_a = none, "jacobian"_a = none,
                  "torque_limit"_a = none, "torque_bias"_a = none, "rule"_a = none,
                  "model"_a.none() = none)
      .def("clone", &A::clone)
      .def("solve", &A::solve, "wrench"_a, "start"_a = 0, "force"_a = none, "torsion"_a = none,
           "previous"_a = none, "optimum"_a = std::numeric_limits<double>::quiet_NaN(),
           "traced"_a = 0, "positions"_a = none, "normals"_a = none)
      .def("start", &A::start, "wrench"_a, "start"_a = 0, "force"_a = none, "previous"_a = none)
      .def("solve_many", &A::solve_many, "wrenches"_a)
      .def("make_basis", &A::make_basis)
      .def("allocations", &A::allocations_in, "wrenches"_a, "positions"_a = none,
           "normals"_a = none, "calls"_a);
}
