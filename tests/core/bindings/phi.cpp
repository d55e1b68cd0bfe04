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
template <class V> Vec3<V> triple(const In& a, size_t k) {
  return {column<V>(a, k, 0), column<V>(a, k, 1), column<V>(a, k, 2)};
}
template <class V> Weights<V> pair(const In& a, size_t k) {
  return {column<V>(a, k, 0), column<V>(a, k, 1)};
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

nb::object phi_of(int lanes, In x, In weights) {
  return over<1>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    out[0] = phi(triple<V>(x, k), pair<V>(weights, k));
  });
}
nb::object gradient_of(int lanes, In x, In weights) {
  return over<3>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    const Vec3<V> g = gradient(triple<V>(x, k), pair<V>(weights, k));
    out = {g.u, g.o, g.t};
  });
}
// (n, 2): Phi as it comes with its gradient, its curvature along a move
nb::object along_of(int lanes, In x, In move, In weights) {
  return over<2>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    const Vec3<V> at = triple<V>(x, k);
    Vec3<V> unused;
    out = {phi(at, pair<V>(weights, k), unused),
           curvature(at, triple<V>(move, k), pair<V>(weights, k))};
  });
}
nb::object inverse_hessian_of(int lanes, In x, In weights) {
  return over<9>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    const Sym3<V> h = inverse_hessian(triple<V>(x, k), pair<V>(weights, k));
    out = {h.uu, h.uo, h.ut, h.uo, h.oo, h.ot, h.ut, h.ot, h.tt};
  });
}
// (n, 2): value and room
nb::object dual_of(int lanes, In y, In weights) {
  return over<2>(lanes, y, [&]<class V>(V, size_t k, auto& out) {
    out[0] = dual(triple<V>(y, k), pair<V>(weights, k), out[1]);
  });
}
nb::object dual_near_of(int lanes, In y, In weights, In x, double tight) {
  return over<2>(lanes, y, [&]<class V>(V, size_t k, auto& out) {
    out[0] = dual_near(triple<V>(y, k), pair<V>(weights, k), triple<V>(x, k), tight, out[1]);
  });
}
// (n, 3): away, along, and 1 / (largest step inside)
nb::object boundary_of(int lanes, In x, In move) {
  return over<3>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
    const Boundary<V> edge(triple<V>(x, k));
    const Vec3<V> by = triple<V>(move, k);
    const auto way = edge.way(by);
    out = {way.away, way.along, edge.per(by)};
  });
}

}  // namespace

void bind_phi(nb::module_& m) {
  m.def("phi", &phi_of);
  m.def("gradient", &gradient_of);
  m.def("along", &along_of);
  m.def("inverse_hessian", &inverse_hessian_of);
  m.def("dual", &dual_of);
  m.def("dual_near", &dual_near_of);
  m.def("boundary", &boundary_of);
}
