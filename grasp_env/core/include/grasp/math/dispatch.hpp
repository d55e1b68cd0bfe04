// Instances of a solver by number of contacts: N <= 4, N <= 8, and any N, in the registers of this build.
#pragma once
#include <memory>
#include <grasp/math/lanes.hpp>

namespace grasp {

// Call f.template operator()<V, B>().
template <class F> auto dispatch(int count, F&& f) {
    constexpr int L = REGISTER, FOUR = L < 4 ? L : 4;
    if (count <= 4) return f.template operator()<Lanes<FOUR>, 4 / FOUR>();
    if (count <= 8) return f.template operator()<Lanes<L>, 8 / L>();
    return f.template operator()<Lanes<L>, 0>();
}

// Make On<V, B>(arguments), which derives from `Base`.
template <class Base, template <class, int> class On, class... Arguments>
std::unique_ptr<Base> instance(int count, Arguments&&... arguments) {
    return dispatch(count, [&]<class V, int B>() -> std::unique_ptr<Base> {
        return std::make_unique<On<V, B>>(std::forward<Arguments>(arguments)...);
    });
}

}  // namespace grasp
