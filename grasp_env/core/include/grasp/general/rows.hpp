// Rows of the general program and of Newton on Phi with further limits: equations and limits on one
// contact or several.
#pragma once
#include <algorithm>
#include <span>
#include <grasp/math/arena.hpp>
#include <grasp/math/row_block.hpp>
#include <grasp/math/vec.hpp>

namespace grasp {

// Of Tuple<R, K>; R: double, or `DoubleDouble` if that has too few digits.
template <class R, std::size_t K>
inline void add(std::array<R, K>& to, const R& k, const std::array<R, K>& a) {
  for (std::size_t j = 0; j < K; ++j) to[j] += k * a[j];
}
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

// Call f(joint) with the number of joint rows: a constant for the six of balance in doubles, so
// that loops unroll.
template <class R, class F> [[gnu::always_inline]] inline auto sized(int joint, F&& f) {
  if constexpr (std::is_same_v<R, double>)
    if (joint == 6) return f(std::integral_constant<int, 6>());
  return f(joint);
}

// F with dz = F e: coordinates in which a block is the identity before its rows are added.
template <class R, int D> struct Shape {
  R a[D][D];

  Tuple<R, D> operator*(const Tuple<R, D>& e) const {
    Tuple<R, D> out;
    for (int r = 0; r < D; ++r) out[r] = product(e, [&](int k) { return a[r][k]; });
    return out;
  }
  Tuple<R, D> transposed(const Tuple<R, D>& z) const {
    Tuple<R, D> out;
    for (int c = 0; c < D; ++c) out[c] = product(z, [&](int k) { return a[k][c]; });
    return out;
  }

 private:
  template <class F> static R product(const Tuple<R, D>& e, F&& entry) {
    R total = entry(0) * e[0] + entry(1) * e[1] + entry(2) * e[2];
    if constexpr (D == 4) total += entry(3) * e[3];
    return total;
  }
};

// sum_i C_i z_i + g t = right (the first `equal` joint rows) or <= right (the other joint rows, and
// every row of one contact).
template <class R, int D, int T> struct Rows {
  struct Own {
    int contact;
    Tuple<R, D> row;
    Tuple<R, T> shared;
    R right;
    int label;
    bool mirrored = false;  // the negative of the row before it: a torque's other limit
  };
  int count, joint, equal;
  int doubtful = -1;  // an equation that may be independent of the others only through t
  ArenaVector<Tuple<R, D>> columns;   // (N, joint) coefficients of the joint rows, by contact
  ArenaVector<Tuple<R, T>> coupling;  // (joint,)
  ArenaVector<R> right;               // (joint,)
  ArenaVector<Own> own;               // by contact; those of no contact (only t) last
  ArenaVector<int> first;             // (N + 2,) own[first[i]] is the first of contact i
  ArenaVector<int> label;             // (joint,) label of a joint row; -1: an equation
  ArenaVector<int> lead;              // the joint rows that are not `mirrored`
  ArenaVector<char> mirrored;         // (joint + 1,) as for own rows

  // joints, owns: numbers of rows to be added
  Rows(int contacts, int equations, int joints, int owns)
      : count(contacts),
        joint(joints),
        equal(equations),
        columns(contacts * joints),
        coupling(joints),
        right(joints),
        first(contacts + 2),
        label(joints),
        mirrored(joints + 1) {
    own.reserve(owns);
    lead.reserve(joints);
  }
  // Add a joint row; the equations come first.
  template <class Row> void add_joint(const Row& row, const Tuple<R, T>& shared, int name) {
    for (int i = 0; i < count; ++i) columns[joint * i + added_] = wide<R>(row[i]);
    coupling[added_] = shared;
    label[added_] = name;
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
        const Own& row = own[k];
        const Own& before = own[k - 1];
        own[k].mirrored = row.contact == before.contact && row.contact < count &&
                          !before.mirrored && mirror(row.row, before.row);
      }
      for (int r = equal + 1; r < joint; ++r) {
        bool all = !mirrored[r - 1];
        for (int i = 0; i < count; ++i)
          all = all && mirror(columns[joint * i + r], columns[joint * i + r - 1]);
        mirrored[r] = all;
      }
    }
    lead.clear();
    for (int r = 0; r < joint; ++r)
      if (!mirrored[r]) lead.push_back(r);
  }
  // True if row k of contact i, or joint row r, and the row after it mirror each other.
  bool paired(int i, int k) const { return T == 0 && k + 1 < first[i + 1] && own[k + 1].mirrored; }
  bool paired(int r) const { return T == 0 && mirrored[r + 1]; }
  // Call f(k, paired) for the rows of contact i, once for two that mirror each other.
  template <class F> void each_own(int i, F&& f) const {
    for (int k = first[i]; k < first[i + 1]; ++k) {
      const bool both = paired(i, k);
      f(k, both);
      k += both;
    }
  }
  // Force that the multipliers of row k, and of its mirror image, exert along the row.
  static R pulled(const ArenaVector<R>& multipliers, int k, bool paired) {
    return paired ? multipliers[k] - multipliers[k + 1] : multipliers[k];
  }
  static std::size_t bytes_needed(int count, int joints, int owns) {
    return Arena::bytes_needed<Tuple<R, D>>(count * joints) +
           Arena::bytes_needed<Tuple<R, T>>(joints) + Arena::bytes_needed<R>(joints) +
           Arena::bytes_needed<Own>(owns) + Arena::bytes_needed<int>(count + 2) +
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
  ArenaVector<Tuple<R, D>> z;  // (N,)
  ArenaVector<R> own, joint;   // multipliers or residuals of rows
  Tuple<R, T> t{};

  explicit Space(const Rows<R, D, T>& rows)
      : z(rows.count), own(rows.own.size()), joint(rows.joint) {}
  static std::size_t bytes_needed(int count, int joints, int owns) {
    return Arena::bytes_needed<Tuple<R, D>>(count) + Arena::bytes_needed<R>(joints) +
           Arena::bytes_needed<R>(owns);
  }
  void add(const Space& other) {
    for (std::size_t i = 0; i < z.size(); ++i) grasp::add(z[i], R(1.0), other.z[i]);
    for (std::size_t k = 0; k < own.size(); ++k) own[k] += other.own[k];
    for (std::size_t r = 0; r < joint.size(); ++r) joint[r] += other.joint[r];
    grasp::add(t, R(1.0), other.t);
  }
};

}  // namespace grasp
