// What the exact problem minimises.
#pragma once

namespace grasp {

// The sum or the largest of omega times normal force. `excess`, of the general program only: the
// largest relative excess of a limit, t with rows . z <= bound + t share.
enum class Criterion { sum, largest, excess };

}  // namespace grasp
