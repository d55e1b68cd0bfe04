// The solver of any number of contacts.
#include "instances.hpp"

template std::unique_ptr<grasp::detail::Engine> grasp::detail::make_lane_engine<grasp::Lanes<grasp::REGISTER>, 0>(
    const grasp::Problem&, const grasp::Options&);
