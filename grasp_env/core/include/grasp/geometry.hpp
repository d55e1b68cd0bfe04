// Contact frames, the grasp matrix G and the frame in which wrenches are of one size; arrays are row-major.
#pragma once
#include "linear6.hpp"
#include "vec3.hpp"

namespace grasp {

using Point = Vec3<double>;  // x, y, z in the object frame

inline constexpr double TANGENT_SWITCH = 0.9;
// Normals may miss unit length by this much; they are then normalised exactly.
inline constexpr double UNIT_TOLERANCE = 1e-6;
// Directions that miss unit length and orthogonality by no more are kept, so that a grasp made again keeps its bits.
inline constexpr double ROUNDING = 1e-15;

inline Point point(const double* a) { return {a[0], a[1], a[2]}; }
inline double length(const Point& a) { return std::sqrt(dot(a, a)); }
inline Point normalised(const Point& a) {
    const double size = length(a);
    return std::abs(size - 1.0) > ROUNDING ? (1.0 / size) * a : a;
}

// Cone coordinates = scale * force: (mu, o mu / mu_o, t mu / mu_t), mu = sqrt(mu_o mu_t), so that every friction cone is round and
// of slope one. Without friction the normal force alone is transmitted.
inline Point cone_scale(double mu_o, double mu_t) {
    if (!(mu_o > 0.0 && mu_t > 0.0)) return {1.0, 0.0, 0.0};
    if (mu_o == mu_t) return {mu_o, 1.0, 1.0};
    const double mu = std::sqrt(mu_o * mu_t);
    return {mu, mu / mu_o, mu / mu_t};
}

// (n, o, t) with o the projection of `along` on the tangent plane; without one of e_x, or of e_y where |n . e_x| > 0.9.
struct Frame {
    Point n, o, t;

    Frame(const Point& normal, const double* along) : n(normal) {
        if (along) {
            o = point(along);
            for (int pass = 0; pass < 2; ++pass) {  // the second takes what rounding left of o . n for a tangent close to n
                const double off = dot(o, n);
                if (std::abs(off) > ROUNDING) o -= off * n;
                o = normalised(o);
            }
        } else if (std::abs(n.u) > TANGENT_SWITCH) {
            o = {-n.o * n.u, 1.0 - n.o * n.o, -n.o * n.t};
        } else {
            o = {1.0 - n.u * n.u, -n.u * n.o, -n.u * n.t};
        }
        o = normalised(o);
        t = cross(n, o);
    }
    const Point& operator[](int a) const { return a == 0 ? n : a == 1 ? o : t; }
};

// Where a wrench is (force, moment about the contacts' centre / their length) [N]: of one size wherever the origin is and however
// large the object.
struct UnitFrame {
    Point centre{0.0, 0.0, 0.0};
    double length = 0.0;  // [m] root mean square distance of the contacts from their centre

    UnitFrame() = default;
    UnitFrame(const double* positions, int count) {
        const double share = 1.0 / std::max(count, 1);
        for (int i = 0; i < count; ++i) centre += share * point(positions + 3 * i);
        double square = 0.0;
        for (int i = 0; i < count; ++i) {
            const Point arm = point(positions + 3 * i) - centre;
            square += dot(arm, arm);
        }
        length = std::sqrt(square * share);
    }
    double scale() const { return length > 0.0 ? 1.0 / length : 1.0; }

    Vec6 of(const double* w) const {
        const Point force = point(w), moment = scale() * (point(w + 3) - cross(centre, force));
        return {force.u, force.o, force.t, moment.u, moment.o, moment.t};
    }
    // Multipliers of the given wrench from those of this frame: the transposed map.
    Vec6 pull_back(const Vec6& n) const {
        const Point moment = scale() * point(n.data() + 3), force = point(n.data()) - cross(moment, centre);
        return {force.u, force.o, force.t, moment.u, moment.o, moment.t};
    }
    // The map itself, (6, 6).
    void write(double* out) const {
        for (int c = 0; c < 6; ++c) {
            double unit[6] = {};
            unit[c] = 1.0;
            const Vec6 column = of(unit);
            for (int r = 0; r < 6; ++r) out[6 * r + c] = column[r] + 0.0;  // + 0: no negative zeros
        }
    }
};

// Column j of a (6, columns) matrix.
inline Vec6 column(const double* matrix, int columns, int j) {
    Vec6 out;
    for (int r = 0; r < 6; ++r) out[r] = matrix[columns * r + j];
    return out;
}
inline void set_column(double* matrix, int columns, int j, const Vec6& a) {
    for (int r = 0; r < 6; ++r) matrix[columns * r + j] = a[r];
}
// Gram matrix of six rows, packed.
inline Packed6 gram(const double* rows, int columns) {
    Packed6 s;
    for (int r = 0; r < 6; ++r)
        for (int q = 0; q <= r; ++q) {
            double total = 0.0;
            for (int j = 0; j < columns; ++j) total += rows[columns * r + j] * rows[columns * q + j];
            s[packed(r, q)] = total;
        }
    return s;
}

// A lower bound of the least eigenvalue of a 6 x 6 Gram matrix s over its trace, from its factor; 0 where rounding may have made
// it: where it is above CLEAR_RANK the rows have rank 6 beyond doubt, elsewhere only their singular values can tell.
// det S <= least eigenvalue * (trace / 5)^5, so the pivots of S bound that eigenvalue from below.
inline constexpr double CLEAR_RANK = 1e-10;
inline double rank_bound(const Packed6& s, const Ldl6& factor) {
    constexpr double LOST = 1e-13;  // of the trace: a pivot that rounding may have made
    double trace = 0.0, bound = 1.0;
    for (int r = 0; r < 6; ++r) trace += s[packed(r, r)];
    for (int r = 0; r < 6; ++r) {
        const double pivot = 1.0 / factor.l[packed(r, r)];
        if (!(pivot > LOST * trace)) return 0.0;
        bound *= pivot * (5.0 / trace);
    }
    return 0.2 * bound;
}

// The wrench of a unit force along an axis at the end of an arm.
inline Vec6 unit_wrench(const Point& arm, const Point& axis) {
    const Point moment = cross(arm, axis);
    return {axis.u, axis.o, axis.t, moment.u, moment.o, moment.t};
}

}  // namespace grasp
