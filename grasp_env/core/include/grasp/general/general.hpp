// The general program for real-time code: any contacts, any limits, and continuation of faster
// algorithms that give up. The constructor allocates; placing and solving then allocate nothing.
#pragma once
#include <grasp/limits/force_limits.hpp>
#include <grasp/general/program.hpp>

namespace grasp {

class General {
 public:
  // largest balance residual of a given start, as a fraction of wrench and force
  static constexpr double BALANCE_TOLERANCE = 1e-8;
  static constexpr int CONIC_ITERATIONS = 100;  // of an interior point; a dozen is usual

  General() = default;
  // For at most so many contacts and rows of limits; soft: torsion may be transmitted. If the worst
  // rows need more than LARGEST_ROOM, and for more contacts, `place` allocates what it lacks.
  // torques: joints whose torques are minimised.
  explicit General(int contacts, int limits = 0, bool soft = false, int torques = 0)
      : arena_(clamped_size(bytes_needed(contacts, limits, limits, torques, soft))) {}
  General(const General& other) : arena_(other.arena_.size()) {}
  General& operator=(const General& other) {
    forget();
    arena_.reserve(other.arena_.size());
    return *this;
  }

  // Take over the placed contacts and their weights; keeps no argument. limits: their Jacobian is
  // (N, width, J), width = 3, or 4 with the row of torsion. internal: (N, 3) an internal force
  // strictly inside the cones; null: `least_normal` finds one. preload: forces and wrenches below
  // are those of the shifted problem. rank_lost: rounding hides which wrenches they make.
  // with_torques: for `Criterion::torque`.
  Placing place(const Contacts& contacts, const ForceLimits& limits = {}, int width = 3,
                const double* internal = nullptr, const Preload& preload = {},
                bool with_torques = false) {
    forget();
    const int count = contacts.count;
    const int rows = limits.many();
    const int joints = int(limits.torque_limit.size());
    const int torques = with_torques ? joints : 0;
    if (count == 0) return Placing::rank_lost;
    arena_.reserve(bytes_needed(count, rows, std::min(rows, 2 * joints), torques, contacts.soft()));
    const Arena::Use use(arena_);
    Inputs& inputs = inputs_.emplace(count, rows, torques);
    const bool is_in_range = inputs.set(contacts) && inputs.set(limits, width, preload);
    if (is_in_range) {
      double frame[36];
      contacts.unit.write(frame);
      program_.emplace(ProgramData{count, inputs.limits, frame, inputs.balance.data(),
                                   inputs.rows.data(), inputs.bound.data(), inputs.weights.data(),
                                   inputs.divisor.data(), inputs.shares.data(), true,
                                   contacts.reach, inputs.preload.data(), torques,
                                   inputs.torque.data(), inputs.torque_bias.data()});
      if (internal) {
        inputs.load(internal, nullptr);
        program_->set_internal_force(inputs.z.data());
      }
      if (program_->independent()) return Placing::good;
    }
    forget();
    return is_in_range ? Placing::rank_lost : Placing::refused;
  }
  bool placed() const { return bool(program_); }
  int count() const { return placed() ? inputs_->count : 0; }

  // The functions below need placed contacts, and records for as many contacts.

  // Minimise the sum or the largest of the weighted normal forces. INFEASIBLE: the record holds the
  // twist that proves it. UNDECIDED: neither a force nor a proof.
  Code least_normal(const double* wrench, Criterion criterion, const StopRule& options,
                    const Record& record) {
    const Arena::Use use(arena_);
    const Code code =
        least(wrench, criterion, {options.tolerance, CONIC_ITERATIONS}, options.limit, record);
    const Summary& s = record.summary();
    const bool lost = code == STALLED && s.lower_bound > (1.0 + 1e-6) * s.objective;
    if ((code != REFUSED && !lost) || !is_valid_wrench(wrench)) return code;
    return refute(deepest(wrench), wrench, record);
  }
  // Minimise the sum from the record of a solver that stopped short of the tolerance. The better
  // result stays; iterations add up.
  Code least_normal_from(const StopRule& options, const Record& record) {
    const Arena::Use use(arena_);
    Summary& before = record.summary();
    const int left = options.limit - int(before.iterations);
    const bool stopped = record.code() == STALLED || record.code() == LIMIT;
    if (!stopped || left <= 0 || !gap_exceeds_rounding(before, options.tolerance))
      return record.code();
    const Record next(inputs_->record.data(), inputs_->count);
    const Code code = least(before.wrench.data(), Criterion::sum,
                            {options.tolerance, CONIC_ITERATIONS}, left, next);
    const bool ended = code == STALLED || code == LIMIT;
    const Vec6 wrench = before.wrench;
    if (code == CONVERGED || (ended && gap(next.summary()) < gap(before))) {
      replace_record(next, record);
    } else if (!ended && gap(before) > before.lower_bound) {  // neither holds a digit
      if (code == INFEASIBLE) return replace_record(next, record);
      return refute(deepest(wrench.data()), wrench.data(), record);
    }
    const bool digits = gap(before) <= before.lower_bound &&
                        before.residual <= MISSED * program_->unit_size(wrench.data());
    if (record.code() == CONVERGED || digits) return record.code();
    // the forces are so far above the wrench that they prove nothing
    const Deepest result = deepest(wrench.data());
    return result.code == INFEASIBLE ? refute(result, wrench.data(), record) : record.code();
  }

  // True if `phi` can use the start of a call: it is strictly inside.
  bool starts_from(const Call& call) {
    const Arena::Use use(arena_);
    return has_start(call);
  }
  // Minimise Phi, from the start of the call if it is strictly inside: From::given, its balanced
  // force and torsion; From::tangent, the nearest balanced force. Otherwise from the deepest force.
  // INFEASIBLE, UNDECIDED: as for `least_normal`.
  Code phi(const Call& call, const Record& record) {
    const Arena::Use use(arena_);
    record.clear();
    record.summary().code = REFUSED;
    if (!is_valid_wrench(call.wrench)) return REFUSED;
    Call stage = call;
    Deepest result;
    if (!has_start(call)) {
      result = begin(call.wrench);
      if (result.code != CONVERGED) return refute(result, call.wrench, record);
      if (result.moved) stage.wrench = result.wrench.data();
    }
    const Code code = least_phi(stage, record);
    inputs_->store(inputs_->z.data(), record.initial_force(), nullptr);
    stage = call;
    stage.stop.limit -= int(record.summary().iterations);
    if ((code == REFUSED || (code == STALLED && !result.moved)) && phi_inside(stage, record))
      return record.code();
    if (code == REFUSED) return refute({}, call.wrench, record);
    if (result.moved) stand_for(result.wrench, call, record);
    return record.code();
  }
  // Continue a record that stalled above rounding, with at most MORE_STEPS steps. The better result
  // stays.
  Code phi_from(const StopRule& options, const Record& record) {
    const Arena::Use use(arena_);
    Summary& before = record.summary();
    const int left = options.limit - int(before.iterations);
    if (record.code() != STALLED || left <= 0 || !gap_exceeds_rounding(before, options.tolerance))
      return record.code();
    const Record next(inputs_->record.data(), inputs_->count);
    inputs_->load(record.force(), record.torsion());
    const Code code = least_phi(
        {.wrench = before.wrench.data(), .stop = {options.tolerance, std::min(left, MORE_STEPS)}},
        next);
    if (code == CONVERGED || (code != REFUSED && next.summary().objective < before.objective)) {
      next.summary().code = code == LIMIT && left > MORE_STEPS ? STALLED : code;
      replace_record(next, record);
    }
    if (record.code() == STALLED) {
      const Vec6 wrench = before.wrench;
      phi_inside({.wrench = wrench.data(),
                  .stop = {options.tolerance, options.limit - int(before.iterations)}},
                 record);
    }
    return record.code();
  }

  // Replace an INFEASIBLE record by the balanced force in the cones that exceeds the limits least,
  // LIMITS_EXCEEDED, if one exists.
  Code excess(const Record& record) {
    const Arena::Use use(arena_);
    if (record.code() != INFEASIBLE || inputs_->limits == 0) return record.code();
    const Record next(inputs_->record.data(), inputs_->count);
    const StopRule elastic{EXCESS_WITHIN, CONIC_ITERATIONS};
    const double* wrench = record.summary().wrench.data();
    if (least(wrench, Criterion::excess, elastic, INT_MAX, next) != LIMITS_EXCEEDED)
      return record.code();
    std::copy(next.force(), next.force() + 3 * inputs_->count, record.initial_force());
    return replace_record(next, record);
  }

  // Find the force (N, 3) [N] and torsion (N,) [N m] deepest inside all constraints.
  Deepest deepest(const double* wrench, double tolerance, double* force, double* torsion) {
    const Arena::Use use(arena_);
    const Deepest result = deepest(wrench, tolerance);
    inputs_->store(inputs_->z.data(), force, torsion);
    return result;
  }
  // Find the largest k for which forces hold `wrench + k direction` within all limits, and the
  // force (N, 3) [N] and torsion (N,) [N m] that hold `load`.
  Payload payload(const double* direction, const double* wrench, double tolerance, double* force,
                  double* torsion) {
    const Arena::Use use(arena_);
    Inputs& inputs = *inputs_;
    const Payload result =
        program_->payload(direction, wrench, tolerance, inputs.z.data(), inputs.multipliers.data());
    unscale_multipliers(result.code);
    inputs.store(inputs.z.data(), force, torsion);
    return result;
  }
  // Balance residual of a force (N, 3) and torsion (N,), or null, unit frame [N]; smallest slack:
  // above 0 if strictly inside.
  double missed(const double* wrench, const double* force, const double* torsion) {
    inputs_->load(force, torsion);
    return program_->missed(wrench, inputs_->z.data());
  }
  double slack(const double* force, const double* torsion) {
    inputs_->load(force, torsion);
    return program_->slack(inputs_->z.data());
  }

  // Multipliers of the last solve, or of the proof if there is no force: one per limit.
  std::span<const double> multipliers() const {
    return placed() ? inputs_->multipliers : std::span<const double>();
  }

 private:
  // bytes that the constructor may allocate
  static constexpr std::size_t LARGEST_ROOM = std::size_t(1) << 24;
  static constexpr double LAST_DIGITS = 1e-9;  // relative gap that double precision cannot close
  static constexpr int MORE_STEPS = 1000;      // for a stalled solver: 60 ms with four contacts
  // fraction of the wrench: an answer with a larger balance residual is rejected
  static constexpr double MISSED = 1e-3;
  static constexpr double NEARLY_ZERO = 1e-9;  // [N], [N m]
  static constexpr double MOST_FORCE = 1e20;   // [N] limits above this are rejected

  // Contacts and limits in the form of `ProgramData`.
  struct Inputs {
    int count, limits, joints;  // joints whose torques are minimised
    ArenaVector<double> torque, torque_bias;
    ArenaVector<double> balance, rows, bound, shares, divisor, preload;
    ArenaVector<Weights<double, 4>> weights;
    ArenaVector<double> sizes, row_weights;  // (M,) divisors of the rows; weights of Phi
    ArenaVector<double> z, row, record, multipliers, kept_multipliers;

    Inputs(int count, int limits, int joints)
        : count(count),
          limits(limits),
          joints(joints),
          torque(4 * count * joints),
          torque_bias(joints),
          balance(24 * count),
          rows(4 * count * limits),
          bound(limits),
          shares(limits),
          divisor(4 * count),
          preload(count),
          weights(count),
          sizes(limits),
          row_weights(limits),
          z(4 * count),
          row(4 * count),
          record(record_size(count)),
          multipliers(limits),
          kept_multipliers(limits) {}
    static std::size_t bytes_needed(int count, int limits, int joints) {
      return Arena::bytes_needed<double>(4 * std::size_t(count) * joints) +
             Arena::bytes_needed<double>(joints) + Arena::bytes_needed<double>(24 * count) +
             Arena::bytes_needed<double>(4 * std::size_t(count) * limits) +
             6 * Arena::bytes_needed<double>(limits) + 3 * Arena::bytes_needed<double>(4 * count) +
             Arena::bytes_needed<double>(count) + Arena::bytes_needed<Weights<double, 4>>(count) +
             Arena::bytes_needed<double>(record_size(count));
    }
    bool set(const Contacts& contacts) {
      double total = 0.0;
      for (int i = 0; i < count; ++i) {
        std::copy_n(contacts.divisor.begin() + 3 * i, 3, divisor.begin() + 4 * i);
        divisor[4 * i + 3] = divisor_of(contacts.torsion_scale(i));
        weights[i] = weights_of(contacts, i);
        const Vec6 moment = contacts.torsion_wrench(i);
        for (int r = 0; r < 6; ++r) {
          double* part = &balance[4 * (count * r + i)];
          for (int a = 0; a < 3; ++a) part[a] = contacts.rows[3 * (count * r + i) + a];
          part[3] = moment[r] / divisor[4 * i + 3];
          for (int a = 0; a < 4; ++a) total += std::abs(part[a]);
        }
      }
      return total < infinity;
    }
    bool set(const ForceLimits& hand, int width, const Preload& shift) {
      int k = 0;
      bool good = true;
      if (shift.any) std::copy_n(shift.each.begin(), count, preload.begin());
      for (int j = 0; j < joints; ++j) {
        torque_bias[j] = hand.torque_bias.empty() ? 0.0 : hand.torque_bias[j];
        for (int i = 0; i < count; ++i)
          for (int a = 0; a < width; ++a) {
            const double moves = hand.jacobian[hand.torque_limit.size() * (width * i + a) + j];
            torque[4 * (count * j + i) + a] = moves / divisor[4 * i + a];
            if (a == 0) torque_bias[j] += moves * preload[i];
          }
      }
      hand.rows(
          count, width, std::span(row).first(width * count),
          [&](std::span<const double> from, double b, double limit) {
            double* to = &rows[4 * count * k];
            double square = 0.0, lambda = 0.0, all = 0.0;
            int touched = 0;
            for (int i = 0; i < count; ++i, to += 4) {
              for (int a = 0; a < 3; ++a) to[a] = from[width * i + a] / divisor[4 * i + a];
              to[3] = width == 4 ? from[4 * i + 3] / divisor[4 * i + 3] : 0.0;
              const double part = to[0] * to[0] + to[1] * to[1] + to[2] * to[2] + to[3] * to[3];
              const double weight = weights[i].lambda;
              square += part;
              all += weight;
              if (part > 0.0) {
                lambda += weight;
                ++touched;
              }
            }
            // zero: no force changes this torque
            const double size = sizes[k] = square == 0.0 ? 1.0 : std::sqrt(square);
            const double per = 1.0 / size;
            for (to = &rows[4 * count * k]; to < &rows[0] + 4 * count * (k + 1); ++to) *to *= per;
            bound[k] = b / size;
            shares[k] = limit / size;
            row_weights[k] = touched ? lambda / touched : all / count;
            good = good && size < infinity && std::abs(bound[k]) <= MOST_FORCE &&
                   std::abs(shares[k]) <= MOST_FORCE;
            ++k;
          },
          shift);
      return good;
    }
    // (u, o, t, v) from forces and torsions (null: zero), and back
    void load(const double* force, const double* torsion) {
      for (int i = 0; i < count; ++i)
        for (int a = 0; a < 4; ++a) {
          const double per = divisor[4 * i + a];
          const double part = a < 3 ? force[3 * i + a] : torsion ? torsion[i] : 0.0;
          z[4 * i + a] = per < infinity ? per * part : 0.0;
        }
    }
    void store(const double* from, double* force, double* torsion) const {
      for (int i = 0; i < count; ++i, from += 4) {
        for (int a = 0; a < 3; ++a) force[3 * i + a] = from[a] / divisor[4 * i + a];
        if (torsion) torsion[i] = from[3] / divisor[4 * i + 3];
      }
    }
  };
  Arena arena_;
  std::optional<Inputs> inputs_;
  std::optional<Program> program_;

  static std::size_t clamped_size(std::size_t bytes) { return bytes <= LARGEST_ROOM ? bytes : 0; }
  static std::size_t bytes_needed(int count, int limits, int several, int torques, bool soft) {
    return Inputs::bytes_needed(count, limits, torques) +
           Program::bytes_needed(count, limits, several, torques, soft);
  }
  void forget() {
    program_.reset();
    inputs_.reset();
  }

  static double gap(const Summary& of) { return of.objective - of.lower_bound; }
  static bool gap_exceeds_rounding(const Summary& of, double tolerance) {
    const double bound = of.lower_bound;
    return !(bound > 0.0 && gap(of) <= std::max(tolerance, LAST_DIGITS) * bound &&
             gap(of) >= -LAST_DIGITS * bound);
  }
  Code least(const double* wrench, Criterion criterion, const StopRule& options, int budget,
             const Record& record) {
    return unscale_multipliers(
        program_->least(wrench, criterion, options, record, inputs_->multipliers.data(), budget));
  }
  Code least_phi(const Call& call, const Record& record) {
    Inputs& inputs = *inputs_;
    return unscale_multipliers(program_->least_phi(call, inputs.weights.data(),
                                                   inputs.row_weights.data(), inputs.z.data(),
                                                   record, inputs.multipliers.data()));
  }
  Code unscale_multipliers(Code code) {
    for (int k = 0; k < inputs_->limits; ++k) inputs_->multipliers[k] /= inputs_->sizes[k];
    return code;
  }
  Deepest deepest(const double* wrench, double tolerance = 1e-7, bool inside = false) {
    const Deepest result = program_->deepest(wrench, tolerance, inputs_->z.data(),
                                             inputs_->multipliers.data(), inside);
    unscale_multipliers(result.code);
    return result;
  }
  // Find the deepest force, in z. If the wrench is nearly zero, its deepest force is far from the
  // optimum of Phi: balance that of the zero wrench.
  Deepest begin(const double* wrench) {
    const double nothing[6] = {};
    if (std::all_of(wrench, wrench + 6, [](double part) { return std::abs(part) < NEARLY_ZERO; })) {
      const Deepest result = deepest(nothing);
      if (result.code == CONVERGED) {
        program_->balance(wrench, inputs_->z.data());
        if (program_->slack(inputs_->z.data()) > 0.0) return result;
      }
    }
    return deepest(wrench);
  }
  // True if the call has a start, which goes into z.
  bool has_start(const Call& call) {
    if (call.start == From::combination || !call.force) return false;
    inputs_->load(call.force, call.torsion);
    double* z = inputs_->z.data();
    if (program_->is_out_of_reach(call.wrench)) return false;
    if (call.start == From::given) {
      double most = 0.0;
      for (int j = 0; j < 3 * inputs_->count; ++j) most = std::max(most, std::abs(call.force[j]));
      const double size = most + program_->unit_size(call.wrench);
      if (!(program_->missed(call.wrench, z) <= BALANCE_TOLERANCE * size)) return false;
    } else {
      program_->balance(call.wrench, z);
    }
    return program_->slack(z) > 0.0;
  }
  // If the wrench is next to the boundary of the constraints, replace a record without an optimum
  // by the optimum for a wrench just inside, see `Deepest`. Return true if that converged.
  bool phi_inside(const Call& call, const Record& record) {
    if (call.optimum == call.optimum || call.traced || call.stop.limit <= 0) return false;
    inputs_->kept_multipliers = inputs_->multipliers;
    const Deepest result = deepest(call.wrench, 1e-7, true);
    const Record next(inputs_->record.data(), inputs_->count);
    bool good = result.code == CONVERGED && result.moved;
    if (good) {
      least_phi({.wrench = result.wrench.data(), .stop = call.stop}, next);
      stand_for(result.wrench, call, next);
      good = next.code() == CONVERGED;
    }
    if (good)
      replace_record(next, record);
    else
      inputs_->multipliers = inputs_->kept_multipliers;
    return good;
  }
  void stand_for(const Vec6& balanced, const Call& call, const Record& record) {
    detail::stand_for(record, balanced, call.wrench,
                      missed(call.wrench, record.force(), record.torsion()), call.stop.tolerance);
  }
  // Write the proof that no force exists, or UNDECIDED.
  Code refute(const Deepest& result, const double* wrench, const Record& record) {
    if (result.code != INFEASIBLE)
      std::fill(inputs_->multipliers.begin(), inputs_->multipliers.end(), 0.0);
    record.clear();
    std::copy(wrench, wrench + 6, record.summary().wrench.begin());
    if (result.code == INFEASIBLE) return record.refute(result.twist, program_->unit_size(wrench));
    record.summary().code = UNDECIDED;
    return UNDECIDED;
  }
  // Replace a record by a later solution; the initial force stays, steps add up.
  Code replace_record(const Record& next, const Record& record) {
    const int count = inputs_->count;
    Summary& to = record.summary();
    const double iterations = to.iterations, trials = to.trials;
    to = next.summary();
    to.iterations += iterations;
    to.trials += trials;
    std::copy(next.force(), next.force() + 3 * count, record.force());
    std::copy(next.torsion(), next.torsion() + count, record.torsion());
    return record.code();
  }
};

}  // namespace grasp
