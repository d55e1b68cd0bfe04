// Six equations, whatever the number of contacts: packed lower triangles and their factors L D L^T.
#pragma once
#include <algorithm>
#include <cmath>
#include "lanes.hpp"

namespace grasp {

using Vec6 = std::array<double, 6>;

inline Vec6 operator+(Vec6 a, const Vec6& b) {
    for (int r = 0; r < 6; ++r) a[r] += b[r];
    return a;
}
inline Vec6 operator-(Vec6 a, const Vec6& b) {
    for (int r = 0; r < 6; ++r) a[r] -= b[r];
    return a;
}
inline Vec6 operator*(double k, Vec6 a) {
    for (int r = 0; r < 6; ++r) a[r] *= k;
    return a;
}
inline double dot(const Vec6& a, const Vec6& b) {
    double total = 0.0;
    for (int r = 0; r < 6; ++r) total += a[r] * b[r];
    return total;
}
// Largest magnitude.
inline double size(const Vec6& a) {
    double most = 0.0;
    for (double v : a) most = std::abs(v) <= most ? most : std::abs(v);  // keeps what is not a number
    return most;
}

constexpr int packed(int r, int s) { return r * (r + 1) / 2 + s; }
using Packed6 = std::array<double, 21>;

struct Ldl6 {
    Packed6 l;  // L below, 1 / D on the diagonal

    // Factors a packed lower triangle; returns the least pivot: positive where the matrix is positive definite.
    double factor(const Packed6& s) {
        double smallest = infinity;
#pragma GCC unroll 8
        for (int j = 0; j < 6; ++j) {
            double c[6], d = s[packed(j, j)];
#pragma GCC unroll 8
            for (int k = 0; k < j; ++k) {
                c[k] = s[packed(j, k)];
#pragma GCC unroll 8
                for (int m = 0; m < k; ++m) c[k] -= c[m] * l[packed(k, m)];
                l[packed(j, k)] = c[k] * l[packed(k, k)];
                d -= c[k] * l[packed(j, k)];
            }
            l[packed(j, j)] = 1.0 / d;
            smallest = d < smallest || d != d ? d : smallest;
        }
        return smallest;
    }

    Vec6 solve(Vec6 b) const {
#pragma GCC unroll 8
        for (int j = 1; j < 6; ++j)
#pragma GCC unroll 8
            for (int k = 0; k < j; ++k) b[j] -= l[packed(j, k)] * b[k];
#pragma GCC unroll 8
        for (int j = 5; j >= 0; --j) {
            b[j] *= l[packed(j, j)];
#pragma GCC unroll 8
            for (int k = j + 1; k < 6; ++k) b[j] -= l[packed(k, j)] * b[k];
        }
        return b;
    }
};

}  // namespace grasp
