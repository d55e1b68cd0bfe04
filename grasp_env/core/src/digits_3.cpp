// The parts of the general program with twice the digits, for contacts without torsion.
#include "instances.hpp"

namespace grasp {

template class RowSystem<DoubleDouble, 3, 0>;
template class InteriorPoint<DoubleDouble, 3, 0>;
template class RowSystem<DoubleDouble, 3, 1>;
template class InteriorPoint<DoubleDouble, 3, 1>;
template class RowSystem<DoubleDouble, 3, 2>;
template class InteriorPoint<DoubleDouble, 3, 2>;
template class PhiRows<DoubleDouble, 3>;

}  // namespace grasp
