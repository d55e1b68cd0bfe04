// The parts of the general program with twice the digits, for contacts with torsion.
#include "instances.hpp"

namespace grasp {

template class RowSystem<DoubleDouble, 4, 0>;
template class InteriorPoint<DoubleDouble, 4, 0>;
template class RowSystem<DoubleDouble, 4, 1>;
template class InteriorPoint<DoubleDouble, 4, 1>;
template class RowSystem<DoubleDouble, 4, 2>;
template class InteriorPoint<DoubleDouble, 4, 2>;
template class PhiRows<DoubleDouble, 4>;

}  // namespace grasp
