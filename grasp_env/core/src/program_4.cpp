// The general program of soft contacts.
#include "instances.hpp"

template struct grasp::detail::Constraints<4>;
template class grasp::detail::ProgramOn<4>;
