// Instances of the solvers, each compiled by one file of this folder: together they are
// grasp::compiled.
#pragma once
#include <grasp/optimizer/lane_engine.hpp>

// The parts of the general program with twice the digits, for contacts of D variables. how: extern,
// or nothing in the file that compiles them. T: how many variables the contacts share.
#define GRASP_CAREFUL(how, D)                                                                     \
  GRASP_CAREFUL_ENGINE(how, D, 0)                                                                 \
  GRASP_CAREFUL_ENGINE(how, D, 1)                                                                 \
  GRASP_CAREFUL_ENGINE(how, D, 2)                                                                 \
  GRASP_CAREFUL_PROGRAM(how, D, 0)                                                                \
  GRASP_CAREFUL_PROGRAM(how, D, 1)                                                                \
  how template class PhiRows<DoubleDouble, D>;                                                    \
  how template Code detail::ProgramOn<D>::write_phi(PhiRows<DoubleDouble, D>&, Code, const Call&, \
                                                    const Record&, double*);                      \
  how template void detail::ProgramOn<D>::place_norm(InteriorPoint<DoubleDouble, D, 0>&);         \
  how template Deepest detail::Depth<D>::find<DoubleDouble>(const double*, double,                \
                                                            detail::Depth<D>::Field&);            \
  how template bool detail::LargestLoad<D>::solve<DoubleDouble>(int&);
#define GRASP_CAREFUL_ENGINE(how, D, T)                                                \
  how template class RowSystem<DoubleDouble, D, T>;                                    \
  how template class InteriorPoint<DoubleDouble, D, T>;                                \
  how template auto InteriorPoint<DoubleDouble, D, T>::measure(int)                    \
      -> InteriorPoint<DoubleDouble, D, T>::Measured;                                  \
  how template Rows<DoubleDouble, D, T> detail::Constraints<D>::rows<DoubleDouble, T>( \
      int, Criterion) const;
#define GRASP_CAREFUL_PROGRAM(how, D, T)                                                     \
  how template bool detail::ProgramOn<D>::begin(InteriorPoint<DoubleDouble, D, T>&);         \
  how template bool detail::ProgramOn<D>::place(InteriorPoint<DoubleDouble, D, T>&, double); \
  how template double detail::ProgramOn<D>::consider(const InteriorPoint<DoubleDouble, D, T>&);

namespace grasp {

GRASP_CAREFUL(extern, 3)
GRASP_CAREFUL(extern, 4)

namespace detail {

extern template std::unique_ptr<Engine> make_lane_engine<Lanes<FOUR>, 4 / FOUR>(const Problem&,
                                                                                const Options&);
extern template std::unique_ptr<Engine> make_lane_engine<Lanes<REGISTER>, 8 / REGISTER>(
    const Problem&, const Options&);
extern template std::unique_ptr<Engine> make_lane_engine<Lanes<REGISTER>, 0>(const Problem&,
                                                                             const Options&);
extern template struct Constraints<3>;
extern template struct Constraints<4>;
extern template class Depth<3>;
extern template class Depth<4>;
extern template class LargestLoad<3>;
extern template class LargestLoad<4>;
extern template class ProgramOn<3>;
extern template class ProgramOn<4>;

}  // namespace detail
}  // namespace grasp
