// A step rule from the numbers of `StepRule.parameters`.
#pragma once

#include <grasp/flow/flow.hpp>

#include "buffers.hpp"

inline grasp::StepRule rule_of(nb::handle numbers) {
    const Numbers rule = in(numbers, 5);
    const double* p = rule.data();
    if (!(p[0] >= 0.0 && p[0] <= double(grasp::StepRule::EXACT))) throw nb::value_error("no such kind of step rule");
    return {int(p[0]), p[1], p[2], p[3], p[4]};
}
