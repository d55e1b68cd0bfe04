// The general program of contacts without torsion.
#include "instances.hpp"

template struct grasp::detail::Constraints<3>;
template class grasp::detail::ProgramOn<3>;
