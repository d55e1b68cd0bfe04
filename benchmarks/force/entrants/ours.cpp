// This project's solver as C functions of force.h: `conic` enters `sum`; `newton`, `flow` and
// `learned` enter `phi`.
#include <cstring>
#include <grasp/optimizer.hpp>

#include "../force.h"

namespace {

constexpr double TOLERANCE = 1e-6;
constexpr grasp::StepRule SHORT{.kind = grasp::StepRule::BARZILAI_BORWEIN,
                                .grow = 2.0};  // the flow's best rule

struct Session {
  grasp::ForceOptimizer optimizer;
  bool remembers = false;
};

std::span<const double> numbers(const double* at, int count) {
  return at ? std::span(at, std::size_t(count)) : std::span<const double>();
}

grasp::Margin margin(const force_problem* p) {
  return {.friction = p->friction_margin ? *p->friction_margin : 1.0,
          .preload = numbers(p->preload, p->contacts)};
}

void* make(const force_problem* p, grasp::Options options, bool remembers = false) try {
  const int n = p->contacts;
  options.tolerance = TOLERANCE;
  grasp::Problem problem{.contacts = grasp::Contacts::from(
                             numbers(p->positions, 3 * n), numbers(p->normals, 3 * n),
                             numbers(p->friction, n), {}, {}, numbers(p->torsional_friction, n))};
  problem.limits = {.min_normal = numbers(p->min_normal, n),
                    .max_normal = numbers(p->max_normal, n),
                    .jacobian = numbers(p->jacobian, 6 * n * p->joints),
                    .torque_limit = numbers(p->torque_limit, p->joints),
                    .torque_bias = numbers(p->torque_bias, p->joints)};
  problem.margin = margin(p);
  return new Session{grasp::ForceOptimizer(problem, options), remembers};
} catch (const std::invalid_argument&) {
  return nullptr;
}

int solve(void* context, const force_problem* p, const double* start, double* force,
          double* multipliers, int* iterations) {
  auto& [optimizer, remembers] = *static_cast<Session*>(context);
  const int n = p->contacts;
  grasp::Request request{.wrench = p->wrench};
  if (p->moved) {
    request.now = {.positions = numbers(p->positions, 3 * n),
                   .normals = numbers(p->normals, 3 * n),
                   .friction = numbers(p->friction, n),
                   .jacobian = numbers(p->jacobian, 6 * n * p->joints),
                   .torque_bias = numbers(p->torque_bias, p->joints),
                   .contacts = n < 64 ? p->touching : ~0ULL};
    if (p->friction_margin || p->preload) request.now.margin = margin(p);
  }
  if (!start)
    optimizer.forget();
  else if (remembers)
    request.start = grasp::Start::previous;
  const grasp::Record& solution = optimizer.solve(request);
  if (iterations) *iterations = int(solution.summary().iterations);
  for (int r = 0; r < 6; ++r) multipliers[r] = solution.summary().multipliers[r];
  if (solution.code() == grasp::INFEASIBLE || solution.has_force())
    std::copy_n(solution.limit_multipliers(), int(solution.summary().limits), multipliers + 6);
  if (!solution.has_force()) return solution.code() == grasp::INFEASIBLE ? 2 : 1;
  if (p->width == 3) {
    std::copy_n(solution.force(), 3 * n, force);
  } else {
    for (int i = 0; i < n; ++i) {
      std::copy_n(solution.force() + 3 * i, 3, force + 4 * i);
      force[4 * i + 3] = solution.torsion()[i];
    }
  }
  return solution.code() == grasp::CONVERGED ? 0 : 1;
}

bool is(const char* objective, const char* which) { return !std::strcmp(objective, which); }
bool plain(const force_problem* p) { return !p->torsional_friction && !p->limits; }

}  // namespace

extern "C" {

void* conic_setup(const force_problem* p, const char* objective) {
  return is(objective, "sum") ? make(p, {.method = grasp::Method::conic}) : nullptr;
}
void* newton_setup(const force_problem* p, const char* objective) {
  return is(objective, "phi") && plain(p) ? make(p, {.method = grasp::Method::newton}, true)
                                          : nullptr;
}
void* flow_setup(const force_problem* p, const char* objective) {
  if (!is(objective, "phi") || !plain(p)) return nullptr;
  return make(p, {.method = grasp::Method::reduced_flow, .step_rule = SHORT}, true);
}
int conic(void* context, const force_problem* p, const double* start, double* force,
          double* multipliers, int* iterations) {
  return solve(context, p, start, force, multipliers, iterations);
}
int newton(void* context, const force_problem* p, const double* start, double* force,
           double* multipliers, int* iterations) {
  return solve(context, p, start, force, multipliers, iterations);
}
int flow(void* context, const force_problem* p, const double* start, double* force,
         double* multipliers, int* iterations) {
  return solve(context, p, start, force, multipliers, iterations);
}
void conic_close(void* context) { delete static_cast<Session*>(context); }
void newton_close(void* context) { conic_close(context); }
void flow_close(void* context) { conic_close(context); }

}  // extern "C"
