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

nb::object gram_of(In rows) { return array(gram(numbers(rows, rows.size()), int(rows.size() / 6))); }
double bound_of_rank(In rows) {
    const Packed6 s = gram(numbers(rows, rows.size()), int(rows.size() / 6));
    Ldl6 f;
    f.factor(s);
    return rank_bound(s, f);
}
double size_of(In a) { return size(six(a)); }

}  // namespace

void bind_linear6(nb::module_& m) {
    m.def("factor", &factor, "matrix"_a, "Least pivot, and (21,) the packed L with 1 / D on the diagonal.");
    m.def("solve", &solve, "matrix"_a, "right"_a);
    m.def("gram", &gram_of, "rows"_a, "(21,) packed.");
    m.attr("CLEAR_RANK") = CLEAR_RANK;
    m.def("rank_bound", &bound_of_rank, "rows"_a);
    m.def("size", &size_of, "a"_a);
}
