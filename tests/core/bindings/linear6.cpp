// The 6 x 6 system.
#include "arrays.hpp"

using namespace grasp;

namespace {

Packed6 lower_of(const In& matrix) {
    const double* a = numbers(matrix, 36);
    Packed6 out;
    for (int r = 0; r < 6; ++r)
        for (int s = 0; s <= r; ++s) out[packed(r, s)] = a[6 * r + s];
    return out;
}

nb::tuple factor(In matrix) {
    Ldl6 f;
    const double least = f.factor(lower_of(matrix));
    return nb::make_tuple(least, array(f.l));
}

nb::object solve(In matrix, In right) {
    Ldl6 f;
    f.factor(lower_of(matrix));
    return array(f.solve(six(right)));
}

double bound_of_rank(In rows) {
    const Packed6 s = gram(numbers(rows, rows.size()), int(rows.size() / 6));
    Ldl6 f;
    f.factor(s);
    return rank_bound(s, f);
}
double size_of(In a) { return size(six(a)); }

// Of A (n, 6), g (n,) and b (6,): what A does not reach of g, its multipliers, the least z with A^T z = b, its multipliers.
nb::tuple rows_by_size(In matrix, In g, In b) {
    const int rows = int(matrix.shape(0));
    Qr6 qr(rows);
    for (int i = 0; i < rows; ++i)
        for (int k = 0; k < 6; ++k) qr(i, k) = numbers(matrix, 6 * rows)[6 * i + k];
    const bool found = qr.factor();
    std::vector<double> rest(numbers(g, rows), numbers(g, rows) + rows), z(rows);
    const Vec6 reached = qr.reject(rest), n = qr.least(six(b), z);
    return nb::make_tuple(found, array(rest), array(reached), array(z), array(n));
}

}  // namespace

void bind_linear6(nb::module_& m) {
    m.def("factor", &factor, "matrix"_a, "Least pivot, and (21,) the packed L with 1 / D on the diagonal.");
    m.def("solve", &solve, "matrix"_a, "right"_a);
    m.attr("CLEAR_RANK") = CLEAR_RANK;
    m.def("rank_bound", &bound_of_rank, "rows"_a);
    m.def("size", &size_of, "a"_a);
    m.def("qr", &rows_by_size, "matrix"_a, "g"_a, "b"_a, "Whether it has rank 6; g - A n, n; z = A n with A^T z = b, n.");
}
