// Instances of the solvers, each compiled by one file of this folder: together they are grasp::compiled.
#pragma once
#include <grasp/lane_engine.hpp>

// The parts of the general program with twice the digits, for contacts of D variables. how: extern, or nothing in the file that
// compiles them.
#define GRASP_DIGITS(how, D)                              \
    how template class RowSystem<DoubleDouble, D, 0>;     \
    how template class RowSystem<DoubleDouble, D, 1>;     \
    how template class RowSystem<DoubleDouble, D, 2>;     \
    how template class InteriorPoint<DoubleDouble, D, 0>; \
    how template class InteriorPoint<DoubleDouble, D, 1>; \
    how template class InteriorPoint<DoubleDouble, D, 2>; \
    how template class PhiRows<DoubleDouble, D>;

namespace grasp {

GRASP_DIGITS(extern, 3)
GRASP_DIGITS(extern, 4)

namespace detail {

extern template std::unique_ptr<Engine> make_lane_engine<Lanes<FOUR>, 4 / FOUR>(const Problem&, const Options&);
extern template std::unique_ptr<Engine> make_lane_engine<Lanes<REGISTER>, 8 / REGISTER>(const Problem&, const Options&);
extern template std::unique_ptr<Engine> make_lane_engine<Lanes<REGISTER>, 0>(const Problem&, const Options&);
extern template class Depth<3>;
extern template class Depth<4>;
extern template class ProgramOn<3>;
extern template class ProgramOn<4>;

}  // namespace detail
}  // namespace grasp
