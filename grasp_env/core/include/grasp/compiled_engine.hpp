// Compile the solvers of `ForceOptimizer` in this file of a program, whose files all define GRASP_COMPILED_ENGINE.
#pragma once
#include <grasp/math/dispatch.hpp>
#include <grasp/engine.hpp>

namespace grasp::detail {

std::unique_ptr<Engine> make_engine(const Problem& problem, const Options& options) {
    return instance<Engine, LaneEngine>(problem.contacts.count, problem, options);
}

}  // namespace grasp::detail
