// Further terms of Phi: the rows that a `NewtonSolver` takes besides the cones. `LimitTerms`
// (limits/terms.hpp) adds limits.
#pragma once

namespace grasp {

// No further terms.
struct NoRows {
  static constexpr bool has_terms = false;
};

// Decision of the terms after a Newton step was computed: continue; the edge was lowered; no force
// keeps the limits; neither is known.
enum class Verdict { proceed, sharpened, infeasible, inconclusive };

}  // namespace grasp
