// The constraints of a program: balance, cones, further rows; and their interior points.
//
// Contact i has z_i in its cone: (u, o, t), or (u, o, t, v) if some contacts are soft. Balance uses
// orthonormal rows, G = L Q, so contacts close to each other cost no digits. If contacts cannot
// make all wrenches, these rows are along the axes of their reach; the other rows of Q are zero.
#pragma once
#include <memory>
#include <grasp/conic/criterion.hpp>
#include <grasp/contacts/contacts.hpp>
#include <grasp/general/interior_point.hpp>
#include <grasp/phi/phi.hpp>

namespace grasp {

// The data of a program; arrays are row-major.
struct ProgramData {
  int count, limits;                  // N, M
  const double* frame;                // (6, 6) maps wrenches to the unit frame
  const double* balance;              // (6, N, 4) of (u, o, t, v), unit frame
  const double* rows;                 // (M, N, 4) of length one: rows . z <= bound
  const double* bound;                // (M,) [N]
  const Weights<double, 4>* weights;  // (N,)
  const double* divisor;  // (N, 4) force and torsion from z; inf: nothing is transmitted
  const double* shares;  // (M,) [N] growth of a bound if its limit grows by all of itself; 0: never
  bool elastic;          // the least excess may be requested
  WrenchSpace reach{};   // the wrenches that the contacts can make
  // (N,) [N] normal force in addition to z, which `Criterion::largest` counts; null: none
  const double* preload = nullptr;
  // for `Criterion::torque`: (J, N, 4) joint torques of z, and (J,) further torques [N m]
  int joints = 0;
  const double* torque = nullptr;
  const double* torque_bias = nullptr;
};

namespace detail {

// The smallest value, or nan.
inline double least_of(std::span<const double> values) {
  double least = infinity;
  for (double value : values) least = value >= least ? least : value;
  return least;
}

template <int D> struct Constraints {
  using Row = std::span<const Tuple<double, D>>;  // z, or its coefficients
  using Field = ArenaVector<Tuple<double, D>>;
  class Matrix {
   public:
    Matrix(std::size_t rows, std::size_t count) : numbers_(rows * count), count_(count) {}
    Row operator[](int r) const { return {numbers_.data() + count_ * r, count_}; }
    std::span<Tuple<double, D>> operator[](int r) { return {numbers_.data() + count_ * r, count_}; }

   private:
    Field numbers_;
    std::size_t count_;
  };
  int count, limits;  // N, M
  // normal force of a unit of u; the same, weighted; weighted preload
  ArenaVector<double> price, cost, offset, divisor, bound, shares;
  // (M,) the one contact that a row acts on; N: none, SEVERAL: more than one
  ArenaVector<int> owner;
  ArenaVector<int> own;         // rows that act on at most one contact, by contact
  Matrix balance, limit, turn;  // (6,) G, (M,), (6,) Q
  int joints;
  Matrix torque;                         // (J,) joint torques in units of `torque_unit`
  ArenaVector<double> bias;              // (J,) further torques, the same
  double torque_unit = 0.0;              // [m] of the largest row
  double frame[6][6], lower[6][6] = {};  // L
  WrenchSpace reach;

  explicit Constraints(const ProgramData& data)
      : count(data.count),
        limits(data.limits),
        price(count),
        cost(count),
        offset(count),
        divisor(data.divisor, data.divisor + 4 * count),
        bound(data.bound, data.bound + limits),
        shares(data.shares, data.shares + limits),
        owner(limits),
        own(limits),
        balance(6, count),
        limit(limits, count),
        turn(6, count),
        joints(data.joints),
        torque(joints, count),
        bias(data.torque_bias, data.torque_bias + joints),
        reach(data.reach) {
    std::copy(data.frame, data.frame + 36, &frame[0][0]);
    for (int i = 0; i < count; ++i) {
      price[i] = 1.0 / divisor[4 * i];
      cost[i] = data.weights[i].omega * price[i];
      offset[i] = data.preload ? data.weights[i].omega * data.preload[i] : 0.0;
    }
    const auto copy = [&](const double* from, int many, Matrix& to) {
      for (int k = 0; k < many; ++k)
        for (int i = 0; i < count; ++i, from += 4) std::copy(from, from + D, to[k][i].begin());
    };
    copy(data.balance, 6, balance);
    copy(data.rows, limits, limit);
    copy(data.torque, joints, torque);
    scale_torques();
    find_owners();
    orthonormalise();
  }
  static std::size_t bytes_needed(int count, int limits, int joints) {
    return Arena::bytes_needed<Tuple<double, D>>(std::size_t(joints) * count) +
           Arena::bytes_needed<double>(joints) + 3 * Arena::bytes_needed<double>(count) +
           Arena::bytes_needed<double>(4 * count) + 2 * Arena::bytes_needed<double>(limits) +
           2 * Arena::bytes_needed<int>(limits) +
           2 * Arena::bytes_needed<Tuple<double, D>>(6 * count) +
           Arena::bytes_needed<Tuple<double, D>>(std::size_t(limits) * count);
  }

  // Interior point for the first `many` limits. T = 0: least weighted sum of normal forces. T = 1:
  // least t above each weighted normal force or each excess. T = 2: largest depth m, with the share
  // r of the wrench.
  template <class R, int T>
  InteriorPoint<R, D, T> engine(int many, Criterion criterion = Criterion::sum) const {
    InteriorPoint<R, D, T> engine(rows<R, T>(many, criterion));
    if constexpr (T == 1) engine.shared_cost = {R(1.0)};
    if constexpr (T == 2) engine.shared_cost = {R(-1.0), R(0.0)};
    if constexpr (T == 0) {
      if (criterion == Criterion::torque)
        engine.cost[count + norm_cones() - 1][0] = 1.0;
      else
        for (int i = 0; i < count; ++i) engine.cost[i][0] = cost[i];
    }
    return engine;
  }
  // The norm of the torques is a tree of cones behind those of the contacts: each takes the next
  // SLOTS inputs as its tangential parts, first the torques, then the u of the cones before it. The
  // u of the last one is the norm.
  static constexpr int SLOTS = D - 1;
  static constexpr double FARTHEST = FARTHEST_FORCE;
  static int norm_cones(int joints) { return std::max(1, (joints + SLOTS - 3) / (SLOTS - 1)); }
  int norm_cones() const { return norm_cones(joints); }
  static int norm_equations(int joints) { return joints + norm_cones(joints) - 1; }
  int norm_equations() const { return norm_equations(joints); }
  // Torques in units of `torque_unit` [N]; size: [N] of a unit of z.
  double torque_at(int j, Row z, double size) const {
    return product(torque[j], z) + bias[j] / size;
  }
  double torque_norm(Row z, double size) const {
    double square = 0.0;
    for (int j = 0; j < joints; ++j) square += torque_at(j, z, size) * torque_at(j, z, size);
    return std::sqrt(square);
  }
  double largest_offset() const { return *std::max_element(offset.begin(), offset.end()); }
  // The direction into a cone.
  static Tuple<double, D> inwards() {
    Tuple<double, D> out{};
    out[0] = 1.0;
    return out;
  }
  // Storage for the results of `write_slacks`.
  ArenaVector<double> slacks() const { return ArenaVector<double>(count + limits); }
  static double product(Row a, Row b) {
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
  // The wrench that has these components in the unit frame.
  Vec6 out_of_unit(const Vec6& unit) const {
    Vec6 out = unit;
    for (int r = 3; r < 6; ++r) {
      for (int q = 0; q < 3; ++q) out[r] -= frame[r][q] * unit[q];
      out[r] /= frame[r][r];
    }
    return out;
  }
  // True if more than rounding of a wrench, unit frame, is out of reach.
  bool is_out_of_reach(const Vec6& unit) const {
    return !reach.full() && grasp::size(reach.beyond(unit)) > BOUNDARY * grasp::size(unit);
  }
  // Coordinates of a wrench in the unit frame along the rows of Q, without what is out of reach.
  Vec6 solve_lower(const Vec6& unit) const {
    Vec6 a = unit;
    if (!reach.full())
      for (int r = 0; r < 6; ++r) a[r] = r < reach.rank ? dot(reach.axes[r], unit) : 0.0;
    for (int r = 0; r < reach.rank; ++r) {
      for (int q = 0; q < r; ++q) a[r] -= lower[r][q] * a[q];
      a[r] /= lower[r][r];
    }
    return a;
  }
  // Multipliers of the given wrench from those of the orthonormal balance.
  Vec6 pull_back(const Vec6& a) const { return out_of_frame(solve_upper(a)); }
  // Multipliers of a wrench in the unit frame.
  Vec6 solve_upper(Vec6 a) const {
    for (int r = reach.rank - 1; r >= 0; --r) {
      for (int q = r + 1; q < reach.rank; ++q) a[r] -= lower[q][r] * a[q];
      a[r] /= lower[r][r];
    }
    if (reach.full()) return a;
    Vec6 out{};
    for (int r = 0; r < reach.rank; ++r) out = out + a[r] * reach.axes[r];
    return out;
  }
  Vec6 out_of_frame(const Vec6& a) const {
    Vec6 out{};
    for (int q = 0; q < 6; ++q)
      for (int r = 0; r < 6; ++r) out[q] += frame[r][q] * a[r];
    return out;
  }
  // Largest number of the least-norm force of an orthonormalised wrench, in any units.
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
  // True if the rows of balance within reach are independent beyond rounding.
  bool independent() const {
    double square = 0.0, inverse = 0.0;
    for (int r = 0; r < 6; ++r) {
      Vec6 unit{};
      unit[r] = 1.0;
      for (double value : solve_lower(unit)) inverse += value * value;
      for (int q = 0; q <= r; ++q) square += lower[r][q] * lower[r][q];
    }
    return square * inverse * RANK * RANK < 1.0;
  }
  // Remove the residual G z + w from z by the least-norm change; return what remains. The rounding
  // of z stays: if contacts are close together, removing it would change z far more.
  double rebalance(Field& z, const Vec6& unit) const {
    double most = 0.0;
    for (int i = 0; i < count; ++i) most = std::max(most, z[i][0]);
    for (int pass = 0;; ++pass) {
      const Vec6 left = wrench_of(z) + unit;
      if (pass == 2 || grasp::size(left) <= LAST * most) return grasp::size(left);
      subtract(z, solve_lower(left));
    }
  }

  template <class R, int T>
  Rows<R, D, T> rows(int many, Criterion criterion = Criterion::sum) const {
    const bool of_torques = T == 0 && criterion == Criterion::torque;
    const bool bounds_normals = T == 1 && criterion != Criterion::load;
    const int equations = T == 2 ? 7 : of_torques ? 6 + norm_equations() : 6;
    const int cones = of_torques ? count + norm_cones() : count;
    int joint_rows = equations;
    int owns = T == 2 ? 1 : bounds_normals ? count + (criterion == Criterion::excess) : 0;
    for (int k = 0; k < many; ++k) ++(owner[k] == SEVERAL ? joint_rows : owns);
    Rows<R, D, T> out(cones, equations, joint_rows, owns);
    Field wide_row(cones);  // a row of all contacts, and zeros for the cones of the norm
    const auto of_all = [&](Row row) -> const Field& {
      std::copy(row.begin(), row.end(), wide_row.begin());
      return wide_row;
    };
    for (int r = 0; r < 6; ++r) {
      Tuple<R, T> shared{};
      if constexpr (T == 2)
        for (int i = 0; i < count; ++i) shared[0] += turn[r][i][0];
      out.add_joint(of_all(turn[r]), shared, -1);
    }
    for (int k = 0; of_torques && k < norm_equations(); ++k) {
      Field row(cones);
      if (k < joints)
        std::copy(torque[k].begin(), torque[k].end(), row.begin());
      else
        row[count + k - joints][0] = 1.0;
      row[count + k / SLOTS][1 + k % SLOTS] = -1.0;
      out.add_joint(row, {}, -1);
    }
    if constexpr (T == 2) {
      Field total(count);
      for (auto& z : total) z[0] = 1.0;
      out.add_joint(total, {R(count), R(1.0)}, -1);
      out.doubtful = 6;
    }
    for (int k = 0; k < many; ++k)
      if (owner[k] == SEVERAL) out.add_joint(of_all(limit[k]), {}, k);
    for (int i = 0, next = 0; i <= count; ++i) {
      for (; next < int(own.size()) && owner[own[next]] == i; ++next)
        if (own[next] < many)
          out.add_own(i < count ? i : cones,
                      i < count ? wide<R>(limit[own[next]][i]) : Tuple<R, D>{}, {}, own[next]);
      if constexpr (T == 1)
        if (bounds_normals &&
            i < count) {  // normal <= t, or for an excess t, normal <= a bound set later
          Tuple<R, D> row{};
          row[0] = criterion == Criterion::excess ? price[i] : cost[i];
          out.add_own(i, row, {R(criterion == Criterion::excess ? 0.0 : -1.0)}, -1);
        }
    }
    if constexpr (T == 1)
      if (criterion == Criterion::excess) out.add_own(count, {}, {R(-1.0)}, -1);
    if constexpr (T == 2) out.add_own(count, {}, {R(1.0), R(-1.0)}, -1);
    out.finish();
    return out;
  }

  // Scaling of a limit whose bound is far above `size` [N]: the row's size is that of the bound.
  double row_scale(int k, double size) const {
    return 1.0 / std::max(1.0, std::abs(bound[k]) / size);
  }
  // Scale the coefficients of all limits among the rows of a program.
  template <class R, int T> void scale_rows(Rows<R, D, T>& rows, double size) const {
    const auto scaled = [&](Tuple<R, D>& to, int k, int i) {
      for (int a = 0; a < D; ++a) to[a] = row_scale(k, size) * limit[k][i][a];
    };
    for (int r = rows.equal; r < rows.joint; ++r)
      for (int i = 0; i < count; ++i) scaled(rows.columns[rows.joint * i + r], rows.label[r], i);
    for (auto& row : rows.own)
      if (row.label >= 0 && row.contact < count) scaled(row.row, row.label, row.contact);
  }
  // Write the multipliers of the limits at an iterate, each times `scale` of its limit.
  template <class R, int T, class F> void read_multipliers(const InteriorPoint<R, D, T>& engine,
                                                           ArenaVector<double>& to,
                                                           F&& scale) const {
    const auto& rows = engine.rows;
    const auto read = [&](int k, const R& multiplier) {
      to[k] = scale(k) * std::max(double(multiplier), 0.0);
    };
    for (std::size_t k = 0; k < rows.own.size(); ++k)
      if (rows.own[k].label >= 0) read(rows.own[k].label, engine.at.own[k]);
    for (int r = rows.equal; r < rows.joint; ++r) read(rows.label[r], engine.at.joint[r]);
  }
  // The part of a force inside, with slacks `inside`, that takes one with these slacks inside.
  static double part_inside(std::span<const double> slacks, std::span<const double> inside) {
    double part = 0.0;
    for (std::size_t k = 0; k < slacks.size(); ++k)
      if (slacks[k] < 0.0) part = std::max(part, -slacks[k] / (inside[k] - slacks[k]));
    return std::min(1.0, 1.01 * part);
  }

  // Slacks of cones and of limits, less an allowance for rounding.
  template <class Bound>
  void write_slacks(const Field& z, int many, ArenaVector<double>& out, Bound&& right) const {
    int next = 0;
    for (int i = 0; i < count; ++i) out[next++] = slack(cone(z[i])) - PAD * z[i][0];
    for (int k = 0; k < many; ++k) {
      double value = right(k);
      double sizes = std::abs(value);
      for (int i = 0; i < count; ++i)
        for (int a = 0; a < D; ++a) {
          const double part = limit[k][i][a] * z[i][a];
          value -= part;
          sizes += std::abs(part);
        }
      out[next++] = value - PAD * sizes;
    }
    std::fill(out.begin() + next, out.end(), infinity);
  }

 private:
  static constexpr int SEVERAL = -1;
  static constexpr double RANK = 1e-13;  // largest ratio of singular values that rounding may cause
  static constexpr double PAD = 6e-16;   // of the terms of a slack: rounding on the way to forces
  // effect of the rounding of the largest normal force on balance
  static constexpr double LAST = 4e-16;

  void scale_torques() {
    for (int j = 0; j < joints; ++j)
      torque_unit = std::max(torque_unit, std::sqrt(product(torque[j], torque[j])));
    if (torque_unit == 0.0) torque_unit = 1.0;
    for (int j = 0; j < joints; ++j) {
      for (auto& z : torque[j])
        for (double& value : z) value /= torque_unit;
      bias[j] /= torque_unit;
    }
  }
  void find_owners() {
    for (int k = 0; k < limits; ++k) {
      int touched = 0;
      owner[k] = count;
      for (int i = 0; i < count; ++i)
        if (inner(limit[k][i], limit[k][i]) > 0.0) owner[k] = touched++ ? SEVERAL : i;
    }
    int many = 0;
    for (int k = 0; k < limits; ++k)
      if (owner[k] != SEVERAL) own[many++] = k;
    own.resize(many);
    std::sort(own.begin(), own.end(),
              [&](int a, int b) { return std::pair(owner[a], a) < std::pair(owner[b], b); });
  }
  // G = L Q by Gram-Schmidt, twice.
  void orthonormalise() {
    if (reach.full())
      turn = balance;
    else
      for (int r = 0; r < reach.rank; ++r)
        for (int q = 0; q < 6; ++q)
          for (int i = 0; i < count; ++i) add(turn[r][i], reach.axes[r][q], balance[q][i]);
    for (int r = 0; r < reach.rank; ++r) {
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
};

}  // namespace detail
}  // namespace grasp
