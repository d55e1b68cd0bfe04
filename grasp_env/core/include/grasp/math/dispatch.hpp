// Instances of a solver by number of contacts: N <= 4, N <= 8, and any N, in the registers of this
// build.
#pragma once
#include <grasp/math/lanes.hpp>

namespace grasp {

// doubles in a register of up to four contacts
inline constexpr int FOUR = REGISTER < 4 ? REGISTER : 4;

// Call f.template operator()<V, B>().
template <class F> auto dispatch(int count, F&& f) {
  if (count <= 4) return f.template operator()<Lanes<FOUR>, 4 / FOUR>();
  if (count <= 8) return f.template operator()<Lanes<REGISTER>, 8 / REGISTER>();
  return f.template operator()<Lanes<REGISTER>, 0>();
}

}  // namespace grasp
