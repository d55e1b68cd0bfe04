// What limits the forces of a program: balance, cones, torsion, further rows; and the interior points that stay within them.
//
// Contact i has z_i = (u, o, t, w): cone coordinates and, where it is soft, w = u - |torsion| in units of its limit with a row w <= 2u.
// Balance is taken with orthonormal rows, G = L Q, so that contacts close to each other cost no digits.
#pragma once
#include <memory>
#include "interior_point.hpp"

namespace grasp {

// What a program is made of; arrays are row-major.
struct Given {
    int count, limits;  // N, M
    const double* frame;  // (6, 6) wrenches into the unit frame
    const double* balance;  // (6, N, 4) of (u, o, t, w), unit frame
    const double* rows;  // (M, N, 4) of length one: rows . z <= bound; those of torsion come first
    const double* bound;  // (M,) [N]
    const double* divisor;  // (N, 4) force and torsion from z; inf where nothing is transmitted
    const double* shares;  // (M,) [N] by how much a bound grows where its limit grows by all of itself; 0: never
    bool elastic;  // whether the least excess will be asked
};

// `excess`: the largest part of itself by which a limit is exceeded, t with rows . z <= bound + t share.
enum class Criterion { sum, largest, excess };

namespace detail {

// One program in two precisions: the second is asked where the first ends short.
template <int D, int T> struct Precisions {
    InteriorPoint<double, D, T> quick;
    InteriorPoint<Twice, D, T> careful;
};

// The least, or what is no number.
inline double least_of(const std::vector<double>& values) {
    double least = infinity;
    for (double value : values) least = value >= least ? least : value;
    return least;
}

template <int D> struct Constraints {
    using Field = std::vector<Tuple<double, D>>;  // z, or a row of coefficients of it
    int count, limits, torsions;  // N, M; the first rows are those of torsion
    std::vector<char> soft;
    std::vector<double> price, divisor, bound, shares;  // price: normal force = price u
    std::vector<int> torsion_row;  // (N,) -1: not soft
    std::vector<Field> balance, limit, turn;  // (6,) G, (M,), (6,) Q
    double frame[6][6], lower[6][6] = {};  // L

    explicit Constraints(const Given& given)
        : count(given.count), limits(given.limits), soft(count), price(count), divisor(given.divisor, given.divisor + 4 * count),
          bound(given.bound, given.bound + limits), shares(given.shares, given.shares + limits), torsion_row(count, -1) {
        std::copy(given.frame, given.frame + 36, &frame[0][0]);
        for (int i = 0; i < count; ++i) soft[i] = divisor[4 * i + 3] < infinity, price[i] = 1.0 / divisor[4 * i];
        const auto rows_of = [&](const double* from, int many, std::vector<Field>& to) {
            to.assign(many, Field(count));
            for (int k = 0; k < many; ++k)
                for (int i = 0; i < count; ++i)
                    std::copy(from + 4 * (count * k + i), from + 4 * (count * k + i) + D, to[k][i].begin());
        };
        rows_of(given.balance, 6, balance), rows_of(given.rows, limits, limit);
        torsions = 0;
        for (int i = 0; i < count; ++i)
            if (soft[i]) torsion_row[i] = torsions++;
        orthonormalise();
    }

    // What keeps the first `many` limits in both precisions: T = 0 the least sum of normal forces; 1 the least of a t above each normal force,
    // or above each excess; 2 the largest of a depth m, with the share r of the wrench.
    template <int T> Precisions<D, T> within(int many, Criterion criterion = Criterion::sum) const {
        return {engine<double, T>(many, criterion), engine<Twice, T>(many, criterion)};
    }
    // (1, 0, 0, 1): the way into a cone.
    static Tuple<double, D> inwards() {
        Tuple<double, D> out{};
        out[0] = 1.0;
        if (D == 4) out[D - 1] = 1.0;
        return out;
    }
    // Room for what `rooms` writes.
    std::vector<double> room() const { return std::vector<double>(2 * count + limits); }
    static double product(const Field& a, const Field& b) {
        double total = 0.0;
        for (std::size_t i = 0; i < a.size(); ++i) total += inner(a[i], b[i]);
        return total;
    }
    Vec6 in_frame(const double* wrench) const {
        Vec6 out{};
        for (int r = 0; r < 6; ++r)
            for (int q = 0; q < 6; ++q) out[r] += frame[r][q] * wrench[q];
        return out;
    }
    Vec6 solve_lower(Vec6 a) const {
        for (int r = 0; r < 6; ++r) {
            for (int q = 0; q < r; ++q) a[r] -= lower[r][q] * a[q];
            a[r] /= lower[r][r];
        }
        return a;
    }
    // Multipliers of the wrench as it is given from those of the turned balance.
    Vec6 pull_back(const Vec6& a) const { return out_of_frame(solve_upper(a)); }
    Vec6 solve_upper(Vec6 a) const {
        for (int r = 5; r >= 0; --r) {
            for (int q = r + 1; q < 6; ++q) a[r] -= lower[q][r] * a[q];
            a[r] /= lower[r][r];
        }
        return a;
    }
    Vec6 out_of_frame(const Vec6& a) const {
        Vec6 out{};
        for (int q = 0; q < 6; ++q)
            for (int r = 0; r < 6; ++r) out[q] += frame[r][q] * a[r];
        return out;
    }
    // The largest number of the least-norm force of a turned wrench: a size that does not hang on units.
    double largest_of(const Vec6& turned) const {
        double most = 0.0;
        for (int i = 0; i < count; ++i)
            for (int a = 0; a < D; ++a) {
                double value = 0.0;
                for (int r = 0; r < 6; ++r) value += turn[r][i][a] * turned[r];
                most = std::abs(value) <= most ? most : std::abs(value);
            }
        return most;
    }
    // z -= Q^T a
    void subtract(Field& z, const Vec6& a) const {
        for (int r = 0; r < 6; ++r)
            for (int i = 0; i < count; ++i) add(z[i], -a[r], turn[r][i]);
    }
    Vec6 wrench_of(const Field& z) const {
        Vec6 out;
        for (int r = 0; r < 6; ++r) out[r] = product(balance[r], z);
        return out;
    }
    // What G z + w misses off z, by the least change; returns what is left. What is z's own rounding stays: where contacts are close to each
    // other its least change is far larger than it.
    double rebalance(Field& z, const Vec6& unit) const {
        double most = 0.0;
        for (int i = 0; i < count; ++i) most = std::max(most, z[i][0]);
        for (int pass = 0;; ++pass) {
            const Vec6 left = wrench_of(z) + unit;
            if (pass == 2 || grasp::size(left) <= LAST * most) return grasp::size(left);
            subtract(z, solve_lower(left));
        }
    }

    template <class R, int T> Rows<R, D, T> rows(int many, Criterion criterion = Criterion::sum) const {
        Rows<R, D, T> out;
        const auto turned = [](const Field& row) {
            std::vector<Tuple<R, D>> made(row.size());
            for (std::size_t i = 0; i < row.size(); ++i) made[i] = wide<R>(row[i]);
            return made;
        };
        for (int r = 0; r < 6; ++r) {
            Tuple<R, T> shared{};
            if constexpr (T == 2)
                for (int i = 0; i < count; ++i) shared[0] += inward(i, turn[r][i]);
            out.add_joint(turned(turn[r]), shared, -1);
        }
        int equations = 6;
        if constexpr (T == 2) {
            Field total(count);
            for (auto& z : total) z[0] = 1.0;
            out.add_joint(turned(total), {R(count), R(1.0)}, -1);
            equations = 7, out.doubtful = 6;
        }
        for (int k = 0; k < many; ++k) {
            int touched = 0, last = count;
            const Tuple<R, T> shared{};
            for (int i = 0; i < count; ++i)
                if (inner(limit[k][i], limit[k][i]) > 0.0) ++touched, last = i;
            if (touched > 1) out.add_joint(turned(limit[k]), shared, k);
            else out.add_own(last, last < count ? wide<R>(limit[k][last]) : Tuple<R, D>{}, shared, k);
        }
        if constexpr (T == 1)
            for (int i = 0; i < count; ++i) {  // normal <= t, or where t is an excess <= a bound to come
                Tuple<R, D> row{};
                row[0] = price[i];
                out.add_own(i, row, {R(criterion == Criterion::excess ? 0.0 : -1.0)}, -1);
            }
        if (T == 1 && criterion == Criterion::excess) {
            Tuple<R, T> above{};
            above[0] = -1.0;
            out.add_own(count, {}, above, -1);
        }
        if constexpr (T == 2) out.add_own(count, {}, {R(1.0), R(-1.0)}, -1);
        out.finish(count, equations);
        return out;
    }

    // What a row makes of it.
    double inward(int i, const Tuple<double, D>& row) const { return row[0] + (D == 4 && soft[i] ? row[D - 1] : 0.0); }

    // Slack of every cone, w and limit, less what rounding may cost.
    template <class Bound> void rooms(const Field& z, int many, std::vector<double>& out, Bound&& right) const {
        int next = 0;
        for (int i = 0; i < count; ++i) {
            out[next++] = slack(cone(z[i])) - PAD * z[i][0];
            if (D == 4 && soft[i]) out[next++] = z[i][D - 1] - PAD * z[i][0];
        }
        for (int k = 0; k < many; ++k) {
            double value = right(k), sizes = std::abs(value);
            for (int i = 0; i < count; ++i)
                for (int a = 0; a < D; ++a) {
                    const double part = limit[k][i][a] * z[i][a];
                    value -= part, sizes += std::abs(part);
                }
            out[next++] = value - PAD * sizes;
        }
        std::fill(out.begin() + next, out.end(), infinity);
    }

private:
    static constexpr double PAD = 6e-16;  // of the numbers that make a slack: what rounding may cost on the way to forces
    static constexpr double LAST = 4e-16;  // of the largest normal force: what rounding it may cost balance

    // G = L Q by Gram and Schmidt, twice.
    void orthonormalise() {
        turn = balance;
        for (int r = 0; r < 6; ++r) {
            for (int pass = 0; pass < 2; ++pass)
                for (int q = 0; q < r; ++q) {
                    const double along = product(turn[r], turn[q]);
                    lower[r][q] += along;
                    for (int i = 0; i < count; ++i) add(turn[r][i], -along, turn[q][i]);
                }
            lower[r][r] = std::sqrt(product(turn[r], turn[r]));
            for (auto& z : turn[r])
                for (double& value : z) value /= lower[r][r];
        }
    }
    template <class R, int T> InteriorPoint<R, D, T> engine(int many, Criterion criterion) const {
        InteriorPoint<R, D, T> made(rows<R, T>(many, criterion), soft);
        if constexpr (T == 1) made.shared_cost = {R(1.0)};
        if constexpr (T == 2) made.shared_cost = {R(-1.0), R(0.0)};
        if constexpr (T == 0)
            for (int i = 0; i < count; ++i) made.cost[i][0] = price[i];
        return made;
    }
};

}  // namespace detail
}  // namespace grasp
