// What the exact problem minimises.
#pragma once

namespace grasp {

// The sum or the largest of omega times normal force, or the norm of the joint torques. The general
// program has two more: `excess`, the largest relative excess of a limit, t with rows . z <= bound
// + t share; and `load`, the largest load along a ray.
enum class Criterion { sum, largest, torque, excess, load };

// A bound that pays for what its multipliers lack holds for normal forces up to this factor of the
// largest at hand.
inline constexpr double FARTHEST_FORCE = 1e4;

}  // namespace grasp
