// The general program's insides, on dense rows (m, N, 4) in (u, o, t, w): which are of one contact is found here.
#include <nanobind/stl/string.h>

#include <grasp/general/program.hpp>

#include "arrays.hpp"

using namespace grasp;

namespace {

constexpr int D = 4;

// Dense rows as `Rows`, and where each of them went.
template <class R, int T> struct Dense {
    std::vector<std::pair<bool, int>> place;  // (m,) own row or joint row, and its index
    Rows<R, D, T> rows;

    Dense(const In& given, const In& coupling, const In& right, int equal) : place(given.shape(0)), rows(sizes(given, equal)) {
        const int count = rows.count, many = int(place.size());
        const auto row = [&](int r, int i) {
            Tuple<double, D> out{};
            if (i < count) std::copy_n(given.data() + D * (count * r + i), D, out.begin());
            return out;
        };
        const auto shared = [&](int r) {
            Tuple<R, T> out;
            for (int k = 0; k < T; ++k) out[k] = coupling.data()[T * r + k];
            return out;
        };
        std::vector<Tuple<double, D>> whole(count);
        for (int r = 0; r < many; ++r) {
            if (owner(given, equal, r) >= 0) continue;
            for (int i = 0; i < count; ++i) whole[i] = row(r, i);
            rows.add_joint(whole, shared(r), r);
        }
        for (int i = 0; i <= count; ++i)
            for (int r = 0; r < many; ++r)
                if (owner(given, equal, r) == i) rows.add_own(i, wide<R>(row(r, i)), shared(r), r);
        rows.finish();
        for (int k = 0; k < int(rows.own.size()); ++k)
            place[rows.own[k].label] = {true, k}, rows.own[k].right = right.data()[rows.own[k].label];
        for (int r = 0; r < rows.joint; ++r) place[rows.label[r]] = {false, r}, rows.right[r] = right.data()[rows.label[r]];
    }
    void put(const In& from, ArenaVector<R>& own, ArenaVector<R>& joint) const {
        for (std::size_t r = 0; r < place.size(); ++r) (place[r].first ? own : joint)[place[r].second] = from.data()[r];
    }
    nb::object get(const ArenaVector<R>& own, const ArenaVector<R>& joint) const {
        std::vector<double> out;
        for (const auto& [mine, k] : place) out.push_back(double((mine ? own : joint)[k]));
        return array(out);
    }

private:
    // The one contact that row r touches, N: none, -1: several, or an equation.
    static int owner(const In& given, int equal, int r) {
        const int count = int(given.shape(1));
        int touched = 0, last = count;
        for (int i = 0; i < count; ++i) {
            const double* at = given.data() + D * (count * r + i);
            if (std::any_of(at, at + D, [](double value) { return value != 0.0; })) ++touched, last = i;
        }
        return r < equal || touched > 1 ? -1 : last;
    }
    static Rows<R, D, T> sizes(const In& given, int equal) {
        int joints = 0;
        for (int r = 0; r < int(given.shape(0)); ++r) joints += owner(given, equal, r) < 0;
        return {int(given.shape(1)), equal, joints, int(given.shape(0)) - joints};
    }
};

template <class R> void put(const In& from, ArenaVector<Tuple<R, D>>& to) {
    for (std::size_t i = 0; i < to.size(); ++i)
        for (int a = 0; a < D; ++a) to[i][a] = from.data()[D * i + a];
}
template <class R> nb::object get(const ArenaVector<Tuple<R, D>>& from) {
    std::vector<double> out;
    for (const auto& z : from)
        for (const R& value : z) out.push_back(double(value));
    return array(out, {from.size(), D});
}
template <class R, std::size_t T> nb::object get(const std::array<R, T>& from) {
    std::vector<double> out;
    for (const R& value : from) out.push_back(double(value));
    return array(out);
}
std::vector<char> flags(const In& soft) { return {soft.data(), soft.data() + soft.size()}; }

// f with the number of shared variables, and double or DoubleDouble, as types.
template <class F> nb::object with(int shared, bool twice, F&& f) {
    const auto number = [&]<int T>(std::integral_constant<int, T> t) { return twice ? f(DoubleDouble(), t) : f(double(), t); };
    if (shared == 0) return number(std::integral_constant<int, 0>());
    if (shared == 1) return number(std::integral_constant<int, 1>());
    if (shared == 2) return number(std::integral_constant<int, 2>());
    throw nb::value_error("0, 1 or 2 shared variables");
}

// `limit` iterations from (z, s, t, y, slack): the same five, and code, iterations, objective.
nb::object interior_point(const In& given, const In& coupling, const In& right, int equal, const In& cost, const In& shared_cost,
                          const In& soft, const In& z, const In& s, const In& t, const In& y, const In& slack, int limit,
                          bool twice) {
    return with(int(shared_cost.size()), twice, [&]<class R, int T>(R, std::integral_constant<int, T>) -> nb::object {
        const Dense<R, T> dense(given, coupling, right, equal);
        const std::vector<char> of_soft = flags(soft);
        InteriorPoint<R, D, T> engine(dense.rows, of_soft);
        put(cost, engine.cost), put(z, engine.at.z), put(s, engine.at.s);
        for (int k = 0; k < T; ++k) engine.shared_cost[k] = shared_cost.data()[k], engine.at.t[k] = t.data()[k];
        dense.put(y, engine.at.own, engine.at.joint), dense.put(slack, engine.at.own_slack, engine.at.joint_slack);
        const Code code = engine.run(1e-15, 0.0, 0.0, limit, [] { return infinity; });
        return nb::make_tuple(get(engine.at.z), get(engine.at.s), get(engine.at.t), dense.get(engine.at.own, engine.at.joint),
                              dense.get(engine.at.own_slack, engine.at.joint_slack), int(code), engine.iterations,
                              double(engine.objective()));
    });
}

// Solution (e, t, y) of `RowSystem` and what it misses; shapes (N, 3, 3), lines (N,).
nb::object row_system(const In& given, const In& coupling, int equal, const In& diagonal, const In& shapes, const In& lines,
                      const In& fz, const In& ft, const In& fy, bool twice) {
    return with(int(ft.size()), twice, [&]<class R, int T>(R, std::integral_constant<int, T>) -> nb::object {
        const Dense<R, T> dense(given, coupling, diagonal, equal);
        RowSystem<R, D, T> system(dense.rows);
        for (int i = 0; i < dense.rows.count; ++i) {
            for (int a = 0; a < 9; ++a) system.shapes[i].a[a / 3][a % 3] = shapes.data()[9 * i + a];
            system.shapes[i].line = lines.data()[i];
        }
        dense.put(diagonal, system.own_diagonal, system.joint_diagonal);
        Space<R, D, T> f(dense.rows), x(dense.rows), left(dense.rows);
        put(fz, f.z), dense.put(fy, f.own, f.joint);
        for (int k = 0; k < T; ++k) f.t[k] = ft.data()[k];
        if (!system.factor(dense.rows)) throw nb::value_error("not positive definite");
        system.solve(dense.rows, f, x);
        system.missed(dense.rows, f, x, left);
        return nb::make_tuple(get(x.z), get(x.t), dense.get(x.own, x.joint), get(left.z), get(left.t),
                              dense.get(left.own, left.joint));
    });
}

// Newton on Phi: (z, y, code, iterations, trials, value, bound).
nb::object phi_rows(const In& given, const In& right, int equal, const In& weights, const In& row_weights, const In& soft,
                    const In& z, double tolerance, int limit, bool twice) {
    return with(0, twice, [&]<class R, int T>(R, std::integral_constant<int, T>) -> nb::object {
        if constexpr (T == 0) {
            const Dense<R, 0> dense(given, given, right, equal);
            const std::vector<char> of_soft = flags(soft);
            PhiRows<R, D> engine(dense.rows, of_soft, int(row_weights.size()));
            for (int i = 0; i < dense.rows.count; ++i) engine.weights[i] = {weights.data()[2 * i], weights.data()[2 * i + 1]};
            for (std::size_t k = 0; k < row_weights.size(); ++k) engine.row_weights[k] = row_weights.data()[k];
            put(z, engine.z);
            const double none[6] = {};
            const Code code = engine.run({.wrench = none}, tolerance, limit, LONG);
            return nb::make_tuple(get(engine.z), dense.get(engine.y.own, engine.y.joint), int(code), engine.iterations,
                                  engine.trials, double(engine.value), double(engine.bound));
        } else {
            return nb::none();
        }
    });
}

// (high, low) of a o b, and of the root of a, in `DoubleDouble`; a, b (2,)
nb::object twice(const In& a, const In& b, const std::string& what) {
    const auto read = [](const In& x) { return DoubleDouble(numbers(x, 2)[0]) + DoubleDouble(x.data()[1]); };
    const DoubleDouble p = read(a), q = read(b);
    const DoubleDouble made = what == "+" ? p + q : what == "-" ? p - q : what == "*" ? p * q : what == "/" ? p / q : sqrt(p);
    return nb::make_tuple(made.high, made.low);
}

}  // namespace

void bind_program(nb::module_& m) {
    m.def("interior_point", &interior_point, "rows"_a, "coupling"_a, "right"_a, "equal"_a, "cost"_a, "shared_cost"_a, "soft"_a,
          "z"_a, "s"_a, "t"_a, "y"_a, "slack"_a, "limit"_a, "twice"_a = false);
    m.def("row_system", &row_system, "rows"_a, "coupling"_a, "equal"_a, "diagonal"_a, "shapes"_a, "lines"_a, "fz"_a, "ft"_a,
          "fy"_a, "twice"_a = false);
    m.def("phi_rows", &phi_rows, "rows"_a, "right"_a, "equal"_a, "weights"_a, "row_weights"_a, "soft"_a, "z"_a, "tolerance"_a,
          "limit"_a, "twice"_a = false);
    m.def("twice", &twice, "a"_a, "b"_a, "what"_a);
}
