// The instance of a solver for a number of contacts: N <= 4, N <= 8, and any N, in the registers of this build.
#pragma once
#include <memory>
#include "lanes.hpp"

namespace grasp {

// What every instance derives from is `Base`, made as Base::template On<V, B>(arguments).
template <class Base, template <class, int> class On, class... Arguments>
std::unique_ptr<Base> instance(int count, Arguments&&... arguments) {
    constexpr int L = REGISTER, FOUR = L < 4 ? L : 4;
    if (count <= 4) return std::make_unique<On<Lanes<FOUR>, 4 / FOUR>>(std::forward<Arguments>(arguments)...);
    if (count <= 8) return std::make_unique<On<Lanes<L>, 8 / L>>(std::forward<Arguments>(arguments)...);
    return std::make_unique<On<Lanes<L>, 0>>(std::forward<Arguments>(arguments)...);
}

}  // namespace grasp
