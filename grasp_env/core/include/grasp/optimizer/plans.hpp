// The algorithm for each method and kind of problem.
#pragma once
#include <grasp/problem.hpp>

namespace grasp::detail {

// Classes of problems that differ in their algorithm.
enum class ProblemKind {
  hard,     // hard, elliptic and frictionless contacts
  limited,  // the same, with limits on one contact each: normal forces, joints of one finger
  soft,     // some contacts are soft, and the normal and tangential forces alone give force closure
  // everything else: joints that several fingers share, soft contacts within limits, contacts that
  // need torsion to balance wrenches of every direction, or cannot
  other,
};
enum class Algorithm { newton, limited, soft, flow, conic, general };

// If Newton, its variants or the algorithm `conic` give up, the general program takes over. Soft
// and limited problems of the method `conic` begin with it. If it gives up, it proves that there is
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
    {Method::newton, ProblemKind::other, Algorithm::general},
    {Method::reduced_flow, ProblemKind::hard, Algorithm::flow},
    {Method::full_flow, ProblemKind::hard, Algorithm::flow},
    {Method::conic, ProblemKind::hard, Algorithm::conic},
    {Method::conic, ProblemKind::limited, Algorithm::general},
    {Method::conic, ProblemKind::soft, Algorithm::general},
    {Method::conic, ProblemKind::other, Algorithm::general},
};
inline std::optional<Algorithm> algorithm_for(const Options& options, ProblemKind kind) {
  for (const Plan& plan : PLANS)
    if (plan.method == options.method && plan.kind == kind)
      return plan.algorithm == Algorithm::conic && options.criterion != Criterion::sum
                 ? Algorithm::general
                 : plan.algorithm;
  return {};
}

}  // namespace grasp::detail
