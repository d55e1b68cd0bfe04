// The deepest forces and proofs of the general program, for contacts without torsion.
#include "instances.hpp"

template class grasp::detail::Depth<3>;
