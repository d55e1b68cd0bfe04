// The parts of the general program with twice the digits, for contacts with torsion.
#include "instances.hpp"

namespace grasp {
GRASP_DIGITS(, 4)
}  // namespace grasp
