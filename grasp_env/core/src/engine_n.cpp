// The solver of any number of contacts.
#include "instances.hpp"

namespace grasp::detail {
template std::unique_ptr<Engine> make_lane_engine<Lanes<REGISTER>, 0>(const Problem&,
                                                                      const Options&);
}  // namespace grasp::detail
