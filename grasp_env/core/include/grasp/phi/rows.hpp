// Further terms of Phi: the rows that a `NewtonSolver` takes besides the cones. `Barriers`
// (limits/barriers.hpp) adds limits.
#pragma once

namespace grasp {

// No further terms.
struct NoRows {
  static constexpr bool has_terms = false;
};

}  // namespace grasp
