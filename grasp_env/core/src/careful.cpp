// The parts of the general program with twice the digits, which it takes where doubles do not
// suffice.
#include "instances.hpp"

namespace grasp {
GRASP_CAREFUL(, 3)
GRASP_CAREFUL(, 4)
}  // namespace grasp
