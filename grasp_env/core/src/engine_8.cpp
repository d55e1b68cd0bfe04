// The solver of up to eight contacts.
#include "instances.hpp"

namespace grasp::detail {
template std::unique_ptr<Engine> make_lane_engine<Lanes<REGISTER>, 8 / REGISTER>(const Problem&,
                                                                                 const Options&);
}  // namespace grasp::detail
