// The solvers of `ForceOptimizer`, compiled in each file that includes this; with GRASP_COMPILED_ENGINE in one file for the whole program.
#pragma once
#include <grasp/math/dispatch.hpp>
#include <grasp/engine.hpp>

namespace grasp::detail {

#ifdef GRASP_COMPILED_ENGINE
#define GRASP_LINKAGE
#else
#define GRASP_LINKAGE inline
#endif

GRASP_LINKAGE std::unique_ptr<Engine> make_engine(const Problem& problem, const Options& options) {
    return instance<Engine, LaneEngine>(problem.contacts.count, problem, options);
}

#undef GRASP_LINKAGE

}  // namespace grasp::detail
