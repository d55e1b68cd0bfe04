// The solver of up to eight contacts.
#include "instances.hpp"

template std::unique_ptr<grasp::detail::Engine> grasp::detail::make_lane_engine<grasp::Lanes<grasp::REGISTER>,
                                                                                8 / grasp::REGISTER>(const grasp::Problem&,
                                                                                                     const grasp::Options&);
