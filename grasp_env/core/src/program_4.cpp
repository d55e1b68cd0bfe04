// The general program of soft contacts.
#include "instances.hpp"

template class grasp::detail::ProgramOn<4>;
