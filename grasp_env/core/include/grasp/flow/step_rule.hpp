// The step rules of the paper's gradient flow.
#pragma once

namespace grasp {

// The rule for alpha_k, as data; see `step_size.py`.
struct StepRule {
  enum Kind { FIXED, ARMIJO, ADAPTIVE, BARZILAI_BORWEIN, EXACT };
  // Variants of BARZILAI_BORWEIN, given in `grow`; any other value: the short steps.
  static constexpr double ALTERNATE = 0.0, LONG_ONLY = 1.0;
  int kind = ADAPTIVE;
  double first = 0.3;   // first trial step [N / omega]
  double grow = 1.5;    // factor after an accepted step
  double shrink = 0.5;  // factor after a rejected one
  // Fraction of alpha |d|^2 by which Phi has to decrease; for EXACT the fraction of the slope that
  // may remain.
  double decrease = 0.0;
};

}  // namespace grasp
