// Phi, for each contact.
#include <grasp/contacts/contacts.hpp>
#include <grasp/phi/phi.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

// Call f(contact, its force x, its weights) for x (N, 3) and weights (N, 2).
template <class F> void for_each(nb::handle x, nb::handle weights, F&& f) {
  const Numbers rows = in(x, -1, 3);
  const Numbers values = in(weights, rows.length(0), 2);
  for (Py_ssize_t i = 0; i < rows.length(0); ++i)
    f(i, point(rows.data() + 3 * i),
      Weights<double>{values.data()[2 * i], values.data()[2 * i + 1]});
}

double value(nb::handle x, nb::handle weights) {
  double total = 0.0;
  for_each(x, weights, [&](Py_ssize_t, const Point& at, const Weights<double>& w) {
    const bool inside = at.u > 0.0 && lorentz(at, at) > 0.0;
    total += inside ? phi(at, w) : infinity;
  });
  return total < infinity ? total : infinity;
}

void gradients(nb::handle x, nb::handle weights, nb::handle to) {
  double* out_ = out(to, in(x, -1, 3).length(0), 3).data();
  for_each(x, weights, [&](Py_ssize_t i, const Point& at, const Weights<double>& w) {
    const Point slope = gradient(at, w);
    for (int a = 0; a < 3; ++a) out_[3 * i + a] = slope[a];
  });
}

// Entry (a, b) from the second derivatives along both axes and along their sum.
void hessians(nb::handle x, nb::handle weights, nb::handle to) {
  double* out_ = out(to, in(x, -1, 3).length(0), 3, 3).data();
  for_each(x, weights, [&](Py_ssize_t i, const Point& at, const Weights<double>& w) {
    const auto along = [&](int a, int b) {
      Point move{};
      move[a] = move[b] = 1.0;
      return curvature(at, move, w);
    };
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b)
        out_[9 * i + 3 * a + b] =
            a == b ? along(a, a) : 0.5 * (along(a, b) - along(a, a) - along(b, b));
  });
}

double lower_bound(nb::handle y, nb::handle weights) {
  double total = 0.0;
  for_each(y, weights, [&](Py_ssize_t, const Point& pull, const Weights<double>& w) {
    double room = 0.0;
    const double least = dual(pull, w, room);
    total += room > 0.0 && least == least ? least : -infinity;
  });
  return total;
}

}  // namespace

void bind_phi(nb::module_& m) {
  m.def("phi", &value, "x"_a, "weights"_a,
        "Return Phi of forces (N, 3) in cone coordinates with weights (N, 2) omega, lambda; inf: "
        "not strictly inside.");
  m.def("phi_gradient", &gradients, "x"_a, "weights"_a, "out"_a,
        "Write the gradient of Phi into (N, 3).");
  m.def("phi_hessian", &hessians, "x"_a, "weights"_a, "out"_a,
        "Write the 3 x 3 blocks of the Hessian of Phi into (N, 3, 3).");
  m.def("phi_lower_bound", &lower_bound, "y"_a, "weights"_a,
        "Return the sum over contacts of the minimum of phi(x) - y . x, y (N, 3); -inf: none.");
}
