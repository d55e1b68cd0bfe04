// Instances of the solvers, each compiled by one file of this folder: together they are grasp::compiled.
#pragma once
#include <grasp/lane_engine.hpp>

namespace grasp {

inline constexpr int FOUR = REGISTER < 4 ? REGISTER : 4;  // doubles in a register of up to four contacts

namespace detail {

extern template std::unique_ptr<Engine> make_lane_engine<Lanes<FOUR>, 4 / FOUR>(const Problem&, const Options&);
extern template std::unique_ptr<Engine> make_lane_engine<Lanes<REGISTER>, 8 / REGISTER>(const Problem&, const Options&);
extern template std::unique_ptr<Engine> make_lane_engine<Lanes<REGISTER>, 0>(const Problem&, const Options&);
extern template class Depth<3>;
extern template class Depth<4>;
extern template class ProgramOn<3>;
extern template class ProgramOn<4>;

}  // namespace detail

extern template class RowSystem<DoubleDouble, 3, 0>;
extern template class InteriorPoint<DoubleDouble, 3, 0>;
extern template class RowSystem<DoubleDouble, 3, 1>;
extern template class InteriorPoint<DoubleDouble, 3, 1>;
extern template class RowSystem<DoubleDouble, 3, 2>;
extern template class InteriorPoint<DoubleDouble, 3, 2>;
extern template class PhiRows<DoubleDouble, 3>;
extern template class RowSystem<DoubleDouble, 4, 0>;
extern template class InteriorPoint<DoubleDouble, 4, 0>;
extern template class RowSystem<DoubleDouble, 4, 1>;
extern template class InteriorPoint<DoubleDouble, 4, 1>;
extern template class RowSystem<DoubleDouble, 4, 2>;
extern template class InteriorPoint<DoubleDouble, 4, 2>;
extern template class PhiRows<DoubleDouble, 4>;

}  // namespace grasp
