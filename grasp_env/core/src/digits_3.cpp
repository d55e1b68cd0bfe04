// The parts of the general program with twice the digits, for contacts without torsion.
#include "instances.hpp"

namespace grasp {
GRASP_DIGITS(, 3)
}  // namespace grasp
