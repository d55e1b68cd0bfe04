// The algorithm for each method and kind of problem.
#pragma once
#include <grasp/problem.hpp>

namespace grasp::detail {

// Classes of problems that differ in their algorithm.
enum class ProblemKind {
  hard,          // hard, elliptic and frictionless contacts
  limited,       // the same, with limits
  soft,          // some contacts are soft, and normal and tangential forces alone are of full rank
  soft_limited,  // the same, with limits
  other,         // contacts that need torsion to balance wrenches of every direction, or cannot
};
enum class Algorithm { newton, limited, soft, flow, conic, limited_conic, general };

// If Newton, its variants or the conic algorithms give up, the general program takes over. If it
// gives up, it proves that there is
// no force or leaves the call UNDECIDED (`general/deepest.hpp`). A flow has no fallback.
struct Plan {
  Method method;
  ProblemKind kind;
  Algorithm algorithm;
};
inline constexpr Plan PLANS[] = {
    {Method::newton, ProblemKind::hard, Algorithm::newton},
    {Method::newton, ProblemKind::limited, Algorithm::limited},
    {Method::newton, ProblemKind::soft, Algorithm::soft},
    {Method::newton, ProblemKind::soft_limited, Algorithm::limited},
    {Method::newton, ProblemKind::other, Algorithm::general},
    {Method::reduced_flow, ProblemKind::hard, Algorithm::flow},
    {Method::full_flow, ProblemKind::hard, Algorithm::flow},
    {Method::conic, ProblemKind::hard, Algorithm::conic},
    {Method::conic, ProblemKind::limited, Algorithm::limited_conic},
    {Method::conic, ProblemKind::soft, Algorithm::limited_conic},
    {Method::conic, ProblemKind::soft_limited, Algorithm::limited_conic},
    {Method::conic, ProblemKind::other, Algorithm::general},
};
inline std::optional<Algorithm> algorithm_for(const Options& options, ProblemKind kind) {
  for (const Plan& plan : PLANS)
    if (plan.method == options.method && plan.kind == kind)
      return plan.algorithm == Algorithm::conic && options.criterion != Criterion::sum
                 ? Algorithm::limited_conic
                 : plan.algorithm;
  return {};
}

}  // namespace grasp::detail
