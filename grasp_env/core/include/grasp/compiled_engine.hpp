// Compile the solvers of `ForceOptimizer` in the one file that includes this. All files of the program define GRASP_COMPILED_ENGINE.
#pragma once
#ifdef GRASP_COMPILED_ENGINE
#include <grasp/math/dispatch.hpp>
#include <grasp/engine.hpp>

namespace grasp::detail {

std::unique_ptr<Engine> make_engine(const Problem& problem, const Options& options) {
    return instance<Engine, LaneEngine>(problem.contacts.count, problem, options);
}

}  // namespace grasp::detail
#endif
