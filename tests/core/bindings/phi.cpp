// The formulas of one contact, over rows of contacts that fill registers of so many lanes.
#include "arrays.hpp"

using namespace grasp;

namespace {

// Rows of three, four or two numbers in the lanes; the last rows are repeated to fill a register.
template <class V> class Rows {
public:
    explicit Rows(const In& a, size_t columns) : a_(numbers(a, a.shape(0) * columns)), rows_(a.shape(0)), columns_(columns) {}
    V operator()(size_t first, size_t column) const {
        V out{};
        for (int n = 0; n < width<V>; ++n) set(out, n, a_[std::min(first + n, rows_ - 1) * columns_ + column]);
        return out;
    }
    Vec3<V> triple(size_t first) const { return {(*this)(first, 0), (*this)(first, 1), (*this)(first, 2)}; }
    Weights<V> weights(size_t first) const { return {(*this)(first, 0), (*this)(first, 1)}; }

private:
    const double* a_;
    size_t rows_, columns_;
};

// (rows, columns) numbers: f(first row of a register, out) fills the columns of a register.
template <class V, size_t COLUMNS, class F> nb::object over(size_t rows, F&& f) {
    std::vector<double> out(rows * COLUMNS);
    for (size_t first = 0; first < rows; first += width<V>) {
        std::array<V, COLUMNS> found;
        f(first, found);
        for (size_t n = 0; n < size_t(width<V>) && first + n < rows; ++n)
            for (size_t c = 0; c < COLUMNS; ++c) out[(first + n) * COLUMNS + c] = get(found[c], int(n));
    }
    return array(out, {rows, COLUMNS});
}

nb::object phi_of(int lanes, In x, In weights) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> at(x, 3), w(weights, 2);
        return over<V, 2>(x.shape(0), [&](size_t k, auto& out) { out = {phi(at.triple(k), w.weights(k)), slack(at.triple(k))}; });
    });
}

nb::object gradient_of(int lanes, In x, In weights) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> at(x, 3), w(weights, 2);
        return over<V, 3>(x.shape(0), [&](size_t k, auto& out) {
            const Vec3<V> g = gradient(at.triple(k), w.weights(k));
            out = {g.u, g.o, g.t};
        });
    });
}

// (Phi as it comes with its gradient, its curvature along a move)
nb::object along_of(int lanes, In x, In move, In weights) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> at(x, 3), to(move, 3), w(weights, 2);
        return over<V, 2>(x.shape(0), [&](size_t k, auto& out) {
            Vec3<V> unused;
            out = {phi(at.triple(k), w.weights(k), unused), curvature(at.triple(k), to.triple(k), w.weights(k))};
        });
    });
}

nb::object inverse_hessian_of(int lanes, In x, In weights) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> at(x, 3), w(weights, 2);
        return over<V, 9>(x.shape(0), [&](size_t k, auto& out) {
            const Sym3<V> h = inverse_hessian(at.triple(k), w.weights(k));
            out = {h.uu, h.uo, h.ut, h.uo, h.oo, h.ot, h.ut, h.ot, h.tt};
        });
    });
}

nb::object axes_of(int lanes, In x, In weights) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> at(x, 3), w(weights, 2);
        return over<V, 13>(x.shape(0), [&](size_t k, auto& out) {
            const Axes<V> a(at.triple(k), w.weights(k));
            for (int i = 0; i < 9; ++i) out[i] = a[i / 3][i % 3];
            out[9] = a.price.along, out[10] = a.price.inward, out[11] = a.barrier.along, out[12] = a.barrier.inward;
        });
    });
}

nb::object dual_of(int lanes, In y, In weights) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> at(y, 3), w(weights, 2);
        return over<V, 2>(y.shape(0), [&](size_t k, auto& out) { out[0] = dual(at.triple(k), w.weights(k), out[1]); });
    });
}

nb::object dual_near_of(int lanes, In y, In weights, In x, double tight) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> at(y, 3), w(weights, 2), near(x, 3);
        return over<V, 2>(y.shape(0), [&](size_t k, auto& out) {
            out[0] = dual_near(at.triple(k), w.weights(k), near.triple(k), tight, out[1]);
        });
    });
}

nb::object boundary_of(int lanes, In x, In move) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> at(x, 3), by(move, 3);
        return over<V, 3>(x.shape(0), [&](size_t k, auto& out) {
            const Boundary<V> edge(at.triple(k));
            const auto way = edge.way(by.triple(k));
            out = {way.away, way.along, edge.per(by.triple(k))};
        });
    });
}

nb::object scaling_of(int lanes, In x, In s, In d) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> primal(x, 3), dual(s, 3), by(d, 3);
        return over<V, 12>(x.shape(0), [&](size_t k, auto& out) {
            const Scaling<V> m(primal.triple(k), dual.triple(k));
            const Vec3<V> scaled = m.scaled(by.triple(k)), twice = m.twice(by.triple(k));
            out = {m.v.u, m.v.o, m.v.t, m.eta, m.shrink, m.root, scaled.u, scaled.o, scaled.t, twice.u, twice.o, twice.t};
        });
    });
}

// sum, least and largest of each register, and what its lanes make of min, max, abs and sqrt with those of b
nb::object lanes_of(int lanes, In a, In b) {
    return with_lanes(lanes, [&](auto zero) {
        using V = decltype(zero);
        const Rows<V> one(a, 1), two(b, 1);
        return over<V, 7>(a.shape(0), [&](size_t k, auto& out) {
            const V p = one(k, 0), q = two(k, 0);
            out = {all<V>(sum(p)), all<V>(least(p)), all<V>(largest(p)), min(p, q), max(p, q), abs(p), sqrt(p)};
        });
    });
}

}  // namespace

void bind_phi(nb::module_& m) {
    nb::list layouts;
    for (const auto& [lanes, blocks] : LAYOUTS) layouts.append(nb::make_tuple(lanes, blocks));
    m.attr("LAYOUTS") = layouts;
    m.def("phi", &phi_of, "lanes"_a, "x"_a, "weights"_a, "(n, 2): phi of one contact, wherever x is, and its slack.");
    m.def("along", &along_of, "lanes"_a, "x"_a, "move"_a, "weights"_a);
    m.def("gradient", &gradient_of, "lanes"_a, "x"_a, "weights"_a, "(n, 3).");
    m.def("inverse_hessian", &inverse_hessian_of, "lanes"_a, "x"_a, "weights"_a, "(n, 9).");
    m.def("axes", &axes_of, "lanes"_a, "x"_a, "weights"_a,
          "(n, 13): along, inward, across; what the price pulls along and inward, and what the barrier does.");
    m.def("dual", &dual_of, "lanes"_a, "y"_a, "weights"_a, "(n, 2): value and room.");
    m.def("dual_near", &dual_near_of, "lanes"_a, "y"_a, "weights"_a, "x"_a, "tight"_a, "(n, 2): value and room.");
    m.def("boundary", &boundary_of, "lanes"_a, "x"_a, "move"_a, "(n, 3): away, along, and 1 / (largest step inside).");
    m.def("scaling", &scaling_of, "lanes"_a, "x"_a, "s"_a, "d"_a, "(n, 12): v, eta, shrink, root, scaled(d), twice(d).");
    m.def("lanes", &lanes_of, "lanes"_a, "a"_a, "b"_a, "(n, 7): sum, least, largest of a register; min, max, abs, sqrt.");
}
