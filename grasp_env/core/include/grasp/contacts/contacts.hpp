// Contacts: friction and weights, set once, and their current place. `place` and `select` allocate
// nothing.
#pragma once
#include <span>
#include <stdexcept>
#include <utility>
#include <grasp/contacts/geometry.hpp>
#include <grasp/math/jacobi_rotations.hpp>

namespace grasp {

inline constexpr double LARGEST = 1e12;  // [N], [N m] largest number accepted
// [N] a smaller wrench counts as zero: its inverse is infinite
inline constexpr double NOTHING = 1e-306;
// Rounding that proofs of infeasibility allow for: of a proof's terms, per term, far above what may
// occur; and of the terms of a sum of a dozen.
inline constexpr double PROOF_ROUNDING = 1e-14, SUM_ROUNDING = 4e-16;

// Largest balance residual [N] of a balanced force: a fraction of the wrench, or of normal forces
// up to 1 N.
inline constexpr double BALANCED = 1e-9;
template <class S> inline S balance_tolerance(const S& wrench, const S& normal) {
  return BALANCED * max(wrench, min(normal, S(1.0)));
}

// Wrenches this close to the boundary of those that contacts can balance, as a fraction of the
// wrench in the unit frame, count as equal: a force may balance one just inside instead.
inline constexpr double BOUNDARY = BALANCED;

// refused: not finite, all at one point, or a normal not of unit length. needs_torsion: the rank is
// 6 only with the torsion of soft contacts. rank_lost: the contacts balance only wrenches of their
// `reach`. `inverse` is undefined in both.
enum class Placing { good, refused, rank_lost, needs_torsion };

// The wrenches that forces of any sign can make: those along the first `rank` of six orthonormal
// axes, unit frame. With rank 6 the axes have no meaning.
struct WrenchSpace {
  int rank = 6;
  // wrench out of reach that forces make because places are rounded, as a fraction of them
  double rounding = 0.0;
  std::array<Vec6, 6> axes{};

  bool full() const { return rank == 6; }
  // The part of a wrench that is out of reach, orthogonal to the rest; unit frame.
  Vec6 beyond(const Vec6& wrench) const {
    Vec6 out{};
    for (int k = rank; k < 6; ++k) out = out + dot(axes[k], wrench) * axes[k];
    return out;
  }
};

// The weights of Phi, equal for all contacts: of squeezing, which the exact problem shares, and of
// approaching a cone [N^2].
struct Objective {
  double force_weight = 1.0, barrier_weight = 0.01;
};

// Accepted scale of cone coordinates, 0: nothing is transmitted; and its divisor.
template <class T> inline T taken_scale(const T& scale) {
  return select((scale > 0.0) & (scale < infinity), scale, T(0.0));
}
template <class T> inline T divisor_of(const T& scale) {
  return select(scale > 0.0, scale, T(infinity));
}

class Contacts {
 public:
  // `rank_bound` above which G G^T is inverted directly, with at least six digits left.
  static constexpr double WELL_CONDITIONED = 1e-6;
  int count = 0;
  // (N, 3) cone coordinates = scale * force, force = cone coordinates / divisor
  std::vector<double> scale, divisor;
  std::vector<double> omega, lambda;  // (N,) weights of Phi
  // (N,) gamma [m] of soft contacts, (|tangential force| / mu)^2 + (torsion / gamma)^2 <= normal^2;
  // 0 of others
  std::vector<double> torsion;
  std::vector<double> tangents;  // (N, 3) directions of o; empty: the default rule

  UnitFrame unit;
  std::vector<double> positions, normals;  // (N, 3) as placed
  std::vector<double> frames;              // (N, 3, 3) columns (n, o, t), object frame
  std::vector<double> matrix;              // (6, 3N) G
  std::vector<double> rows;                // (6, 3N) G in cone coordinates, unit frame
  // (6, 3N) G for forces, unit frame; zero where nothing is transmitted
  std::vector<double> force_rows;
  // (3N, 6) G^+ in cone coordinates, unit frame: the least-norm change of force
  std::vector<double> inverse;
  // of the last `place`; the arrays above belong to the last one that was not refused
  Placing placing = Placing::refused;
  WrenchSpace reach;
  bool clear = false;  // the rank is 6 beyond doubt, without singular values

  Contacts() = default;
  // scale: (N, 3) mu for the normal and 1 for the tangents of round cones; 0: nothing is
  // transmitted. weights: (N, 2) omega, lambda.
  Contacts(int count, const double* scales, const double* weights, const double* along = nullptr,
           const double* gamma = nullptr) {
    make_room(count);
    std::copy(scales, scales + 3 * count, scale.begin());
    set_weights(weights);
    update_divisors();
    set_tangents_and_torsion(along, gamma);
  }
  // friction: one coefficient for all contacts, N, or (N, 2) along o and t; 0: frictionless.
  Contacts(int count, std::span<const double> friction, const Objective& objective = {},
           const double* along = nullptr, const double* gamma = nullptr) {
    make_room(count);
    set_weights(objective);
    set_friction(friction);
    set_tangents_and_torsion(along, gamma);
  }

  // Place contacts; throws std::invalid_argument about the wrong argument unless solvers can use
  // them. positions, normals: as for `place`. friction: as for the constructor. along: (N, 3)
  // tangents, or empty. gamma: (N,) torsional friction [m], 0: hard, or empty.
  static Contacts from(std::span<const double> positions, std::span<const double> normals,
                       std::span<const double> friction, const Objective& objective = {},
                       std::span<const double> along = {}, std::span<const double> gamma = {}) {
    const std::size_t size = positions.size();
    const std::size_t count = size / 3;
    const std::size_t numbers = friction.size();
    require(size > 0 && size % 3 == 0 && size <= 3 * MOST_CONTACTS,
            "positions must be three numbers of each contact, up to 1000");
    require(normals.size() == size, "normals must be as many as positions");
    require(along.empty() || along.size() == size,
            "tangents must be as many as positions, or none");
    require(numbers == 1 || numbers == count || numbers == 2 * count,
            "friction must be one number, N or 2N");
    require(is_in_range(friction), "friction must be 0 to 1e12");
    require(gamma.empty() || gamma.size() == count,
            "torsion must be one number of each contact, or none");
    require(is_in_range(gamma), "torsion must be 0 to 1e12");
    Contacts contacts(int(count), friction, objective, along.empty() ? nullptr : along.data(),
                      gamma.empty() ? nullptr : gamma.data());
    contacts.place_or_throw(positions.data(), normals.data());
    return contacts;
  }
  static Contacts from(std::span<const double> positions, std::span<const double> normals,
                       double friction, const Objective& objective = {}) {
    return from(positions, normals, std::span(&friction, 1), objective);
  }
  // The same with scale and weights (N, 2), as for the constructor.
  static Contacts checked(int count, const double* positions, const double* normals,
                          const double* scales, const double* weights,
                          const double* along = nullptr) {
    for (int j = 0; j < 3 * count; ++j)
      require(scales[j] >= 0.0 && scales[j] < infinity && (j % 3 != 0 || scales[j] > 0.0),
              "scale must be finite and >= 0, that of normals > 0");
    Contacts contacts(count, scales, weights, along);
    contacts.place_or_throw(positions, normals);
    return contacts;
  }

  // Replace the friction, as for the constructor, from the next `place` on. chosen: indices of
  // these contacts if `friction` covers more; frictionless ones then stay so. Return true if
  // it differs.
  bool set_friction(std::span<const double> friction, std::span<const int> chosen = {},
                    int of = 0) {
    const std::size_t numbers = friction.size();
    const std::size_t all = chosen.empty() ? count : of;
    bool changed = false;
    for (int k = 0; k < count; ++k) {
      const std::size_t i = chosen.empty() ? k : chosen[k];
      if (!chosen.empty() && scale[3 * k + 1] == 0.0) continue;
      const bool two = numbers == 2 * all;
      const double mu_o = friction[two ? 2 * i : numbers == 1 ? 0 : i];
      const double mu_t = two ? friction[2 * i + 1] : mu_o;
      const Point one = cone_scale(mu_o, mu_t);
      for (int a = 0; a < 3; ++a) changed |= std::exchange(scale[3 * k + a], one[a]) != one[a];
    }
    if (changed) update_divisors();
    return changed;
  }

  // Multiply friction and torsional friction by a share, from the next `place` on.
  void narrow(double share) {
    for (int k = 0; k < count; ++k) {
      if (scale[3 * k + 1] > 0.0) scale[3 * k] *= share;
      torsion[k] *= share;
    }
    update_divisors();
  }

  // Set the weights of Phi: (N, 2) omega and lambda, or the same for all contacts.
  void set_weights(const double* weights) {
    for (int i = 0; i < count; ++i) {
      omega[i] = weights[2 * i];
      lambda[i] = weights[2 * i + 1];
    }
  }
  void set_weights(const Objective& objective) {
    std::fill(omega.begin(), omega.end(), objective.force_weight);
    std::fill(lambda.begin(), lambda.end(), objective.barrier_weight);
  }
  bool weights_good() const {
    const auto good = [](double v) { return v > 0.0 && v < infinity; };
    return std::ranges::all_of(omega, good) && std::ranges::all_of(lambda, good);
  }
  // From now on, project the current directions of o instead of the default.
  void keep_tangents() {
    tangents.resize(3 * count);
    for (int j = 0; j < 3 * count; ++j) tangents[j] = frames[3 * j + 1];
  }

  // Take over the properties of the contacts `chosen` of `all`; `place` then places them. Does not
  // allocate if this object was once a copy of `all`.
  void select(const Contacts& all, std::span<const int> chosen) {
    make_room(int(chosen.size()));
    const auto copy = [&](std::vector<double>& to, const std::vector<double>& from, int width) {
      for (int i = 0; i < count; ++i)
        std::copy_n(from.data() + width * chosen[i], width, to.data() + width * i);
    };
    copy(scale, all.scale, 3);
    copy(divisor, all.divisor, 3);
    copy(used_, all.used_, 3);
    copy(per_, all.per_, 3);
    copy(omega, all.omega, 1);
    copy(lambda, all.lambda, 1);
    copy(torsion, all.torsion, 1);
    tangents.resize(all.tangents.empty() ? 0 : 3 * count);
    if (!tangents.empty()) copy(tangents, all.tangents, 3);
    placing = Placing::refused;
    clear = false;
  }

  // Place the contacts: positions [m] and inward unit normals, (N, 3) each, object frame.
  Placing place(const double* at, const double* inward) {
    double total = 0.0;
    for (int j = 0; j < 3 * count; ++j) total += std::abs(at[j]);
    bool good = total < infinity;
    for (int i = 0; i < count; ++i)
      good = good && std::abs(length(point(inward + 3 * i)) - 1.0) <= UNIT_TOLERANCE;
    const UnitFrame around(at, count);
    good = good && (count < 2 || (around.length > 0.0 && around.length < infinity));
    if (!good) return placing = Placing::refused;
    unit = around;
    for (int i = 0; i < count; ++i) {
      const Point normal = normalised(point(inward + 3 * i));
      for (int a = 0; a < 3; ++a) {
        positions[3 * i + a] = at[3 * i + a];
        normals[3 * i + a] = normal[a];
      }
    }
    const int size = 3 * count;
    const double per_length = unit.scale();
    Packed6 s{};
    for (int i = 0; i < count; ++i) {
      const Frame frame(point(normals.data() + 3 * i),
                        tangents.empty() ? nullptr : tangents.data() + 3 * i);
      const Point from = point(at + 3 * i);
      const Point arm = per_length * (from - unit.centre);
      for (int a = 0; a < 3; ++a) {
        const int j = 3 * i + a;
        const Vec6 column = unit_wrench(from, frame[a]);
        const Vec6 row = used_[j] * unit_wrench(arm, frame[a]);
        add_gram(s, row);
        for (int r = 0; r < 3; ++r) frames[9 * i + 3 * r + a] = column[r];
        set_column(matrix.data(), size, j, column);
        set_column(force_rows.data(), size, j, row);
        set_column(rows.data(), size, j, per_[j] * row);
      }
    }
    return placing = find_rank(s);
  }

  // The wrench (6,) without its part that no forces of these contacts make.
  Vec6 within_reach(const double* wrench) const {
    if (reach.full()) return {wrench[0], wrench[1], wrench[2], wrench[3], wrench[4], wrench[5]};
    const Vec6 load = unit.of(wrench);
    return unit.out_of(load - reach.beyond(load));
  }
  // Write an orthonormal basis of the rows of G (forces) into `out` (6, 3N).
  void orthonormal(std::vector<double>& out) const {
    out = force_rows;
    double lower[6][6];
    if (!orthonormalise(gram(out.data(), 3 * count), out, lower)) {
      JacobiRotations(out, 3 * count).normalise();
    }
  }

  bool soft() const {
    return std::ranges::any_of(torsion, [](double gamma) { return gamma > 0.0; });
  }
  // Number of tangential parts of contact i: 0 without friction, 2 with it, 1 more with torsion.
  int tangential(int i) const {
    return (scale[3 * i + 1] > 0.0) + (scale[3 * i + 2] > 0.0) + (torsion_scale(i) > 0.0);
  }
  // v = scale * torsion, in units of u [1 / m]; 0: no torsion is transmitted
  double torsion_scale(int i) const {
    return torsion[i] > 0.0 ? taken_scale(scale[3 * i] / torsion[i]) : 0.0;
  }
  // The wrench of a unit torsion, unit frame.
  Vec6 torsion_wrench(int i) const {
    const Point moment = unit.scale() * point(normals.data() + 3 * i);
    return {0.0, 0.0, 0.0, moment.u, moment.o, moment.t};
  }

 private:
  static constexpr std::size_t MOST_CONTACTS = 1000;
  static constexpr double ROUNDED_PLACES = 1e-15;  // of the distance from the origin
  std::vector<double> used_, per_;  // 1 where a force is transmitted, else 0; 1 / divisor
  std::vector<double> work_;        // (6, 4N)

  static void require(bool good, const char* message) {
    if (!good) throw std::invalid_argument(message);
  }
  static bool is_in_range(std::span<const double> numbers) {
    return std::ranges::all_of(numbers, [](double v) { return v >= 0.0 && v <= LARGEST; });
  }

  void make_room(int contacts) {
    const std::size_t n = count = contacts;
    for (auto* one : {&omega, &lambda, &torsion}) one->resize(n);
    for (auto* three : {&scale, &divisor, &used_, &per_, &positions, &normals})
      three->resize(3 * n);
    for (auto* many : {&matrix, &rows, &force_rows, &inverse}) many->resize(18 * n);
    frames.resize(9 * n);
    work_.resize(24 * n);
  }
  void set_tangents_and_torsion(const double* along, const double* gamma) {
    if (along) tangents.assign(along, along + 3 * count);
    if (gamma) std::copy(gamma, gamma + count, torsion.begin());
  }
  void place_or_throw(const double* at, const double* inward) {
    require(weights_good(), "weights must be finite and > 0");
    place(at, inward);
    require(placing != Placing::refused,
            "positions must be finite and different, and normals of unit length, to 1 %");
    require(reach.rank > 0, "tangents must not be along normals");
  }

  void update_divisors() {
    for (int j = 0; j < 3 * count; ++j) {
      scale[j] = taken_scale(scale[j]);
      divisor[j] = divisor_of(scale[j]);
      used_[j] = scale[j] > 0.0;
      per_[j] = 1.0 / divisor[j];
    }
  }

  // s: Gram matrix of the rows
  Placing find_rank(const Packed6& s) {
    clear = false;
    reach.rank = 6;
    reach.rounding = 0.0;
    if (invert(s)) return Placing::good;
    Packed6 all = s;
    const int columns = gather_columns(all);
    if (soft()) {
      Ldl6 factor;
      factor.factor(all);
      clear = rank_bound(all, factor) > CLEAR_RANK;
      if (clear) return Placing::needs_torsion;
    }
    find_reach(columns);
    return reach.full() ? Placing::needs_torsion : Placing::rank_lost;
  }
  // Write the columns of forces and torsions, unit frame, into work_ (6, columns); add those of
  // torsions to the Gram matrix.
  int gather_columns(Packed6& s) {
    const int size = 3 * count;
    const int columns =
        size + int(std::ranges::count_if(torsion, [](double gamma) { return gamma > 0.0; }));
    for (int r = 0; r < 6; ++r)
      std::copy_n(force_rows.data() + size * r, size, work_.data() + columns * r);
    int next = size;
    for (int i = 0; i < count; ++i) {
      if (!(torsion[i] > 0.0)) continue;
      const Vec6 column = torsion_wrench(i);
      set_column(work_.data(), columns, next++, column);
      add_gram(s, column);
    }
    return columns;
  }
  void find_reach(int columns) {
    const JacobiRotations rotations(work_, columns);
    int first = 0, last = 6;
    for (int r = 0; r < 6; ++r) {
      const bool spanned =
          rotations.value[r] > 0.0 && rotations.value[r] >= JacobiRotations::RANK * rotations.most;
      Vec6& axis = reach.axes[spanned ? first++ : --last];
      std::copy_n(rotations.turn[r], 6, axis.begin());
    }
    reach.rank = first;
    if (!reach.full()) reach.rounding = ROUNDED_PLACES * (1.0 + unit.scale() * length(unit.centre));
  }

  bool invert(const Packed6& s) {
    if (count == 0) return false;
    const int size = 3 * count;
    double total = 0.0;
    for (double v : s) total += std::abs(v);
    if (!(total < infinity)) return false;
    Ldl6 factor;
    factor.factor(s);
    const double bound = rank_bound(s, factor);
    if (bound > WELL_CONDITIONED) {  // G^+ = G^T (G G^T)^-1
      for (int j = 0; j < size; ++j) {
        const Vec6 solved = factor.solve(column(force_rows.data(), size, j));
        for (int r = 0; r < 6; ++r) inverse[6 * j + r] = scale[j] * solved[r];
      }
      return clear = true;
    }
    std::copy(force_rows.begin(), force_rows.end(), work_.begin());
    if (bound > CLEAR_RANK) {  // G = L Q, G^+ = Q^T L^-1
      double lower[6][6];
      if (!orthonormalise(s, work_, lower)) return false;
      for (int j = 0; j < size; ++j)
        for (int r = 5; r >= 0; --r) {
          double a = work_[size * r + j] * scale[j];
          for (int i = r + 1; i < 6; ++i) a -= lower[i][r] * inverse[6 * j + i];
          inverse[6 * j + r] = a / lower[r][r];
        }
      return clear = true;
    }
    JacobiRotations rotations(work_, size);
    if (!rotations.spans()) return false;
    rotations.normalise();
    for (int j = 0; j < size; ++j)
      for (int q = 0; q < 6; ++q) {
        double sum = 0.0;
        for (int r = 0; r < 6; ++r)
          sum += work_[size * r + j] * rotations.turn[r][q] / rotations.value[r];
        inverse[6 * j + q] = sum * scale[j];
      }
    return true;
  }

  // Orthonormalise rows (6, 3N) with Gram matrix s = lower * (orthonormal rows) by two Cholesky
  // factorisations, exact to rounding for condition numbers up to 1e7. False: rank lost.
  bool orthonormalise(Packed6 s, std::vector<double>& turned, double (&lower)[6][6]) const {
    const int size = 3 * count;
    for (int pass = 0; pass < 2; ++pass) {
      if (pass == 1) s = gram(turned.data(), size);
      double factor[6][6] = {};
      double both[6][6] = {};
      for (int i = 0; i < 6; ++i)
        for (int j = 0; j <= i; ++j) {
          double a = s[packed(i, j)];
          for (int k = 0; k < j; ++k) a -= factor[i][k] * factor[j][k];
          if (i == j && !(a > 0.0)) return false;
          factor[i][j] = i == j ? std::sqrt(a) : a / factor[j][j];
        }
      for (int i = 0; i < 6; ++i) {
        double* row = turned.data() + size * i;
        for (int k = 0; k < i; ++k)
          for (int j = 0; j < size; ++j) row[j] -= factor[i][k] * turned[size * k + j];
        for (int j = 0; j < size; ++j) row[j] /= factor[i][i];
        for (int j = 0; j <= i; ++j) {
          if (pass == 0)
            both[i][j] = factor[i][j];
          else
            for (int k = j; k <= i; ++k) both[i][j] += lower[i][k] * factor[k][j];
        }
      }
      std::copy(&both[0][0], &both[0][0] + 36, &lower[0][0]);
    }
    return true;
  }
};

}  // namespace grasp
