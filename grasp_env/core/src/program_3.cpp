// The general program of contacts without torsion.
#include "instances.hpp"

template class grasp::detail::ProgramOn<3>;
