// The deepest forces and proofs of the general program.
#include "instances.hpp"

template class grasp::detail::Depth<3>;
template class grasp::detail::Depth<4>;
template class grasp::detail::LargestLoad<3>;
template class grasp::detail::LargestLoad<4>;
