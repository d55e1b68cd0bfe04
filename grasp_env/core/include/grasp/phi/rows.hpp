// Further terms of Phi: the rows that a `NewtonSolver` takes besides the cones. `LimitTerms`
// (limits/terms.hpp) adds limits, `SoftTerms` (soft/terms.hpp) adds torsion, which acts on the
// object by variables of its own.
#pragma once

namespace grasp {

// No further terms.
struct NoRows {
  static constexpr bool has_terms = false, has_torsion = false;
};

// Decision of the terms after a Newton step was computed: continue; the edge was lowered; no force
// keeps the limits; neither is known.
enum class Verdict { proceed, sharpened, infeasible, inconclusive };

}  // namespace grasp
