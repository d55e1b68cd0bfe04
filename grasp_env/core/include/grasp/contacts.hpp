// Hard contacts: what they transmit and weigh, given once, and where they are now. `place` allocates nothing.
#pragma once
#include "geometry.hpp"

namespace grasp {

inline constexpr double LARGEST = 1e12;    // [N], [N m] beyond which numbers are mistakes
inline constexpr double NOTHING = 1e-280;  // [N] below which a wrench counts as none: its square has no digits left

enum class Placed { good, refused, rank_lost };  // refused: not finite, or a normal that is not of unit length

class Contacts {
public:
    int count = 0;
    std::vector<double> scale, divisor;  // (N, 3) cone coordinates = scale * force, force = cone coordinates / divisor
    std::vector<double> omega, lambda;   // (N,) weights of Phi
    std::vector<double> tangents;        // (N, 3) directions of o, or none: the default rule

    UnitFrame unit;
    std::vector<double> frames;       // (N, 3, 3) columns (n, o, t), object frame
    std::vector<double> matrix;       // (6, 3N) G
    std::vector<double> cone_matrix;  // (6, 3N) G in cone coordinates
    std::vector<double> rows;         // (6, 3N) the same in the unit frame
    std::vector<double> orthonormal;  // (6, 3N) an orthonormal basis of the rows of G (forces)
    std::vector<double> inverse;      // (3N, 6) G^+ in cone coordinates, unit frame: the least change in force

    Contacts() = default;
    // scale: (N, 3) mu for the normal and 1 for round cones; 0 where nothing is transmitted. weights: (N, 2) omega, lambda.
    Contacts(int count, const double* scales, const double* weights, const double* along = nullptr)
        : count(count), scale(scales, scales + 3 * count), divisor(3 * count), omega(count), lambda(count),
          frames(9 * count), matrix(18 * count), cone_matrix(18 * count), rows(18 * count), orthonormal(18 * count),
          inverse(18 * count), inward_(3 * count) {
        for (int j = 0; j < 3 * count; ++j) divisor[j] = scale[j] > 0.0 ? scale[j] : infinity;
        for (int i = 0; i < count; ++i) omega[i] = weights[2 * i], lambda[i] = weights[2 * i + 1];
        if (along) tangents.assign(along, along + 3 * count);
    }

    // positions [m] and inward unit normals, (N, 3) each, object frame
    Placed place(const double* positions, const double* normals) {
        double total = 0.0;
        for (int j = 0; j < 3 * count; ++j) total += std::abs(positions[j]);
        bool good = total < infinity;
        for (int i = 0; i < count; ++i) {
            const Point n = point(normals + 3 * i);
            good = good && std::abs(length(n) - 1.0) <= UNIT_TOLERANCE;
            const Point made = normalised(n);
            for (int a = 0; a < 3; ++a) inward_[3 * i + a] = made[a];
        }
        if (!good) return Placed::refused;
        write_geometry(count, positions, inward_.data(), tangents.empty() ? nullptr : tangents.data(), divisor.data(),
                       {frames.data(), matrix.data(), cone_matrix.data()});
        unit = UnitFrame(positions, count);
        const int size = 3 * count;
        for (int j = 0; j < size; ++j) {
            set_column(orthonormal.data(), size, j,
                       (scale[j] > 0.0 ? 1.0 : 0.0) * unit.of(column(matrix.data(), size, j).data()));
            set_column(rows.data(), size, j, unit.of(column(cone_matrix.data(), size, j).data()));
        }
        return invert() ? Placed::good : Placed::rank_lost;
    }

    // The same contacts with another (N, 3) scale of cone coordinates; false where rank is lost.
    bool rescale(const double* scales) {
        const int size = 3 * count;
        for (int j = 0; j < size; ++j) {
            scale[j] = scales[j], divisor[j] = scales[j] > 0.0 ? scales[j] : infinity;
            const Vec6 made = column(matrix.data(), size, j), unit_made = unit.of(made.data());
            set_column(cone_matrix.data(), size, j, 1.0 / divisor[j] * made);
            set_column(orthonormal.data(), size, j, (scale[j] > 0.0 ? 1.0 : 0.0) * unit_made);
            set_column(rows.data(), size, j, 1.0 / divisor[j] * unit_made);
        }
        return invert();
    }

private:
    std::vector<double> inward_;
    static constexpr double RANK = 1e-8;  // least ratio of singular values of G in the unit frame that counts as rank 6

    // From G in forces and the unit frame, in `orthonormal`, to an orthonormal basis of its rows and to its inverse.
    bool invert() {
        return clearly_full_rank(orthonormal.data(), 3 * count) ? invert_by_factors() : invert_by_rotations();
    }

    // Two Cholesky factors (exact to rounding for condition numbers up to 1e7): G = L Q, G^+ = Q^T L^-1.
    bool invert_by_factors() {
        const int size = 3 * count;
        double lower[6][6] = {};
        for (int pass = 0; pass < 2; ++pass) {
            const Packed6 s = gram(orthonormal.data(), size);
            double factor[6][6] = {};
            for (int i = 0; i < 6; ++i)
                for (int j = 0; j <= i; ++j) {
                    double a = s[packed(i, j)];
                    for (int k = 0; k < j; ++k) a -= factor[i][k] * factor[j][k];
                    if (i == j && !(a > 0.0)) return false;
                    factor[i][j] = i == j ? std::sqrt(a) : a / factor[j][j];
                }
            for (int i = 0; i < 6; ++i) {
                double* row = &orthonormal[size * i];
                for (int k = 0; k < i; ++k)
                    for (int j = 0; j < size; ++j) row[j] -= factor[i][k] * orthonormal[size * k + j];
                for (int j = 0; j < size; ++j) row[j] *= 1.0 / factor[i][i];
            }
            double both[6][6] = {};
            for (int i = 0; i < 6; ++i)
                for (int j = 0; j <= i; ++j) {
                    if (pass == 0) both[i][j] = factor[i][j];
                    else
                        for (int k = j; k <= i; ++k) both[i][j] += lower[i][k] * factor[k][j];
                }
            std::copy(&both[0][0], &both[0][0] + 36, &lower[0][0]);
        }
        double reciprocal[6];
        for (int r = 0; r < 6; ++r) reciprocal[r] = 1.0 / lower[r][r];
        for (int j = 0; j < size; ++j)
            for (int r = 5; r >= 0; --r) {
                double a = orthonormal[size * r + j] * scale[j];
                for (int i = r + 1; i < 6; ++i) a -= lower[i][r] * inverse[6 * j + i];
                inverse[6 * j + r] = a * reciprocal[r];
            }
        return true;
    }

    // Jacobi's one-sided rotations: the singular values to their own last digits, for contacts that hardly span the wrenches.
    bool invert_by_rotations() {
        const int size = 3 * count;
        double* a = orthonormal.data();
        double turn[6][6] = {};  // rows of U^T: a = U^T G
        for (int r = 0; r < 6; ++r) turn[r][r] = 1.0;
        for (int sweep = 0, again = 1; again && sweep < 60; ++sweep) {
            again = 0;
            for (int p = 0; p < 6; ++p)
                for (int q = p + 1; q < 6; ++q) {
                    double pp = 0.0, qq = 0.0, pq = 0.0;
                    for (int j = 0; j < size; ++j)
                        pp += a[size * p + j] * a[size * p + j], qq += a[size * q + j] * a[size * q + j],
                            pq += a[size * p + j] * a[size * q + j];
                    if (!(std::abs(pq) > 1e-16 * std::sqrt(pp * qq))) continue;
                    again = 1;
                    const double zeta = (qq - pp) / (2.0 * pq);
                    const double t = (zeta < 0.0 ? -1.0 : 1.0) / (std::abs(zeta) + std::sqrt(1.0 + zeta * zeta));
                    const double c = 1.0 / std::sqrt(1.0 + t * t), s = c * t;
                    const auto rotate = [&](double* first, double* second, int items) {
                        for (int j = 0; j < items; ++j) {
                            const double x = first[j], y = second[j];
                            first[j] = c * x - s * y, second[j] = s * x + c * y;
                        }
                    };
                    rotate(a + size * p, a + size * q, size), rotate(turn[p], turn[q], 6);
                }
        }
        double value[6], most = 0.0, fewest = infinity;
        for (int r = 0; r < 6; ++r) {
            double square = 0.0;
            for (int j = 0; j < size; ++j) square += a[size * r + j] * a[size * r + j];
            value[r] = std::sqrt(square), most = std::max(most, value[r]), fewest = std::min(fewest, value[r]);
        }
        if (!(fewest >= RANK * most && fewest > 0.0)) return false;
        for (int r = 0; r < 6; ++r)
            for (int j = 0; j < size; ++j) a[size * r + j] /= value[r];
        for (int j = 0; j < size; ++j)
            for (int q = 0; q < 6; ++q) {
                double total = 0.0;
                for (int r = 0; r < 6; ++r) total += a[size * r + j] * turn[r][q] / value[r];
                inverse[6 * j + q] = total * scale[j];
            }
        return true;
    }
};

}  // namespace grasp
