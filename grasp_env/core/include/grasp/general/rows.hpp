// The linear system of the general program and of Newton on Phi with further limits. A row that acts on one contact (its torsion
// bound, normal force, or the torque of a joint of its own finger) is a rank-one term of that contact's block. The factored system
// holds balance, the rows that couple contacts, and the T shared variables.
//
// Rows and their system stay together: the factorisation relies on the order in which rows are added.
#pragma once
#include <algorithm>
#include <span>
#include <grasp/math/arena.hpp>
#include <grasp/math/vec3.hpp>

namespace grasp {

// R is a number: double, or `Twice` if that has too few digits.
template <class R, int K> using Tuple = std::array<R, K>;
template <class R, std::size_t K> inline R inner(const std::array<R, K>& a, const std::array<R, K>& b) {
    R total = 0.0;
    for (std::size_t k = 0; k < K; ++k) total += a[k] * b[k];
    return total;
}
template <class R, std::size_t K> inline void add(std::array<R, K>& to, const R& k, const std::array<R, K>& a) {
    for (std::size_t j = 0; j < K; ++j) to[j] += k * a[j];
}
// Conversion between number types.
template <class R, std::size_t K> inline std::array<R, K> wide(const std::array<double, K>& a) {
    std::array<R, K> out;
    for (std::size_t j = 0; j < K; ++j) out[j] = a[j];
    return out;
}
template <class R, std::size_t K> inline std::array<double, K> narrow(const std::array<R, K>& a) {
    std::array<double, K> out;
    for (std::size_t j = 0; j < K; ++j) out[j] = double(a[j]);
    return out;
}
// Keep the larger of two values, or nan.
template <class R> inline void keep_largest(R& most, const R& value) {
    if (!(value <= most)) most = value;
}

// Call f(joint) with the number of joint rows: a constant for the six of balance alone, so that loops over them unroll.
template <class F> [[gnu::always_inline]] inline auto sized(int joint, F&& f) {
    return joint == 6 ? f(std::integral_constant<int, 6>()) : f(joint);
}

// A contact's variables (u, o, t) or, for D = 4, (u, o, t, w) with w = u - |torsion| in units of its limit.
template <class R, std::size_t D> inline Vec3<R> cone(const std::array<R, D>& z) { return {z[0], z[1], z[2]}; }

// F with dz = F e: coordinates in which a block is the identity before its rows are added.
template <class R, int D> struct Shape {
    R a[3][3];
    R line = 1.0;  // factor of w

    Tuple<R, D> operator*(const Tuple<R, D>& e) const {
        Tuple<R, D> out;
        for (int r = 0; r < 3; ++r) out[r] = a[r][0] * e[0] + a[r][1] * e[1] + a[r][2] * e[2];
        if constexpr (D == 4) out[3] = line * e[3];
        return out;
    }
    Tuple<R, D> transposed(const Tuple<R, D>& z) const {
        Tuple<R, D> out;
        for (int c = 0; c < 3; ++c) out[c] = a[0][c] * z[0] + a[1][c] * z[1] + a[2][c] * z[2];
        if constexpr (D == 4) out[3] = line * z[3];
        return out;
    }
};

// sum_i C_i z_i + g t = right (the first `equal` joint rows) or <= right (the other joint rows, and every row of one contact).
template <class R, int D, int T> struct Rows {
    struct Own {
        int contact;
        Tuple<R, D> row;
        Tuple<R, T> shared;
        R right;
        int label;
        bool mirrored = false;  // the negative of the row before it: the other limit of a torque
    };
    int count, joint, equal;
    int doubtful = -1;  // an equation that may be independent of the others only through t
    Kept<Tuple<R, D>> columns;  // (N, joint) coefficients of the joint rows, by contact
    Kept<Tuple<R, T>> coupling;  // (joint,)
    Kept<R> right;  // (joint,)
    Kept<Own> own;  // by contact; those of no contact (only t) last
    Kept<int> first;  // (N + 2,) own[first[i]] is the first of contact i
    Kept<int> label;  // (joint,) label of a joint row; -1: an equation
    Kept<int> lead;  // the joint rows that are not `mirrored`
    Kept<char> mirrored;  // (joint + 1,) true if it is the negative of the row before it: the other limit of a torque

    // joints, owns: number of rows that will be added
    Rows(int contacts, int equations, int joints, int owns)
        : count(contacts), joint(joints), equal(equations), columns(contacts * joints), coupling(joints), right(joints),
          first(contacts + 2), label(joints), mirrored(joints + 1) {
        own.reserve(owns), lead.reserve(joints);
    }
    // Add a joint row; the equations come first.
    template <class Row> void add_joint(const Row& row, const Tuple<R, T>& shared, int name) {
        for (int i = 0; i < count; ++i) columns[joint * i + added_] = wide<R>(row[i]);
        coupling[added_] = shared, label[added_] = name;
        ++added_;
    }
    // Add rows in the order of contacts; N: no contact.
    void add_own(int contact, const Tuple<R, D>& row, const Tuple<R, T>& shared, int name) {
        own.push_back({contact, row, shared, 0.0, name});
    }
    void finish() {
        std::fill(first.begin(), first.end(), int(own.size()));
        for (int k = int(own.size()) - 1; k >= 0; --k) first[own[k].contact] = k;
        for (int i = count; i >= 0; --i) first[i] = std::min(first[i], first[i + 1]);
        if constexpr (T == 0) {
            for (std::size_t k = 1; k < own.size(); ++k) {
                const Own &row = own[k], &before = own[k - 1];
                own[k].mirrored =
                    row.contact == before.contact && row.contact < count && !before.mirrored && mirror(row.row, before.row);
            }
            for (int r = equal + 1; r < joint; ++r) {
                bool all = !mirrored[r - 1];
                for (int i = 0; i < count; ++i) all = all && mirror(columns[joint * i + r], columns[joint * i + r - 1]);
                mirrored[r] = all;
            }
        }
        lead.clear();
        for (int r = 0; r < joint; ++r)
            if (!mirrored[r]) lead.push_back(r);
    }
    // True if row k of contact i and the row after it mirror each other.
    bool paired(int i, int k) const { return T == 0 && k + 1 < first[i + 1] && own[k + 1].mirrored; }
    // The same for joint row r.
    bool paired(int r) const { return T == 0 && mirrored[r + 1]; }
    // Call f(k, paired) for the rows of contact i, once for two that mirror each other.
    template <class F> void each_own(int i, F&& f) const {
        for (int k = first[i]; k < first[i + 1]; ++k) {
            const bool both = paired(i, k);
            f(k, both);
            k += both;
        }
    }
    // Force that the multipliers of row k, or of it and its mirror image, exert along the row.
    static R pulled(const Kept<R>& multipliers, int k, bool paired) {
        return paired ? multipliers[k] - multipliers[k + 1] : multipliers[k];
    }
    static std::size_t bytes_needed(int count, int joints, int owns) {
        return Arena::bytes_needed<Tuple<R, D>>(count * joints) + Arena::bytes_needed<Tuple<R, T>>(joints) +
               Arena::bytes_needed<R>(joints) + Arena::bytes_needed<Own>(owns) + Arena::bytes_needed<int>(count + 2) +
               2 * Arena::bytes_needed<int>(joints) + Arena::bytes_needed<char>(joints + 1);
    }

private:
    int added_ = 0;

    static bool mirror(const Tuple<R, D>& a, const Tuple<R, D>& b) {
        bool all = true;
        for (int k = 0; k < D; ++k) all = all && double(a[k]) == -double(b[k]);
        return all;
    }
};

// A point of the program's space, a direction or a right-hand side.
template <class R, int D, int T> struct Space {
    Kept<Tuple<R, D>> z;  // (N,)
    Kept<R> own, joint;  // multipliers or residuals of rows
    Tuple<R, T> t{};

    explicit Space(const Rows<R, D, T>& rows) : z(rows.count), own(rows.own.size()), joint(rows.joint) {}
    static std::size_t bytes_needed(int count, int joints, int owns) {
        return Arena::bytes_needed<Tuple<R, D>>(count) + Arena::bytes_needed<R>(joints) + Arena::bytes_needed<R>(owns);
    }
    void add(const Space& other) {
        for (std::size_t i = 0; i < z.size(); ++i) grasp::add(z[i], R(1.0), other.z[i]);
        for (std::size_t k = 0; k < own.size(); ++k) own[k] += other.own[k];
        for (std::size_t r = 0; r < joint.size(); ++r) joint[r] += other.joint[r];
        grasp::add(t, R(1.0), other.t);
    }
};

// e + F^T C^T dy = f.z,   g^T dy = f.t,   C F e + g dt - diagonal dy = f.rows         (dy: own and joint rows alike)
template <class R, int D, int T> class RowSystem {
public:
    Kept<Shape<R, D>> shapes;  // (N,)
    Kept<R> own_diagonal, joint_diagonal;  // >= 0; own > 0

    explicit RowSystem(const Rows<R, D, T>& rows)
        : shapes(rows.count), own_diagonal(rows.own.size()), joint_diagonal(rows.joint), own_(rows.own.size()),
          blocks_(rows.count), turned_(rows.count * rows.joint), reduced_(rows.count * rows.joint),
          schur_(rows.joint * (rows.joint + 1) / 2), y_(rows.joint), coupled_(rows.joint), solved_(rows.joint) {}
    static std::size_t bytes_needed(int count, int joints, int owns) {
        return Arena::bytes_needed<Shape<R, D>>(count) + Arena::bytes_needed<R>(owns) + Arena::bytes_needed<R>(joints) +
               Arena::bytes_needed<Own>(owns) + Arena::bytes_needed<Block>(count) +
               2 * Arena::bytes_needed<Tuple<R, D>>(count * joints) +
               Arena::bytes_needed<R>(std::size_t(joints) * (joints + 1) / 2) + Arena::bytes_needed<R>(joints) +
               2 * Arena::bytes_needed<Tuple<R, T>>(joints);
    }

    // Factor. Return false if the system is not positive definite in floating point.
    bool factor(const Rows<R, D, T>& rows) {
        return sized(int(rows.lead.size()), [&](auto leads) { return factor(rows, leads); });
    }
    void solve(const Rows<R, D, T>& rows, const Space<R, D, T>& f, Space<R, D, T>& out) {
        sized(int(rows.lead.size()), [&](auto leads) { solve(rows, leads, f, out); });
    }
    // left = f - (the system times x); returns the largest component of rows and t.
    R missed(const Rows<R, D, T>& rows, const Space<R, D, T>& f, const Space<R, D, T>& x, Space<R, D, T>& left) const {
        return sized(rows.joint, [&](auto joint) { return missed(rows, joint, f, x, left); });
    }

private:
    template <class J> bool factor(const Rows<R, D, T>& rows, const J leads) {
        std::fill(schur_.begin(), schur_.end(), 0.0);
        for (int q = 0; q < leads; ++q) {
            const int r = rows.lead[q];
            schur_[at(q, q)] = rows.paired(r) ? 1.0 / (1.0 / joint_diagonal[r] + 1.0 / joint_diagonal[r + 1]) : joint_diagonal[r];
            coupled_[q] = rows.coupling[r];
        }
        for (auto& row : corner_) row = {};
        for (int i = 0; i < rows.count; ++i) {
            Block& block = blocks_[i];
            block = Block();
            rows.each_own(i, [&](int k, bool paired) {
                const R weight = paired ? 1.0 / own_diagonal[k] + 1.0 / own_diagonal[k + 1] : 1.0 / own_diagonal[k];
                own_[k] = block.update(shapes[i].transposed(rows.own[k].row), rows.own[k].shared, weight);
                add_corner(own_[k].weight, own_[k].shared);
            });
            for (int j = 0; j < D; ++j) block.inverse[j] = 1.0 / block.d[j];
            Tuple<R, D>*reduced = reduced_.data() + leads * i, *turned = turned_.data() + leads * i;
            const Tuple<R, D>* columns = rows.columns.data() + rows.joint * i;
            for (int r = 0; r < leads; ++r) {
                const Tuple<R, D> a = reduced[r] = block.forward(turned[r] = shapes[i].transposed(columns[rows.lead[r]]));
                Tuple<R, D> scaled;
                for (int j = 0; j < D; ++j) scaled[j] = a[j] * block.inverse[j];
                for (int q = 0; q <= r; ++q) schur_[at(r, q)] += inner(scaled, reduced[q]);
                for (int k = 0; k < T; ++k)
                    for (int j = 0; j < D; ++j) coupled_[r][k] -= a[j] * block.l[D + k][j];
            }
        }
        for (int k = rows.first[rows.count]; k < int(rows.own.size()); ++k) add_corner(1.0 / own_diagonal[k], rows.own[k].shared);
        if (rows.doubtful >= 0) schur_[at(rows.doubtful, rows.doubtful)] *= 1.0 + DOUBT;
        if (!factor_schur(leads)) return false;
        solved_ = coupled_;
        if constexpr (T > 0) {
            for (int k = 0; k < T; ++k) schur_solve(leads, solved_, k);
            for (int a = 0; a < T; ++a)
                for (int b = 0; b < T; ++b)
                    for (int r = 0; r < leads; ++r) corner_[a][b] += coupled_[r][a] * solved_[r][b];
            if (!(corner_[0][0] > 0.0)) return false;
            if constexpr (T == 2) {
                corner_[1][0] /= corner_[0][0];
                corner_[1][1] -= corner_[1][0] * corner_[0][1];
                if (!(corner_[1][1] > 0.0)) return false;
            }
        }
        return true;
    }

    template <class J> void solve(const Rows<R, D, T>& rows, const J leads, const Space<R, D, T>& f, Space<R, D, T>& out) {
        Tuple<R, T> shared = f.t;
        auto& y = y_;
        for (int q = 0; q < leads; ++q) {
            const int r = rows.lead[q];
            y[q] = rows.paired(r) ? both(joint_diagonal[r], joint_diagonal[r + 1], f.joint[r], f.joint[r + 1]) : f.joint[r];
        }
        for (int i = 0; i < rows.count; ++i) {
            Tuple<R, D> b = f.z[i];
            rows.each_own(i, [&](int k, bool paired) {
                add(shared, own_[k].weight * own_[k].forward(b, right(f, k, paired)), own_[k].shared);
            });
            for (int r = 0; r < leads; ++r) y[r] -= inner(reduced_[leads * i + r], b);
        }
        for (int k = rows.first[rows.count]; k < int(rows.own.size()); ++k)
            add(shared, f.own[k] / own_diagonal[k], rows.own[k].shared);
        schur_solve(leads, y);
        if constexpr (T > 0) {
            for (int r = 0; r < leads; ++r) add(shared, y[r], coupled_[r]);
            if constexpr (T == 2) shared[1] -= corner_[1][0] * shared[0], shared[1] /= corner_[1][1];
            if constexpr (T == 2) shared[0] = (shared[0] - corner_[0][1] * shared[1]) / corner_[0][0];
            else shared[0] /= corner_[0][0];
        }
        out.t = shared;
        for (int q = 0; q < leads; ++q) {
            y[q] = inner(solved_[q], shared) - y[q];
            const int r = rows.lead[q];
            out.joint[r] = y[q];
            if (!rows.paired(r)) continue;
            const R up = joint_diagonal[r], down = joint_diagonal[r + 1];
            part(up, down, f.joint[r], f.joint[r + 1], y[q] / (1.0 / up + 1.0 / down), &out.joint[r]);
        }
        for (int i = 0; i < rows.count; ++i) {
            const Block& block = blocks_[i];
            Tuple<R, D>&e = out.z[i], rest{};
            e = f.z[i];
            for (int r = 0; r < leads; ++r) add(e, -y[r], turned_[leads * i + r]);
            rows.each_own(i, [&](int k, bool paired) {
                out.own[k] = inner(own_[k].shared, shared) - own_[k].forward(e, right(f, k, paired));
            });
            for (int j = 0; j < D; ++j)
                for (int k = 0; k < T; ++k) e[j] -= block.l[D + k][j] * shared[k];
            block.backward(e);
            for (int k = rows.first[i + 1] - 1; k >= rows.first[i]; --k) {
                if (T == 0 && rows.own[k].mirrored) continue;
                const R left = own_[k].backward(rest, out.own[k]);
                if (rows.paired(i, k)) part(own_diagonal[k], own_diagonal[k + 1], f.own[k], f.own[k + 1], left, &out.own[k]);
                else out.own[k] = left / own_diagonal[k];
            }
        }
        for (int k = rows.first[rows.count]; k < int(rows.own.size()); ++k)
            out.own[k] = (inner(rows.own[k].shared, shared) - f.own[k]) / own_diagonal[k];
    }

    template <class J> R missed(const Rows<R, D, T>& rows, const J joint, const Space<R, D, T>& f, const Space<R, D, T>& x,
                                Space<R, D, T>& left) const {
        left = f;
        for (int r = 0; r < joint; ++r) {
            left.joint[r] += joint_diagonal[r] * x.joint[r] - inner(rows.coupling[r], x.t);
            add(left.t, -x.joint[r], rows.coupling[r]);
        }
        for (int i = 0; i < rows.count; ++i) {
            const Tuple<R, D> dz = shapes[i] * x.z[i];
            Tuple<R, D> pull{};
            for (int r = 0; r < joint; ++r) {
                const Tuple<R, D>& row = rows.columns[joint * i + r];
                left.joint[r] -= inner(row, dz), add(pull, x.joint[r], row);
            }
            rows.each_own(i, [&](int k, bool paired) {
                const R along = inner(rows.own[k].row, dz);
                left.own[k] -= along;
                if (paired) left.own[k + 1] += along;
                add(pull, rows.pulled(x.own, k, paired), rows.own[k].row);
            });
            add(left.z[i], R(-1.0), x.z[i]), add(left.z[i], R(-1.0), shapes[i].transposed(pull));
        }
        for (int k = 0; k < int(rows.own.size()); ++k) {
            left.own[k] += own_diagonal[k] * x.own[k] - inner(rows.own[k].shared, x.t);
            add(left.t, -x.own[k], rows.own[k].shared);
        }
        R most = 0.0;
        for (const R& value : left.joint) keep_largest(most, abs(value));
        for (const R& value : left.own) keep_largest(most, abs(value));
        for (const R& value : left.t) keep_largest(most, abs(value));
        return most;
    }

    static constexpr int K = D + T;
    static constexpr double LOST = std::is_same_v<R, double> ? 1e-15 : 1e-30;  // fraction of a pivot that rounding may cause
    static constexpr double DOUBT = 1e-9;  // keeps the doubtful equation's pivot from zero; refinement removes its effect
    // A row as an update of its block's factor, column by column, and its effect on right-hand sides and solutions, without a
    // difference that cancels however large the row is.
    struct Own {
        Tuple<R, D> p, beta, ratio;  // entries of the row, its contribution to the block's row, and old over new pivot
        Tuple<R, T> shared;  // remainder for the shared variables, and its weight
        R weight;

        // b: D^-1 L^-1 of the block's right-hand side, without and then with this row's `right`. Return the remainder of `right`.
        R forward(Tuple<R, D>& b, R right) const {
#pragma GCC unroll 8
            for (int j = 0; j < D; ++j) right -= p[j] * b[j], b[j] += beta[j] * right;
            return right;
        }
        // row . e + shared . t - right, from its remainder. rest: residual of the block's rows with this row, and then without it.
        R backward(Tuple<R, D>& rest, R left) const {
#pragma GCC unroll 8
            for (int j = D - 1; j >= 0; --j) {
                const R before = left;
                left = ratio[j] * before + p[j] * rest[j];
                rest[j] -= beta[j] * before;
            }
            return left;
        }
    };
    // L diag(d) L^T of the identity plus the rows' rank-one terms, bordered by the shared variables.
    struct Block {
        R l[K][D] = {}, d[D], inverse[D];

        Block() {
            for (int j = 0; j < D; ++j) d[j] = 1.0;
        }
        Own update(const Tuple<R, D>& row, const Tuple<R, T>& shared, R weight) {
            Own own;
            R w[K];
            for (int j = 0; j < D; ++j) w[j] = row[j];
            for (int k = 0; k < T; ++k) w[D + k] = shared[k];
#pragma GCC unroll 8
            for (int j = 0; j < D; ++j) {
                const R p = w[j], more = d[j] + weight * p * p, per = R(1.0) / more;
                own.p[j] = p, own.beta[j] = weight * p * per, own.ratio[j] = d[j] * per;
                weight *= own.ratio[j], d[j] = more;
#pragma GCC unroll 8
                for (int r = j + 1; r < K; ++r) w[r] -= p * l[r][j], l[r][j] += own.beta[j] * w[r];
            }
            for (int k = 0; k < T; ++k) own.shared[k] = w[D + k];
            own.weight = weight;
            return own;
        }
        Tuple<R, D> forward(Tuple<R, D> b) const {
#pragma GCC unroll 8
            for (int j = 1; j < D; ++j)
#pragma GCC unroll 8
                for (int k = 0; k < j; ++k) b[j] -= l[j][k] * b[k];
            return b;
        }
        void backward(Tuple<R, D>& b) const {
#pragma GCC unroll 8
            for (int j = D - 2; j >= 0; --j)
#pragma GCC unroll 8
                for (int k = j + 1; k < D; ++k) b[j] -= l[k][j] * b[k];
        }
    };
    Kept<Own> own_;
    Kept<Block> blocks_;
    Kept<Tuple<R, D>> turned_, reduced_;  // leading joint rows (N, leads) in the blocks' coordinates, and L^-1 of them
    Kept<R> schur_;  // Schur complement of the leading joint rows, factored: L below, 1 / D on the diagonal
    Kept<R> y_;  // multipliers of the leading joint rows
    Kept<Tuple<R, T>> coupled_, solved_;
    std::array<Tuple<R, T>, T> corner_;

    // Right-hand side of two rows that mirror each other, as one row with the weight of both: 1 / up + 1 / down.
    static R both(const R& up, const R& down, const R& first, const R& second) {
        const R per = 1.0 / (up + down);
        return down * per * first - up * per * second;  // slacks may be large, so no product of two
    }
    R right(const Space<R, D, T>& f, int k, bool paired) const {
        return paired ? both(own_diagonal[k], own_diagonal[k + 1], f.own[k], f.own[k + 1]) : f.own[k];
    }
    // Their multipliers from the remainder of that row. The smaller one comes from its own row, the other from their difference:
    // for an active limit that is the remainder times a large weight, and no difference that cancels.
    static void part(const R& up, const R& down, const R& first, const R& second, const R& left, R* y) {
        const R along = left + both(up, down, first, second), net = left / up + left / down;
        if (down > up) y[1] = -(along + second) / down, y[0] = net + y[1];
        else y[0] = (along - first) / up, y[1] = y[0] - net;
    }
    void add_corner(const R& weight, const Tuple<R, T>& shared) {
        for (int a = 0; a < T; ++a) add(corner_[a], weight * shared[a], shared);
    }
    static int at(int r, int q) { return r * (r + 1) / 2 + q; }

    template <class J> bool factor_schur(const J size) {
        for (int j = 0; j < size; ++j) {
            R* row = schur_.data() + at(j, 0);
            R d = row[j];
            const R least = LOST * d;
            for (int k = 0; k < j; ++k) {
                const R* other = schur_.data() + at(k, 0);
                R c = row[k];
                for (int m = 0; m < k; ++m) c -= row[m] * other[m];  // row[m] = L_jm D_m until the row is finished
                row[k] = c;
            }
            for (int k = 0; k < j; ++k) {
                const R c = row[k];
                row[k] = c * schur_[at(k, k)];
                d -= c * row[k];
            }
            if (!(d > least)) d = least;
            if (!(d > 0.0)) return false;
            row[j] = 1.0 / d;
        }
        return true;
    }
    template <class J, class Load> void eliminate(const J size, Load&& b) const {
        for (int j = 1; j < size; ++j)
            for (int k = 0; k < j; ++k) b(j) -= schur_[at(j, k)] * b(k);
        for (int j = size - 1; j >= 0; --j) {
            b(j) *= schur_[at(j, j)];
            for (int k = j + 1; k < size; ++k) b(j) -= schur_[at(k, j)] * b(k);
        }
    }
    template <class J> void schur_solve(const J size, Kept<R>& b) const {
        eliminate(size, [&](int j) -> R& { return b[j]; });
    }
    template <class J> void schur_solve(const J size, Kept<Tuple<R, T>>& b, int k) const {
        eliminate(size, [&](int j) -> R& { return b[j][k]; });
    }
};

}  // namespace grasp
