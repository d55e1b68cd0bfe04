// The solver of up to four contacts, and the choice among all of them.
#include "instances.hpp"

namespace grasp::detail {
template std::unique_ptr<Engine> make_lane_engine<Lanes<FOUR>, 4 / FOUR>(const Problem&,
                                                                         const Options&);
template std::unique_ptr<Engine> make_engine<REGISTER>(const Problem&, const Options&);
}  // namespace grasp::detail
