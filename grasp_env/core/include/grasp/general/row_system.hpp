// The linear system of the general program and of Newton on Phi with further limits. A row that
// acts on one contact is a rank-one term of that contact's block. The factored system holds
// balance, the rows that couple contacts, and the T shared variables.
#pragma once
#include <grasp/general/rows.hpp>

namespace grasp {

// e + F^T C^T dy = f.z,   g^T dy = f.t,   C F e + g dt - diagonal dy = f.rows         (dy: own and
// joint rows alike)
template <class R, int D, int T> class RowSystem {
 public:
  ArenaVector<Shape<R, D>> shapes;              // (N,)
  ArenaVector<R> own_diagonal, joint_diagonal;  // >= 0; own > 0

  explicit RowSystem(const Rows<R, D, T>& rows)
      : shapes(rows.count),
        own_diagonal(rows.own.size()),
        joint_diagonal(rows.joint),
        own_(rows.own.size()),
        blocks_(rows.count),
        turned_(rows.count * rows.joint),
        reduced_(rows.count * rows.joint),
        schur_(rows.joint * (rows.joint + 1) / 2),
        y_(rows.joint),
        coupled_(rows.joint),
        solved_(rows.joint) {}
  static std::size_t bytes_needed(int count, int joints, int owns) {
    return Arena::bytes_needed<Shape<R, D>>(count) + Arena::bytes_needed<R>(owns) +
           Arena::bytes_needed<R>(joints) + Arena::bytes_needed<Own>(owns) +
           Arena::bytes_needed<Block>(count) +
           2 * Arena::bytes_needed<Tuple<R, D>>(count * joints) +
           Arena::bytes_needed<R>(std::size_t(joints) * (joints + 1) / 2) +
           Arena::bytes_needed<R>(joints) + 2 * Arena::bytes_needed<Tuple<R, T>>(joints);
  }

  // Factor. Return false if the system is not positive definite in floating point.
  bool factor(const Rows<R, D, T>& rows) {
    return sized<R>(int(rows.lead.size()), [&](auto leads) { return factor(rows, leads); });
  }
  void solve(const Rows<R, D, T>& rows, const Space<R, D, T>& f, Space<R, D, T>& out) {
    sized<R>(int(rows.lead.size()), [&](auto leads) { solve(rows, leads, f, out); });
  }
  // left = f - (the system times x); returns the largest component of rows and t.
  R missed(const Rows<R, D, T>& rows, const Space<R, D, T>& f, const Space<R, D, T>& x,
           Space<R, D, T>& left) const {
    return sized<R>(rows.joint, [&](auto joint) { return missed(rows, joint, f, x, left); });
  }

 private:
  template <class J> bool factor(const Rows<R, D, T>& rows, const J leads) {
    std::fill(schur_.begin(), schur_.end(), 0.0);
    for (int q = 0; q < leads; ++q) {
      const int r = rows.lead[q];
      schur_[at(q, q)] = rows.paired(r)
                             ? 1.0 / (1.0 / joint_diagonal[r] + 1.0 / joint_diagonal[r + 1])
                             : joint_diagonal[r];
      coupled_[q] = rows.coupling[r];
    }
    for (auto& row : corner_) row = {};
    for (int i = 0; i < rows.count; ++i) {
      Block& block = blocks_[i];
      block = Block();
      rows.each_own(i, [&](int k, bool paired) {
        const R weight =
            paired ? 1.0 / own_diagonal[k] + 1.0 / own_diagonal[k + 1] : 1.0 / own_diagonal[k];
        own_[k] = block.update(shapes[i].transposed(rows.own[k].row), rows.own[k].shared, weight);
        add_corner(own_[k].weight, own_[k].shared);
      });
      block.finish();
      Tuple<R, D>* reduced = reduced_.data() + leads * i;
      Tuple<R, D>* turned = turned_.data() + leads * i;
      const Tuple<R, D>* columns = rows.columns.data() + rows.joint * i;
      for (int r = 0; r < leads; ++r) {
        const Tuple<R, D> a = reduced[r] =
            block.forward(turned[r] = shapes[i].transposed(columns[rows.lead[r]]));
        Tuple<R, D> scaled;
        for (int j = 0; j < D; ++j) scaled[j] = a[j] * block.inverse[j];
        for (int q = 0; q <= r; ++q) schur_[at(r, q)] += inner(scaled, reduced[q]);
        for (int k = 0; k < T; ++k)
          for (int j = 0; j < D; ++j) coupled_[r][k] -= a[j] * block.l[D + k][j];
      }
    }
    for (int k = rows.first[rows.count]; k < int(rows.own.size()); ++k)
      add_corner(1.0 / own_diagonal[k], rows.own[k].shared);
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

  template <class J> void solve(const Rows<R, D, T>& rows, const J leads, const Space<R, D, T>& f,
                                Space<R, D, T>& out) {
    Tuple<R, T> shared = f.t;
    auto& y = y_;
    for (int q = 0; q < leads; ++q) {
      const int r = rows.lead[q];
      y[q] = rows.paired(r)
                 ? both(joint_diagonal[r], joint_diagonal[r + 1], f.joint[r], f.joint[r + 1])
                 : f.joint[r];
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
      if constexpr (T == 2) {
        shared[1] -= corner_[1][0] * shared[0];
        shared[1] /= corner_[1][1];
      }
      if constexpr (T == 2)
        shared[0] = (shared[0] - corner_[0][1] * shared[1]) / corner_[0][0];
      else
        shared[0] /= corner_[0][0];
    }
    out.t = shared;
    for (int q = 0; q < leads; ++q) {
      y[q] = inner(solved_[q], shared) - y[q];
      const int r = rows.lead[q];
      out.joint[r] = y[q];
      if (!rows.paired(r)) continue;
      const R up = joint_diagonal[r];
      const R down = joint_diagonal[r + 1];
      part(up, down, f.joint[r], f.joint[r + 1], y[q] / (1.0 / up + 1.0 / down), &out.joint[r]);
    }
    for (int i = 0; i < rows.count; ++i) {
      const Block& block = blocks_[i];
      Tuple<R, D>& e = out.z[i];
      Tuple<R, D> rest{};
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
        if (rows.paired(i, k))
          part(own_diagonal[k], own_diagonal[k + 1], f.own[k], f.own[k + 1], left, &out.own[k]);
        else
          out.own[k] = left / own_diagonal[k];
      }
    }
    for (int k = rows.first[rows.count]; k < int(rows.own.size()); ++k)
      out.own[k] = (inner(rows.own[k].shared, shared) - f.own[k]) / own_diagonal[k];
  }

  template <class J> R missed(const Rows<R, D, T>& rows, const J joint, const Space<R, D, T>& f,
                              const Space<R, D, T>& x, Space<R, D, T>& left) const {
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
        left.joint[r] -= inner(row, dz);
        add(pull, x.joint[r], row);
      }
      rows.each_own(i, [&](int k, bool paired) {
        const R along = inner(rows.own[k].row, dz);
        left.own[k] -= along;
        if (paired) left.own[k + 1] += along;
        add(pull, rows.pulled(x.own, k, paired), rows.own[k].row);
      });
      add(left.z[i], R(-1.0), x.z[i]);
      add(left.z[i], R(-1.0), shapes[i].transposed(pull));
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

  // fraction of a pivot that rounding may cause
  static constexpr double LOST = std::is_same_v<R, double> ? 1e-15 : 1e-30;
  // keeps the pivot of the doubtful equation from zero; refinement removes its effect
  static constexpr double DOUBT = 1e-9;
  using Own = RowUpdate<R, D, T>;
  using Block = RowBlock<R, D, T>;
  ArenaVector<Own> own_;
  ArenaVector<Block> blocks_;
  // leading joint rows (N, leads) in the blocks' coordinates, and L^-1 of them
  ArenaVector<Tuple<R, D>> turned_, reduced_;
  // factored Schur complement of the leading joint rows: L below, 1 / D on the diagonal
  ArenaVector<R> schur_;
  ArenaVector<R> y_;  // multipliers of the leading joint rows
  ArenaVector<Tuple<R, T>> coupled_, solved_;
  std::array<Tuple<R, T>, T> corner_;

  // Right-hand side of two rows that mirror each other, as one row of weight 1 / up + 1 / down.
  static R both(const R& up, const R& down, const R& first, const R& second) {
    const R per = 1.0 / (up + down);
    return down * per * first - up * per * second;  // slacks may be large, so no product of two
  }
  R right(const Space<R, D, T>& f, int k, bool paired) const {
    return paired ? both(own_diagonal[k], own_diagonal[k + 1], f.own[k], f.own[k + 1]) : f.own[k];
  }
  // Their multipliers from the remainder of that row. The smaller one comes from its own row, the
  // other from their difference: for an active limit nothing cancels.
  static void part(const R& up, const R& down, const R& first, const R& second, const R& left,
                   R* y) {
    const R along = left + both(up, down, first, second);
    const R net = left / up + left / down;
    if (down > up) {
      y[1] = -(along + second) / down;
      y[0] = net + y[1];
    } else {
      y[0] = (along - first) / up;
      y[1] = y[0] - net;
    }
  }
  void add_corner(const R& weight, const Tuple<R, T>& shared) {
    for (int a = 0; a < T; ++a) add(corner_[a], weight * shared[a], shared);
  }
  static int at(int r, int q) { return r * (r + 1) / 2 + q; }

  template <class J> bool factor_schur(const J size) {
    for (int j = 0; j < size; ++j) {
      R* row = schur_.data() + at(j, 0);
      R d = row[j];
      if (double(d) == 0.0) d = 1.0;  // an equation without coefficients, which holds as it is
      const R least = LOST * d;
      for (int k = 0; k < j; ++k) {
        const R* other = schur_.data() + at(k, 0);
        R c = row[k];
        for (int m = 0; m < k; ++m)
          c -= row[m] * other[m];  // row[m] = L_jm D_m until the row is finished
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
  template <class J> void schur_solve(const J size, ArenaVector<R>& b) const {
    eliminate(size, [&](int j) -> R& { return b[j]; });
  }
  template <class J> void schur_solve(const J size, ArenaVector<Tuple<R, T>>& b, int k) const {
    eliminate(size, [&](int j) -> R& { return b[j][k]; });
  }
};

}  // namespace grasp
