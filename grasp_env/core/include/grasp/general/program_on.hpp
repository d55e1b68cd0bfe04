// The general program on contacts of D variables: the state that its objectives share, and the
// attempts at an optimum.
#pragma once
#include <climits>
#include <optional>
#include <grasp/general/payload.hpp>
#include <grasp/general/phi_rows.hpp>
#include <grasp/newton/excess.hpp>

namespace grasp::detail {

template <int D> class ProgramOn {
 public:
  using Field = typename Constraints<D>::Field;
  template <class R, int T> using Interior = InteriorPoint<R, D, T>;

  explicit ProgramOn(const ProgramData& data)
      : count(data.count),
        limits(data.limits),
        in_(data),
        may_exceed_(data.elastic),
        internal_force_(count),
        inside_(count),
        z_(count),
        best_(count),
        slacks_(in_.slacks()),
        slacks_inside_(in_.slacks()),
        multipliers_(limits),
        best_multipliers_(limits) {}
  // Memory of a program and of its solves. joints: largest number of rows on several contacts.
  // torques: number of joints of `Criterion::torque`
  static std::size_t bytes_needed(int count, int limits, int joints, int torques) {
    const int equations = torques ? Constraints<D>::norm_equations(torques) : 0;
    const int cones = count + (torques ? Constraints<D>::norm_cones(torques) : 0);
    const auto most = [&](int joint) {
      const int owns = limits - joint + count + 1;
      const int rows = joint + 7 + equations;
      const std::size_t depth = InteriorPoint<DoubleDouble, D, 2>::bytes_needed(cones, rows, owns);
      const std::size_t least = InteriorPoint<double, D, 1>::bytes_needed(cones, rows, owns);
      const std::size_t careful =
          InteriorPoint<DoubleDouble, D, 1>::bytes_needed(cones, rows, owns);
      return depth + careful +
             std::max(least, PhiRows<double, D>::bytes_needed(count, rows, owns, limits));
    };
    return Constraints<D>::bytes_needed(count, limits, torques) +
           (3 + equations) * Arena::bytes_needed<Tuple<double, D>>(cones) +
           8 * Arena::bytes_needed<Tuple<double, D>>(count) +
           3 * Arena::bytes_needed<double>(count + limits) +
           4 * Arena::bytes_needed<double>(limits) + std::max(most(0), most(joints));
  }

  Code least(const double* wrench, Criterion criterion, const StopRule& options,
             const Record& record, double* multipliers, int budget);

  Deepest deepest(const double* wrench, double tolerance, double* z, double* multipliers,
                  bool inside = false);
  Payload payload(const double* direction, const double* wrench, double tolerance, double* z,
                  double* multipliers);

  double missed(const double* wrench, const double* z) {
    load_z(z, z_);
    return grasp::size(in_.wrench_of(z_) + in_.in_frame(wrench));
  }
  void balance(const double* wrench, double* z) {
    load_z(z, z_);
    in_.rebalance(z_, in_.in_frame(wrench));
    store_z(z_, z);
  }
  double least_slack(const double* z) {
    load_z(z, z_);
    in_.write_slacks(z_, limits, slacks_, [&](int k) { return in_.bound[k]; });
    return least_of(slacks_);
  }
  bool set_internal_force(const double* z) {
    load_z(z, internal_force_);
    in_.rebalance(internal_force_, Vec6{});
    in_.write_slacks(internal_force_, 0, slacks_, [](int) { return 0.0; });
    double most = 0.0;
    for (const auto& zi : internal_force_) most = std::max(most, zi[0]);
    if (least_of(slacks_) > DEEP * most) has_internal_force_ = true;
    return has_internal_force_.has_value();
  }
  double unit_size(const double* wrench) const { return grasp::size(in_.in_frame(wrench)); }
  bool independent() const { return in_.independent(); }
  bool is_out_of_reach(const double* wrench) const {
    return in_.is_out_of_reach(in_.in_frame(wrench));
  }

  Code least_phi(const Call& call, const Weights<double, 4>* weights, const double* row_weights,
                 const double* z, const Record& record, double* multipliers);

 private:
  // fraction of the forces: effect of their rounding on balance
  static constexpr double ROUNDED = 1e-15;
  // Smallest margin of an internal force; less would take millions of newtons.
  static constexpr double DEEP = 1e-6;
  // of the forces: norms of torques below it count as zero
  static constexpr double NO_TORQUE = 1e-9;
  static constexpr double BEGIN = 1.5;  // of a start's excess: initial increase of the limits
  // iterations before another start or more digits are tried; a dozen is usual
  static constexpr int FIRST_TRY = 40;
  // iterations on Phi before the central path is tried; twenty are usual
  static constexpr int PATIENCE = 200;
  static constexpr double FALL = 30.0;  // factor on lambda between stages of the path
  int count, limits;
  Constraints<D> in_;
  bool may_exceed_;
  // An internal force strictly inside the cones; a force strictly inside everything; work space.
  Field internal_force_, inside_, z_, best_;
  std::optional<bool> has_internal_force_;  // empty: not searched yet
  bool has_inside_ = false;
  bool moved_ = false;  // `unit_` is not quite the wrench of this call: see `Deepest`
  ArenaVector<double> slacks_, slacks_inside_, multipliers_, best_multipliers_;
  Vec6 unit_{}, turned_{}, best_nu_{};  // wrench of this call, size one; L^-1 of it
  Criterion criterion_ = Criterion::sum;
  int budget_ = INT_MAX;    // iterations of all attempts together
  double tolerance_ = 0.0;  // required gap
  double excess_unit_ = 1.0,
         most_ = 1.0;  // the excess of one unit of t; the largest normal force considered
  double size_ = 1.0, best_value_ = infinity, best_bound_ = 0.0, residual_ = 0.0,
         best_residual_ = 0.0;

  void load_z(const double* z, Field& to) const {
    for (int i = 0; i < count; ++i) std::copy(z + 4 * i, z + 4 * i + D, to[i].begin());
  }
  void store_z(const Field& from, double* z) const {
    for (int i = 0; i < count; ++i)
      for (int a = 0; a < 4; ++a) z[4 * i + a] = a < D ? from[i][a] : 0.0;
  }
  bool elastic() const { return criterion_ == Criterion::excess; }
  bool of_torques() const { return criterion_ == Criterion::torque; }
  // The normal force of a unit of u; weighted, unless excesses are minimised.
  double price(int i) const { return elastic() ? in_.price[i] : in_.cost[i]; }
  // Weighted preload of a contact, in the objective's unit, for `Criterion::largest`.
  double offset(int i) const {
    return criterion_ == Criterion::largest ? in_.offset[i] / size_ : 0.0;
  }
  int kept() const { return elastic() ? 0 : limits; }  // limits that no force may exceed

  template <int T> Code solve(const double* wrench, const StopRule& options, Summary& out) {
    int spent = 0;
    // from a strictly feasible z if one is known; first in double, then in higher precision
    const auto attempt = [&](auto& engine, bool known) {
      set_right(engine);
      if (known)
        place_inside(engine);
      else if (begin(engine))
        inside_from_start(engine);
      const int left = std::min(options.limit, budget_ - spent);
      const int limit = std::min(left, keeps_interior(engine) ? left : FIRST_TRY);
      const double enough = elastic()      ? EXCESS_FLOOR / excess_unit_
                            : of_torques() ? 0.1 * NO_TORQUE
                                           : 0.0;
      const Code code = engine.run(options.tolerance, enough, keeps_interior(engine) ? 0.1 : 0.0,
                                   limit, [&] { return consider(engine); });
      spent += engine.iterations;
      if (code != CONVERGED && consider(engine) <= options.tolerance) return CONVERGED;
      return code == LIMIT && limit < left ? STALLED : code;
    };
    auto quick = in_.template engine<double, T>(limits, criterion_);
    Code code = attempt(quick, false);
    if (code != CONVERGED && !has_inside_) {
      const Arena::Scope scope;
      Depth depth(in_, kept());
      const Deepest result = depth.find(wrench, 1e-7, z_);
      if (result.code != CONVERGED) {
        multipliers_ = depth.multipliers();
        out.multipliers = result.twist;
        out.iterations = spent;
        return result.code == INFEASIBLE ? INFEASIBLE : REFUSED;
      }
      take_inside(result);
      if (consider(quick) <= options.tolerance)
        code = CONVERGED;
      else if (options.limit > 0)
        code = attempt(quick, true);
    }
    if (code == STALLED) {
      auto careful = in_.template engine<DoubleDouble, T>(limits, criterion_);
      code = attempt(careful, has_inside_);
      if (code == STALLED && !elastic() && !moved_) {
        const Best before{best_,    best_multipliers_, unit_,       turned_,
                          best_nu_, best_value_,       best_bound_, best_residual_};
        if (move_off_boundary(wrench)) code = attempt(careful, true);
        if (moved_ && code != CONVERGED && before.value < infinity) {
          restore(before);
          code = STALLED;
        }
      }
    }
    out.iterations = out.trials = spent;
    return code;
  }
  // The best force so far, and the wrench that it balances.
  struct Best {
    Field force;
    ArenaVector<double> multipliers;
    Vec6 unit, turned, nu;
    double value, bound, residual;
  };
  void restore(const Best& from) {
    best_ = from.force;
    best_multipliers_ = from.multipliers;
    unit_ = from.unit;
    turned_ = from.turned;
    best_nu_ = from.nu;
    best_value_ = from.value;
    best_bound_ = from.bound;
    best_residual_ = from.residual;
    moved_ = false;
  }
  // Take over the force in z_, which is strictly inside, and the wrench that it balances.
  void take_inside(const Deepest& result) {
    for (int i = 0; i < count; ++i)
      for (int a = 0; a < D; ++a) inside_[i][a] = z_[i][a] / size_;
    has_inside_ = true;
    if (!result.moved) return;
    unit_ = (1.0 / size_) * in_.in_frame(result.wrench.data());
    turned_ = in_.solve_lower(unit_);
    moved_ = true;
    best_value_ = infinity;
    best_bound_ = 0.0;
    best_nu_ = Vec6{};
    std::fill(best_multipliers_.begin(), best_multipliers_.end(), 0.0);
  }
  // Replace a wrench next to the boundary of the constraints by one just inside, see `Deepest`.
  bool move_off_boundary(const double* wrench) {
    const Arena::Scope scope;
    const Deepest result = Depth(in_, kept()).find(wrench, 1e-7, z_, true);
    if (result.code != CONVERGED || !result.moved) return false;
    take_inside(result);
    return true;
  }
  // True if the last iterate strictly inside in doubles is kept, to be mixed with later ones.
  template <class R, int T> static constexpr bool keeps_interior(const Interior<R, T>&) {
    return std::is_same_v<R, DoubleDouble>;
  }
  template <class Interior> void set_right(Interior& engine) const {
    auto& joint = engine.rows.right;
    for (int r = 0; r < engine.rows.joint; ++r) {
      if (r < 6)
        joint[r] = -turned_[r];
      else if (r < engine.rows.equal)
        joint[r] = r - 6 < in_.joints ? -in_.bias[r - 6] / size_ : 0.0;
      else
        joint[r] = in_.bound[engine.rows.label[r]] / size_;
    }
    for (auto& row : engine.rows.own) {
      if (row.label >= 0)
        row.right = in_.bound[row.label] / size_;
      else
        row.right = row.contact < count ? -offset(row.contact) : 0.0;
    }
  }
  // Largest relative excess of a limit at z.
  double excess(const Field& z) const {
    double most = 0.0;
    for (int k = 0; k < limits; ++k)
      if (in_.shares[k] > 0.0)
        most =
            std::max(most, (size_ * in_.product(in_.limit[k], z) - in_.bound[k]) / in_.shares[k]);
    return most;
  }
  // Set t in units of an excess above that of the start z, so that it begins at one; bound normal
  // forces by a multiple of those of z.
  template <class R> void raise(Interior<R, 1>& engine, const Field& z);
  template <class R, int T> void inside_from_start(const Interior<R, T>& engine) {
    for (int i = 0; i < count; ++i) inside_[i] = narrow(engine.at.z[i]);
    has_inside_ = true;
  }
  template <class R, int T> void place_inside(Interior<R, T>& engine) {
    for (int i = 0; i < count; ++i) engine.at.z[i] = wide<R>(inside_[i]);
    place(engine, 0.0);
  }
  // Write a start. Return true if it is balanced and strictly inside all constraints.
  template <class R, int T> bool begin(Interior<R, T>& engine);
  // Set slacks and a dual strictly inside for the z of a start: s = c + the limits' part. Slacks
  // below `least` times the largest force are lifted to it. Return false if any was.
  template <class R, int T> bool place(Interior<R, T>& engine, double least);
  template <int T> double engine_price(int i) const {
    return of_torques() ? 1.0 : T == 1 ? price(i) / count : price(i);
  }
  // Put the cones of the norm of the torques around those of the start.
  template <class R> void place_norm(Interior<R, 0>& engine);
  // The same for `Criterion::torque`, with the multipliers of the limits in place. What rounding
  // takes from the dual cones is paid for forces of up to FARTHEST times those of the iterate.
  template <class R> void certify_torques(const Interior<R, 0>& engine);

  // Balance the iterate, bring it within the limits and bound its objective; keep the best. Return
  // the gap.
  template <class R, int T> double consider(const Interior<R, T>& engine);
  double gap() const {
    if (!(best_value_ < infinity)) return infinity;
    const double floor = elastic()      ? EXCESS_FLOOR / EXCESS_WITHIN
                         : of_torques() ? NO_TORQUE / tolerance_
                                        : 0.0;
    const double from = std::max(best_bound_, floor);
    const double gap = from > 0.0           ? (best_value_ - best_bound_) / from
                       : best_value_ == 0.0 ? 0.0
                                            : infinity;
    // rounding of the balance may take it below its bound
    return gap >= -tolerance_ ? gap : infinity;
  }

  // Dual value at the multipliers, moved towards interior ones until feasible: s = c + C^T y in the
  // dual cones, y >= 0 for the limits. For an excess, at multipliers that price t at one; forces up
  // to most_ pay for what they lack of the dual cones.
  template <class R, int T> void certify(const Interior<R, T>& engine);
  // Write Phi's optimum. CONVERGED: balanced, inside, and the gap is within the tolerance.
  template <class R> Code write_phi(PhiRows<R, D>& engine, Code code, const Call& call,
                                    const Record& record, double* multipliers);
  void write(Code code, const Record& record, double* multipliers);
};

}  // namespace grasp::detail
