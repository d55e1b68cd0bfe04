// The deepest forces and proofs of the general program, for contacts with torsion.
#include "instances.hpp"

template class grasp::detail::Depth<4>;
