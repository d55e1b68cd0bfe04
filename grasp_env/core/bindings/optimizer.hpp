// The optimizer behind a bound `ForceOptimizer`, for other files of this folder.
#pragma once

#include <grasp/optimizer.hpp>

#include "module.hpp"

const grasp::ForceOptimizer& optimizer_of(nb::handle solver);
