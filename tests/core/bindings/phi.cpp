// The formulas of one contact, over rows of contacts that fill registers of so many lanes.
#include "arrays.hpp"

using namespace grasp;

namespace {

// A column of rows of so many numbers in the lanes, from a row on; the last row is repeated to fill a register.
template <class V> V column(const In& a, size_t first, size_t which) {
    const size_t rows = a.shape(0), columns = a.size() / rows;
    V out{};
    for (int n = 0; n < width<V>; ++n) set(out, n, a.data()[std::min(first + n, rows - 1) * columns + which]);
    return out;
}
template <class V> Vec3<V> triple(const In& a, size_t k) { return {column<V>(a, k, 0), column<V>(a, k, 1), column<V>(a, k, 2)}; }
template <class V> Weights<V> pair(const In& a, size_t k) { return {column<V>(a, k, 0), column<V>(a, k, 1)}; }

// (rows of x, COLUMNS) numbers: f(V{}, first row of a register, out) fills the columns of a register.
template <size_t COLUMNS, class F> nb::object over(int lanes, const In& x, F&& f) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const size_t rows = x.shape(0);
        std::vector<double> out(rows * COLUMNS);
        for (size_t first = 0; first < rows; first += width<V>) {
            std::array<V, COLUMNS> found;
            f(zero, first, found);
            for (size_t n = 0; n < size_t(width<V>) && first + n < rows; ++n)
                for (size_t c = 0; c < COLUMNS; ++c) out[(first + n) * COLUMNS + c] = get(found[c], int(n));
        }
        return array(out, {rows, COLUMNS});
    });
}

// (n, 2): phi of one contact, wherever x is, and its slack
nb::object phi_of(int lanes, In x, In weights) {
    return over<2>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
        out = {phi(triple<V>(x, k), pair<V>(weights, k)), slack(triple<V>(x, k))};
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
        out = {phi(at, pair<V>(weights, k), unused), curvature(at, triple<V>(move, k), pair<V>(weights, k))};
    });
}
nb::object inverse_hessian_of(int lanes, In x, In weights) {
    return over<9>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
        const Sym3<V> h = inverse_hessian(triple<V>(x, k), pair<V>(weights, k));
        out = {h.uu, h.uo, h.ut, h.uo, h.oo, h.ot, h.ut, h.ot, h.tt};
    });
}
// (n, 13): along, inward, across; what the price pulls along and inward, and what the barrier does
nb::object axes_of(int lanes, In x, In weights) {
    return over<13>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
        const Axes<V> a(triple<V>(x, k), pair<V>(weights, k));
        for (int i = 0; i < 9; ++i) out[i] = a[i / 3][i % 3];
        out[9] = a.price.along, out[10] = a.price.inward, out[11] = a.barrier.along, out[12] = a.barrier.inward;
    });
}
// (n, 2): value and room
nb::object dual_of(int lanes, In y, In weights) {
    return over<2>(lanes, y,
                   [&]<class V>(V, size_t k, auto& out) { out[0] = dual(triple<V>(y, k), pair<V>(weights, k), out[1]); });
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
// (n, 12): v, eta, shrink, root, scaled(d), twice(d)
nb::object scaling_of(int lanes, In x, In s, In d) {
    return over<12>(lanes, x, [&]<class V>(V, size_t k, auto& out) {
        const Scaling<V> m(triple<V>(x, k), triple<V>(s, k));
        const Vec3<V> scaled = m.scaled(triple<V>(d, k)), twice = m.twice(triple<V>(d, k));
        out = {m.v.u, m.v.o, m.v.t, m.eta, m.shrink, m.root, scaled.u, scaled.o, scaled.t, twice.u, twice.o, twice.t};
    });
}
// (n, 7): sum, least and largest of each register, and what its lanes make of min, max, abs and sqrt with those of b
nb::object lanes_of(int lanes, In a, In b) {
    return over<7>(lanes, a, [&]<class V>(V, size_t k, auto& out) {
        const V p = column<V>(a, k, 0), q = column<V>(b, k, 0);
        out = {all<V>(sum(p)), all<V>(least(p)), all<V>(largest(p)), min(p, q), max(p, q), abs(p), sqrt(p)};
    });
}

}  // namespace

void bind_phi(nb::module_& m) {
    nb::list layouts;
    for (const auto& [lanes, blocks] : LAYOUTS) layouts.append(nb::make_tuple(lanes, blocks));
    m.attr("LAYOUTS") = layouts;
    m.def("phi", &phi_of), m.def("gradient", &gradient_of), m.def("along", &along_of), m.def("axes", &axes_of);
    m.def("inverse_hessian", &inverse_hessian_of), m.def("dual", &dual_of), m.def("dual_near", &dual_near_of);
    m.def("boundary", &boundary_of), m.def("scaling", &scaling_of), m.def("lanes", &lanes_of);
}
