// The formulas of one contact, over rows of contacts that fill registers of so many lanes.
#include "arrays.hpp"

using namespace grasp;

namespace {

// A column of rows of so many numbers in the lanes, from a row on; the last row is repeated to fill
// a register.
template <class V> V column(const In& a, size_t first, size_t which) {
  const size_t rows = a.shape(0);
  const size_t columns = a.size() / rows;
  V out{};
  for (int n = 0; n < width<V>; ++n)
    set(out, n, a.data()[std::min(first + n, rows - 1) * columns + which]);
  return out;
}
template <class V, int D> Vec<V, D> vector(const In& a, size_t k) {
  Vec<V, D> out;
  for (int c = 0; c < D; ++c) out[c] = column<V>(a, k, c);
  return out;
}
// Weights (n, 3) omega, lambda, k - 1.
template <class V, int D> Weights<V, D> weights_in(const In& a, size_t k) {
  return fitted<D>(Weights<V, 4>{column<V>(a, k, 0), column<V>(a, k, 1), column<V>(a, k, 2)});
}

// (rows of x, COLUMNS) numbers: f(V{}, first row of a register, out) fills the columns of a
// register.
template <size_t COLUMNS, class F> nb::object over(int lanes, const In& x, F&& f) {
  return with_lanes(lanes, [&](auto zero) {
    using V = decltype(zero);
    const size_t rows = x.shape(0);
    std::vector<double> out(rows * COLUMNS);
    for (size_t first = 0; first < rows; first += width<V>) {
      std::array<V, COLUMNS> results;
      f(zero, first, results);
      for (size_t n = 0; n < size_t(width<V>) && first + n < rows; ++n)
        for (size_t c = 0; c < COLUMNS; ++c)
          out[(first + n) * COLUMNS + c] = get(results[c], int(n));
    }
    return array(out, {rows, COLUMNS});
  });
}

// The functions below are of vectors of D numbers.
template <int D> nb::object phi_of(int lanes, const In& x, const In& weights) {
  return over<1>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    out[0] = phi(vector<V, D>(x, k), weights_in<V, D>(weights, k));
  });
}
template <int D> nb::object gradient_of(int lanes, const In& x, const In& weights) {
  return over<D>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    const Vec<V, D> g = gradient(vector<V, D>(x, k), weights_in<V, D>(weights, k));
    for (int c = 0; c < D; ++c) out[c] = g[c];
  });
}
// (n, 2): Phi as it comes with its gradient, its curvature along a move
template <int D> nb::object along_of(int lanes, const In& x, const In& move, const In& weights) {
  return over<2>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    const Vec<V, D> at = vector<V, D>(x, k);
    Vec<V, D> unused;
    out = {phi(at, weights_in<V, D>(weights, k), unused),
           curvature(at, vector<V, D>(move, k), weights_in<V, D>(weights, k))};
  });
}
// (n, D * D): row c is the block times axis c
template <int D> nb::object inverse_hessian_of(int lanes, const In& x, const In& weights) {
  return over<D * D>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    const Sym<V, D> h = inverse_hessian(vector<V, D>(x, k), weights_in<V, D>(weights, k));
    for (int c = 0; c < D; ++c) {
      Vec<V, D> unit{};
      unit[c] = all<V>(1.0);
      const Vec<V, D> row = h * unit;
      for (int r = 0; r < D; ++r) out[D * c + r] = row[r];
    }
  });
}
// (n, D * D + 4): the axes, then the gradient of squeezing along the first two, and of the barrier
template <int D> nb::object axes_of(int lanes, const In& x, const In& weights) {
  return over<D * D + 4>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    const Axes<V, D> axes(vector<V, D>(x, k), weights_in<V, D>(weights, k));
    for (int c = 0; c < D; ++c)
      for (int r = 0; r < D; ++r) out[D * c + r] = axes[c][r];
    out[D * D] = axes.squeeze.along;
    out[D * D + 1] = axes.squeeze.inward;
    out[D * D + 2] = axes.barrier.along;
    out[D * D + 3] = axes.barrier.inward;
  });
}
// (n, 2): value and room
template <int D> nb::object dual_of(int lanes, const In& y, const In& weights) {
  return over<2>(lanes, y, [&]<class V>(V, size_t k, auto& out) {
    out[0] = dual(vector<V, D>(y, k), weights_in<V, D>(weights, k), out[1]);
  });
}
template <int D>
nb::object dual_near_of(int lanes, const In& y, const In& weights, const In& x, double tight) {
  return over<2>(lanes, y, [&]<class V>(V, size_t k, auto& out) {
    out[0] = dual_near(vector<V, D>(y, k), weights_in<V, D>(weights, k), vector<V, D>(x, k), tight,
                       out[1]);
  });
}
// (n, 3): away, along, and 1 / (largest step inside)
template <int D> nb::object boundary_of(int lanes, const In& x, const In& move) {
  return over<3>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    const Boundary edge(vector<V, D>(x, k));
    const Vec<V, D> by = vector<V, D>(move, k);
    const auto way = edge.way(by);
    out = {way.away, way.along, edge.per(by)};
  });
}

// Define f as three(arguments) or four(arguments), for rows of x of three numbers or of four.
template <class... Rest, class Function>
void define(nb::module_& m, const char* name, Function three, Function four) {
  m.def(name, [=](int lanes, In x, Rest... rest) {
    return (x.shape(1) == 4 ? four : three)(lanes, x, rest...);
  });
}

}  // namespace

void bind_phi(nb::module_& m) {
  define<In>(m, "phi", &phi_of<3>, &phi_of<4>);
  define<In>(m, "gradient", &gradient_of<3>, &gradient_of<4>);
  define<In, In>(m, "along", &along_of<3>, &along_of<4>);
  define<In>(m, "inverse_hessian", &inverse_hessian_of<3>, &inverse_hessian_of<4>);
  define<In>(m, "axes", &axes_of<3>, &axes_of<4>);
  define<In>(m, "dual", &dual_of<3>, &dual_of<4>);
  define<In, In, double>(m, "dual_near", &dual_near_of<3>, &dual_near_of<4>);
  define<In>(m, "boundary", &boundary_of<3>, &boundary_of<4>);
}
