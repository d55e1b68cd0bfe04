// Phi, for each contact.
#include <grasp/contacts/contacts.hpp>
#include <grasp/phi/phi.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

// Call f(contact, its vector, its weights) for x (N, 3) or (N, 4) and weights (N, 3).
template <class F> void for_each(nb::handle x, nb::handle weights, F&& f) {
  const Numbers rows = in(x, -1, -1);
  const Py_ssize_t count = rows.length(0);
  const Py_ssize_t width = rows.length(1);
  const Numbers values = in(weights, count, 3);
  for (Py_ssize_t i = 0; i < count; ++i) {
    const double* from = rows.data() + width * i;
    const double* w = values.data() + 3 * i;
    const Weights<double, 4> of{w[0], w[1], w[2]};
    if (width == 3)  // without torsion
      f(i, Vec<double, 4>{from[0], from[1], from[2], 0.0}, of);
    else if (width == 4)
      f(i, Vec<double, 4>{from[0], from[1], from[2], from[3]}, of);
    else
      throw nb::value_error("contacts must have 3 or 4 cone coordinates");
  }
}

double value(nb::handle x, nb::handle weights) {
  double total = 0.0;
  for_each(x, weights, [&](Py_ssize_t, const Vec<double, 4>& at, const Weights<double, 4>& w) {
    const bool inside = at.u > 0.0 && lorentz(at, at) > 0.0;
    total += inside ? phi(at, w) : infinity;
  });
  return total < infinity ? total : infinity;
}

void gradients(nb::handle x, nb::handle weights, nb::handle to) {
  const Numbers shape = in(x, -1, -1);
  const Py_ssize_t width = shape.length(1);
  double* out_ = out(to, shape.length(0), width).data();
  for_each(x, weights, [&](Py_ssize_t i, const Vec<double, 4>& at, const Weights<double, 4>& w) {
    const auto slope = gradient(at, w);
    for (int a = 0; a < width; ++a) out_[width * i + a] = slope[a];
  });
}

// Entry (a, b) from the second derivatives along both axes and along their sum.
void hessians(nb::handle x, nb::handle weights, nb::handle to) {
  const Numbers shape = in(x, -1, -1);
  const Py_ssize_t width = shape.length(1);
  double* out_ = out(to, shape.length(0), width, width).data();
  for_each(x, weights, [&](Py_ssize_t i, const Vec<double, 4>& at, const Weights<double, 4>& w) {
    const auto along = [&](int a, int b) {
      Vec<double, 4> move{};
      move[a] = move[b] = 1.0;
      return curvature(at, move, w);
    };
    for (int a = 0; a < width; ++a)
      for (int b = 0; b < width; ++b)
        out_[width * (width * i + a) + b] =
            a == b ? along(a, a) : 0.5 * (along(a, b) - along(a, a) - along(b, b));
  });
}

double lower_bound(nb::handle y, nb::handle weights) {
  double total = 0.0;
  for_each(y, weights, [&](Py_ssize_t, const Vec<double, 4>& pull, const Weights<double, 4>& w) {
    double room = 0.0;
    const double least = dual(pull, w, room);
    total += room > 0.0 && least == least ? least : -infinity;
  });
  return total;
}

}  // namespace

void bind_phi(nb::module_& m) {
  m.def("phi", &value, "x"_a, "weights"_a,
        "Return Phi of forces (N, 3) or (N, 4) in cone coordinates with weights (N, 3) omega, "
        "lambda and k - 1, k tangential parts; inf: not strictly inside.");
  m.def("phi_gradient", &gradients, "x"_a, "weights"_a, "out"_a,
        "Write the gradient of Phi, shaped as x.");
  m.def("phi_hessian", &hessians, "x"_a, "weights"_a, "out"_a,
        "Write the blocks of the Hessian of Phi into (N, 3, 3) or (N, 4, 4).");
  m.def("phi_lower_bound", &lower_bound, "y"_a, "weights"_a,
        "Return the sum over contacts of the minimum of phi(x) - y . x, y (N, 3) or (N, 4); -inf: "
        "none.");
}
