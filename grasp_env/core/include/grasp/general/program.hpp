// The general program of a grasp: soft, elliptic and frictionless contacts, smallest and largest normal forces, joint torques. It
// minimises the sum or the maximum of the normal forces, or the excess over limits that no force keeps (`excess.hpp`, for any rows
// and contacts), or Phi, and finds the force deepest inside all constraints or the twist that proves that none is inside. Forces
// are scaled by the least-norm one, so tolerances mean the same from 1e-6 to 1e4 N.
//
// This file is long because all these objectives share the starts, certificates and record of one program.
#pragma once
#include <climits>
#include <optional>
#include <variant>
#include <grasp/general/deepest.hpp>
#include <grasp/newton/excess.hpp>
#include <grasp/general/phi_rows.hpp>

namespace grasp {
namespace detail {

template <int D> class ProgramOn {
public:
    using Field = typename Constraints<D>::Field;
    template <class R, int T> using Engine = InteriorPoint<R, D, T>;

    explicit ProgramOn(const ProgramData& given)
        : count(given.count), limits(given.limits), in_(given), may_exceed_(given.elastic), internal_force_(count),
          inside_(count), z_(count), best_(count), slacks_(in_.slacks()), slacks_inside_(in_.slacks()), prices_(limits),
          best_prices_(limits) {}
    // Memory of a program and of its solves, whose engines live for one call. joints: largest number of rows that act on several
    // contacts.
    static std::size_t bytes_needed(int count, int limits, int joints) {
        const auto most = [&](int joint) {
            const int owns = limits - joint + count + 1, rows = joint + 7;
            const std::size_t depth = InteriorPoint<DoubleDouble, D, 2>::bytes_needed(count, rows, owns);
            const std::size_t least = InteriorPoint<double, D, 1>::bytes_needed(count, rows, owns);
            const std::size_t careful = InteriorPoint<DoubleDouble, D, 1>::bytes_needed(count, rows, owns);
            return depth + careful + std::max(least, PhiRows<double, D>::bytes_needed(count, rows, owns, limits));
        };
        return Constraints<D>::bytes_needed(count, limits) + 8 * Arena::bytes_needed<Tuple<double, D>>(count) +
               3 * Arena::bytes_needed<double>(2 * count + limits) + 4 * Arena::bytes_needed<double>(limits) +
               std::max(most(0), most(joints));
    }

    // See `Program`.
    Code least(const double* wrench, Criterion criterion, const StopRule& options, const Record& record, double* prices,
               int budget);

    Deepest deepest(const double* wrench, double tolerance, double* z, double* prices, bool inside = false);

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
        in_.write_slacks(internal_force_, in_.torsions, slacks_, [](int) { return 0.0; });
        double most = 0.0;
        for (const auto& each : internal_force_) most = std::max(most, each[0]);
        if (least_of(slacks_) > DEEP * most) has_internal_force_ = true;
        return has_internal_force_.has_value();
    }
    double unit_size(const double* wrench) const { return grasp::size(in_.in_frame(wrench)); }
    bool independent() const { return in_.independent(); }
    bool is_out_of_reach(const double* wrench) const { return in_.is_out_of_reach(in_.in_frame(wrench)); }

    Code least_phi(const Call& call, const double* weights, const double* row_weights, const double* z, const Record& record,
                   double* prices);

private:
    static constexpr double ROUNDED = 1e-15;  // fraction of the forces: effect of their rounding on balance
    // Smallest margin of an internal force; less would be useful only with millions of newtons.
    static constexpr double DEEP = 1e-6;
    // Bound of the normal forces when minimising an excess, relative to the largest normal force of the start.
    static constexpr double MOST = 1e4;
    static constexpr double BEGIN = 1.5;  // of a start's excess: initial increase of the limits
    static constexpr int FIRST_TRY = 40;  // iterations before another start or more digits are tried; a dozen is usual
    static constexpr int PATIENCE = 200;  // iterations on Phi before the central path is tried; twenty are usual
    static constexpr double FALL = 30.0;  // factor on lambda between stages of the path
    int count, limits;
    Constraints<D> in_;
    bool may_exceed_;
    // An internal force strictly inside the cones; a force strictly inside everything; work space.
    Field internal_force_, inside_, z_, best_;
    std::optional<bool> has_internal_force_;  // empty: not searched yet
    bool has_inside_ = false;
    bool moved_ = false;  // true if `unit_` is not quite the wrench of this call: see `Deepest`
    ArenaVector<double> slacks_, slacks_inside_, prices_, best_prices_;
    Vec6 unit_{}, turned_{}, best_nu_{};  // wrench of this call, scaled to size one; L^-1 of it
    Criterion criterion_ = Criterion::sum;
    int budget_ = INT_MAX;  // iterations of all attempts together
    double tolerance_ = 0.0;  // required gap
    double excess_unit_ = 1.0, most_ = 1.0;  // the excess of one unit of t; the largest normal force considered
    double size_ = 1.0, best_value_ = infinity, best_bound_ = 0.0, residual_ = 0.0, best_residual_ = 0.0;

    void load_z(const double* z, Field& to) const {
        for (int i = 0; i < count; ++i) std::copy(z + 4 * i, z + 4 * i + D, to[i].begin());
    }
    void store_z(const Field& from, double* z) const {
        for (int i = 0; i < count; ++i)
            for (int a = 0; a < 4; ++a) z[4 * i + a] = a < D ? from[i][a] : 1.0;
    }
    // True if the excess is minimised.
    bool elastic() const { return criterion_ == Criterion::excess; }
    // The normal force of a unit of u; weighted, unless excesses are minimised.
    double price(int i) const { return elastic() ? in_.price[i] : in_.cost[i]; }
    int kept() const { return elastic() ? in_.torsions : limits; }  // limits that no force may exceed

    template <int T> Code solve(const double* wrench, const StopRule& options, Summary& out) {
        int spent = 0;
        // start from a strictly feasible z if one is known; first in double, then in higher precision
        const auto attempt = [&](auto& engine, bool known) {
            set_right(engine);
            if (known) place_inside(engine);
            else if (begin(engine)) inside_from_start(engine);
            const int left = std::min(options.limit, budget_ - spent);
            const int limit = std::min(left, keeps_interior(engine) ? left : FIRST_TRY);
            const double enough = elastic() ? EXCESS_FLOOR / excess_unit_ : 0.0;
            const Code code = engine.run(options.tolerance, enough, keeps_interior(engine) ? 0.1 : 0.0, limit,
                                         [&] { return consider(engine); });
            spent += engine.iterations;
            if (code != CONVERGED && consider(engine) <= options.tolerance) return CONVERGED;
            return code == LIMIT && limit < left ? STALLED : code;
        };
        auto quick = in_.template engine<double, T>(limits, criterion_);
        Code code = attempt(quick, false);
        if (code != CONVERGED && !has_inside_) {
            const Arena::Scope scope;
            Depth depth(in_, kept());
            const Deepest found = depth.find(wrench, 1e-7, z_);
            if (found.code != CONVERGED) {
                prices_ = depth.prices();
                out.multipliers = found.twist, out.iterations = spent;
                return found.code == INFEASIBLE ? INFEASIBLE : REFUSED;
            }
            take_inside(found);
            if (consider(quick) <= options.tolerance) code = CONVERGED;
            else if (options.limit > 0) code = attempt(quick, true);
        }
        if (code == STALLED) {
            auto careful = in_.template engine<DoubleDouble, T>(limits, criterion_);
            code = attempt(careful, has_inside_);
            if (code == STALLED && !elastic() && !moved_) {
                const Best before{best_, best_prices_, unit_, turned_, best_nu_, best_value_, best_bound_, best_residual_};
                if (move_off_boundary(wrench)) code = attempt(careful, true);
                if (moved_ && code != CONVERGED && before.value < infinity) restore(before), code = STALLED;
            }
        }
        out.iterations = out.trials = spent;
        return code;
    }
    // The best force so far, and the wrench that it balances.
    struct Best {
        Field force;
        ArenaVector<double> prices;
        Vec6 unit, turned, nu;
        double value, bound, residual;
    };
    void restore(const Best& from) {
        best_ = from.force, best_prices_ = from.prices, unit_ = from.unit, turned_ = from.turned, best_nu_ = from.nu;
        best_value_ = from.value, best_bound_ = from.bound, best_residual_ = from.residual, moved_ = false;
    }
    // Take over the force in z_, which is strictly inside, and the wrench that it balances.
    void take_inside(const Deepest& found) {
        for (int i = 0; i < count; ++i)
            for (int a = 0; a < D; ++a) inside_[i][a] = z_[i][a] / size_;
        has_inside_ = true;
        if (!found.moved) return;
        unit_ = (1.0 / size_) * in_.in_frame(found.wrench.data()), turned_ = in_.solve_lower(unit_), moved_ = true;
        best_value_ = infinity, best_bound_ = 0.0, best_nu_ = Vec6{};
        std::fill(best_prices_.begin(), best_prices_.end(), 0.0);
    }
    // If the wrench is next to the boundary of the constraints, replace it by one just inside, see `Deepest`.
    bool move_off_boundary(const double* wrench) {
        const Arena::Scope scope;
        const Deepest found = Depth(in_, kept()).find(wrench, 1e-7, z_, true);
        if (found.code != CONVERGED || !found.moved) return false;
        take_inside(found);
        return true;
    }
    // True if the last iterate strictly inside in doubles is kept, to be mixed with the next ones.
    template <class R, int T> static constexpr bool keeps_interior(const Engine<R, T>&) {
        return std::is_same_v<R, DoubleDouble>;
    }
    template <class Engine> void set_right(Engine& engine) const {
        auto& joint = engine.rows.right;
        for (int r = 0; r < engine.rows.joint; ++r) joint[r] = r < 6 ? -turned_[r] : in_.bound[engine.rows.label[r]] / size_;
        for (auto& row : engine.rows.own) row.right = row.label >= 0 ? in_.bound[row.label] / size_ : 0.0;
    }
    // Largest relative excess of a limit at z.
    double excess(const Field& z) const {
        double most = 0.0;
        for (int k = in_.torsions; k < limits; ++k)
            if (in_.shares[k] > 0.0) most = std::max(most, (size_ * in_.product(in_.limit[k], z) - in_.bound[k]) / in_.shares[k]);
        return most;
    }
    // Set t in units of an excess above that of the start z, so that it begins at one; normal forces are bounded by a multiple of
    // those of z.
    template <class R> void raise(Engine<R, 1>& engine, const Field& z) {
        excess_unit_ = BEGIN * excess(z) + EXCESS_FLOOR, most_ = 1.0, best_bound_ = 0.0;
        for (int i = 0; i < count; ++i) most_ = std::max(most_, price(i) * z[i][0]);
        most_ *= MOST;
        const auto raise = [&](Tuple<R, 1>& shared, int name) {
            if (name >= 0) shared[0] = -excess_unit_ * in_.shares[name] / size_;
        };
        for (int r = 0; r < engine.rows.joint; ++r) raise(engine.rows.coupling[r], engine.rows.label[r]);
        for (auto& row : engine.rows.own) {
            raise(row.shared, row.label);
            if (row.label < 0 && row.contact < count) row.right = most_;
        }
    }
    template <class R, int T> void inside_from_start(const Engine<R, T>& engine) {
        for (int i = 0; i < count; ++i) inside_[i] = narrow(engine.at.z[i]);
        has_inside_ = true;
    }
    template <class R, int T> void place_inside(Engine<R, T>& engine) {
        for (int i = 0; i < count; ++i) engine.at.z[i] = wide<R>(inside_[i]);
        place(engine, 0.0);
    }
    // Write a start. Return true if it is balanced and strictly inside all constraints.
    template <class R, int T> bool begin(Engine<R, T>& engine) {
        if (!has_internal_force_) {
            const Arena::Scope scope;
            const double nothing[6] = {};
            const Deepest found = Depth(in_, in_.torsions).find(nothing, 1e-2, internal_force_);
            has_internal_force_ = found.code == CONVERGED && found.margin > DEEP;
        }
        if (*has_internal_force_) {
            for (auto& each : z_) each = {};
            in_.subtract(z_, turned_);
            double squeeze = 1e-6;
            in_.write_slacks(z_, in_.torsions, slacks_, [](int) { return 0.0; });
            in_.write_slacks(internal_force_, in_.torsions, slacks_inside_, [](int) { return 0.0; });
            for (std::size_t k = 0; k < slacks_.size(); ++k)
                if (slacks_[k] < infinity) squeeze = std::max(squeeze, -slacks_[k] / slacks_inside_[k]);
            for (int i = 0; i < count; ++i) {
                add(z_[i], 1.3 * squeeze, internal_force_[i]);
                if (D == 4 && !in_.soft[i]) z_[i][D - 1] = 1.0;
            }
        } else {
            for (auto& each : z_) each = in_.inwards();
        }
        for (int i = 0; i < count; ++i) engine.at.z[i] = wide<R>(z_[i]);
        const bool slack = place(engine, *has_internal_force_ ? 1e-3 : 1.0);
        return *has_internal_force_ && slack;
    }

    // Set slacks and a dual strictly inside for the z of a start: s = c + the limits' part, with balance's multipliers zero. Slacks
    // below `least` times the largest force are lifted to it. Return false if any was.
    template <class R, int T> bool place(Engine<R, T>& engine, double least) {
        auto& at = engine.at;
        const auto& rows = engine.rows;
        R largest = 0.0, product = 0.0, normal = 0.0;
        for (int i = 0; i < count; ++i) {
            largest = max(largest, at.z[i][0]), normal = max(normal, price(i) * at.z[i][0]);
            at.s[i] = engine.cost[i];
            if constexpr (T == 1) at.s[i][0] = price(i) / count;
            product += at.z[i][0] * at.s[i][0] / count;
            if (D == 4) at.s[i][D - 1] = in_.soft[i] ? 0.25 * at.s[i][0] : R(1.0);
        }
        if constexpr (T == 1) {
            at.t = {2.0 * normal};
            if (elastic()) {
                for (int i = 0; i < count; ++i) z_[i] = narrow(at.z[i]);
                raise(engine, z_), at.t = {1.0};
            }
        }
        bool kept = true;
        const R floor = max(least * largest, 1e-12 * largest);
        const auto lift = [&](const R& slack) {
            if (slack > 0.0 && least == 0.0) return slack;
            kept = kept && slack > 0.0;
            return max(slack, floor);
        };
        const double share = 0.1 / std::max(1, limits - in_.torsions);
        for (int i = 0; i <= count; ++i)
            for (int k = rows.first[i]; k < rows.first[i + 1]; ++k) {
                const auto& row = rows.own[k];
                R slack = row.right - inner(row.shared, at.t);
                if (i < count) slack -= inner(row.row, at.z[i]);
                at.own_slack[k] = lift(slack);
                if (row.label < 0) at.own[k] = R(1.0) / count;
                else if (row.label < in_.torsions) at.own[k] = at.s[i][D - 1] / row.row[D - 1];
                else at.own[k] = min(product / at.own_slack[k], R(i < count ? share * engine_price<T>(i) : 1.0));
            }
        for (int r = 0; r < rows.joint; ++r) {
            at.joint[r] = at.joint_slack[r] = 0.0;
            if (r < rows.equal) continue;
            R slack = rows.right[r] - inner(rows.coupling[r], at.t), price = infinity;
            for (int i = 0; i < count; ++i)
                slack -= inner(rows.columns[rows.joint * i + r], at.z[i]), price = min(price, R(engine_price<T>(i)));
            at.joint_slack[r] = lift(slack);
            at.joint[r] = min(product / at.joint_slack[r], share * price);
        }
        if constexpr (T == 1)
            if (elastic()) {  // t's price from its equation, if that is positive
                R left = 1.0;
                for (int r = rows.equal; r < rows.joint; ++r) left += at.joint[r] * rows.coupling[r][0];
                for (std::size_t k = 0; k + 1 < rows.own.size(); ++k) left += at.own[k] * rows.own[k].shared[0];
                at.own.back() = max(left, R(1e-3));
            }
        for (int i = 0; i < count; ++i) {  // s from its equation
            Tuple<R, D> s = engine.cost[i];
            for (int k = rows.first[i]; k < rows.first[i + 1]; ++k) add(s, at.own[k], rows.own[k].row);
            for (int r = rows.equal; r < rows.joint; ++r) add(s, at.joint[r], rows.columns[rows.joint * i + r]);
            if (D == 4 && !in_.soft[i]) s[D - 1] = 1.0;
            at.s[i] = s;
        }
        return kept;
    }
    template <int T> double engine_price(int i) const { return T == 1 ? price(i) / count : price(i); }

    // Balance the iterate, bring it within the limits and bound its objective; keep the best force and the best bound. Return the
    // gap.
    template <class R, int T> double consider(const Engine<R, T>& engine) {
        const auto right = [&](int k) { return in_.bound[k] / size_; };
        for (int i = 0; i < count; ++i) z_[i] = narrow(engine.at.z[i]);
        residual_ = in_.rebalance(z_, unit_);
        in_.write_slacks(z_, kept(), slacks_, right);
        double least = least_of(slacks_);
        if (least > 0.0 && keeps_interior(engine)) inside_ = z_, has_inside_ = true;
        if (least < 0.0 && has_inside_) {  // mix with just enough of a force inside to restore the last digits
            in_.write_slacks(inside_, kept(), slacks_inside_, right);
            double part = 0.0;
            for (std::size_t k = 0; k < slacks_.size(); ++k)
                if (slacks_[k] < 0.0) part = std::max(part, -slacks_[k] / (slacks_inside_[k] - slacks_[k]));
            part = std::min(1.0, 1.01 * part);
            for (int i = 0; i < count; ++i)
                for (int a = 0; a < D; ++a) z_[i][a] = (1.0 - part) * z_[i][a] + part * inside_[i][a];
            residual_ = grasp::size(in_.wrench_of(z_) + unit_);
            in_.write_slacks(z_, kept(), slacks_, right);
            least = least_of(slacks_);
        }
        certify(engine);
        double force = 0.0;
        for (int i = 0; i < count; ++i) {
            const double normal = price(i) * z_[i][0];
            force = T == 1 ? std::max(force, normal) : force + normal;
        }
        const double value = elastic() ? excess(z_) : force;
        const bool good = least >= 0.0 && residual_ <= BALANCED * grasp::size(unit_) + (ROUNDED + in_.reach.rounding) * force;
        if (good && value < best_value_) best_value_ = value, best_ = z_, best_residual_ = residual_;
        return gap();
    }
    double gap() const {
        if (!(best_value_ < infinity)) return infinity;
        const double found = elastic() ? (best_value_ - best_bound_) / std::max(best_bound_, EXCESS_FLOOR / EXCESS_WITHIN)
                             : best_bound_ > 0.0  ? (best_value_ - best_bound_) / best_bound_
                             : best_value_ == 0.0 ? 0.0
                                                  : infinity;
        return found >= -tolerance_ ? found : infinity;  // rounding of the balance may take it below its bound
    }

    // Dual value at the multipliers, moved towards interior ones until feasible: s = c + C^T y in the dual cones, y >= 0 for the
    // limits. For an excess: at multipliers that price t at one; what they lack of the dual cones is paid by forces up to most_.
    template <class R, int T> void certify(const Engine<R, T>& engine) {
        const auto& rows = engine.rows;
        const auto& at = engine.at;
        double shares = 0.0;
        for (int k = 0; k < int(rows.own.size()); ++k) {
            if (rows.own[k].label >= 0) prices_[rows.own[k].label] = std::max(double(at.own[k]), 0.0);
            else shares += std::max(double(at.own[k]), 0.0);
        }
        for (int r = rows.equal; r < rows.joint; ++r) prices_[rows.label[r]] = std::max(double(at.joint[r]), 0.0);
        double theta = 1.0, paid = 0.0;
        if (elastic()) {
            double price = 0.0;
            for (int k = in_.torsions; k < limits; ++k) price += prices_[k] * in_.shares[k];
            theta = price > 0.0 ? size_ / price : 0.0;
        }
        for (int i = 0; i < count; ++i) {
            Tuple<double, D> safe{}, end{};
            safe[0] = engine_price<T>(i), end[0] = elastic() ? 0.0 : price(i);
            if (T == 1 && !elastic()) end[0] *= std::max(double(at.own[rows.first[i + 1] - 1]), 0.0) / shares;
            for (int r = 0; r < 6; ++r) add(end, double(at.joint[r]), in_.turn[r][i]);
            for (int r = rows.equal; r < rows.joint; ++r) add(end, prices_[rows.label[r]], in_.limit[rows.label[r]][i]);
            for (int k = rows.first[i]; k < rows.first[i + 1]; ++k)
                if (rows.own[k].label >= 0) add(end, prices_[rows.own[k].label], in_.limit[rows.own[k].label][i]);
            if (D == 4 && in_.soft[i] && end[D - 1] < 0.0) {
                // w has no cost: raise its row's multiplier, at the expense of u
                const Tuple<double, D>& row = in_.limit[in_.torsion_row[i]][i];
                const double raised = -end[D - 1] / row[D - 1];
                prices_[in_.torsion_row[i]] += raised, add(end, raised, row);
            }
            const Vec3<double> last = cone(end);
            if (slack(last) >= 0.0) continue;
            if (elastic()) {
                paid -= slack(last) * most_ / price(i);
                continue;
            }
            const double per = Boundary<double>(cone(safe)).per(last - cone(safe));
            theta = per > 1.0 ? std::min(theta, 1.0 / per) : per == per ? theta : 0.0;
        }
        double value = 0.0;
        Vec6 y;
        for (int r = 0; r < 6; ++r) y[r] = double(at.joint[r]), value += y[r] * turned_[r];
        for (int k = 0; k < limits; ++k) value -= prices_[k] * in_.bound[k] / size_;
        value = theta * (value - paid);
        if (value > best_bound_ && value < infinity) {
            best_bound_ = value, best_nu_ = -theta * y;
            for (int k = 0; k < limits; ++k) best_prices_[k] = theta * prices_[k];
        }
    }

    // Write Phi's optimum. CONVERGED requires that the returned force is balanced, inside, and has a gap within the tolerance.
    template <class R> Code write_phi(PhiRows<R, D>& engine, Code code, const Call& call, const Record& record, double* prices) {
        for (int i = 0; i < count; ++i) best_[i] = narrow(engine.z[i]);
        best_residual_ = in_.rebalance(best_, unit_);
        for (double part = 1e-15;; part = std::min(1.0, 4.0 * part)) {  // moves what rounding took outside back towards the start
            for (int i = 0; i < count; ++i) engine.z[i] = wide<R>(best_[i]);
            engine.evaluate();
            in_.write_slacks(best_, limits, slacks_, [&](int k) { return in_.bound[k]; });
            if ((least_of(slacks_) >= 0.0 && engine.value < infinity) || best_ == inside_) break;
            for (int i = 0; i < count; ++i)
                for (int a = 0; a < D; ++a)
                    best_[i][a] = part < 1.0 ? best_[i][a] + part * (inside_[i][a] - best_[i][a]) : inside_[i][a];
            best_residual_ = grasp::size(in_.wrench_of(best_) + unit_);
        }
        best_value_ = double(engine.value), best_bound_ = double(engine.bound);
        for (int r = 0; r < 6; ++r) best_nu_[r] = -double(engine.proof.joint[r]);
        for (int k = 0; k < int(engine.rows.own.size()); ++k)
            best_prices_[engine.rows.own[k].label] = double(engine.proof.own[k]);
        for (int r = engine.rows.equal; r < engine.rows.joint; ++r)
            best_prices_[engine.rows.label[r]] = double(engine.proof.joint[r]);
        double force = 0.0;
        for (int i = 0; i < count; ++i) force = std::max(force, best_[i][0]);
        const bool good = least_of(slacks_) >= 0.0 && best_residual_ <= BALANCED * (force + grasp::size(unit_));
        const bool near = best_bound_ > 0.0 && best_value_ - best_bound_ <= call.stop.tolerance * best_bound_;
        if (code == CONVERGED && !(good && (near || call.optimum == call.optimum))) code = STALLED;
        write(code, record, prices);
        record.summary().iterations = engine.iterations, record.summary().trials = engine.trials;
        return code;
    }

    void write(Code code, const Record& record, double* prices) {
        Summary& out = record.summary();
        if (!(best_value_ < infinity)) {  // the last force known to be inside, or none
            if (!has_inside_ || elastic()) {
                out.code = REFUSED;
                return;
            }
            best_ = inside_;
        }
        const double unit = elastic() ? 1.0 : size_;  // unit of the objective
        out.code = code, out.objective = unit * best_value_, out.lower_bound = unit * best_bound_;
        if (elastic()) {
            out.code = code == CONVERGED ? LIMITS_EXCEEDED : code, out.limit_excess = best_value_;
            best_nu_ = (1.0 / size_) * best_nu_;
            for (double& price : best_prices_) price /= size_;
        }
        out.residual = size_ * best_residual_, out.multipliers = in_.pull_back(best_nu_), out.margin = infinity;
        for (int i = 0; i < count; ++i) {
            Vec3<double> x = cone(best_[i]);
            double* force = record.force() + 3 * i;
            for (int a = 0; a < 3; ++a) force[a] = size_ * x[a] / in_.divisor[4 * i + a];
            std::copy(force, force + 3, record.initial_force() + 3 * i);
            if (D == 4 && in_.soft[i]) record.torsion()[i] = size_ * (best_[i][0] - best_[i][D - 1]) / in_.divisor[4 * i + 3];
            for (int a = 1; a < 3; ++a)
                if (!(in_.divisor[4 * i + a] < infinity)) x[a] = 0.0;
            out.margin = std::min(out.margin, size_ * slack(x));
        }
        std::copy(best_prices_.begin(), best_prices_.end(), prices);
    }
};

// Not inline: a file that declares `extern template class ProgramOn<D>` compiles nothing of it.
template <int D> Code ProgramOn<D>::least(const double* wrench, Criterion criterion, const StopRule& options,
                                          const Record& record, double* prices, int budget) {
    const Arena::Scope scope;
    record.clear();
    std::fill(prices, prices + limits, 0.0);
    Summary& out = record.summary();
    out.code = REFUSED;
    if (!is_valid_wrench(wrench) || (criterion == Criterion::excess && !may_exceed_)) return REFUSED;
    std::copy(wrench, wrench + 6, out.wrench.begin());
    criterion_ = criterion, budget_ = budget, tolerance_ = options.tolerance;
    const Vec6 load = in_.in_frame(wrench);
    if (in_.is_out_of_reach(load)) return REFUSED;  // `deepest` has the proof
    const Vec6 turned = in_.solve_lower(load);
    size_ = in_.largest_of(turned);
    double most = 0.0;
    for (int k = 0; k < limits; ++k) most = std::max(most, -in_.bound[k]);
    if (size_ < NOTHING && !(most > 0.0)) {  // zero force is the answer
        out.code = CONVERGED;
        return CONVERGED;
    }
    size_ = std::max(size_, most);
    unit_ = (1.0 / size_) * load, turned_ = (1.0 / size_) * turned;
    best_value_ = infinity, best_bound_ = 0.0, best_nu_ = Vec6{}, residual_ = 0.0;
    std::fill(best_prices_.begin(), best_prices_.end(), 0.0);
    has_inside_ = moved_ = false;
    const Code code = criterion == Criterion::sum ? solve<0>(wrench, options, out) : solve<1>(wrench, options, out);
    if (code == INFEASIBLE) {
        std::copy(prices_.begin(), prices_.end(), prices);
        return record.refute(out.multipliers, size(load));
    }
    if (code == REFUSED) return code;
    write(code, record, prices);
    if (moved_) {
        const double residual = grasp::size(size_ * in_.wrench_of(best_) + load);
        stand_for(record, in_.given(size_ * unit_), wrench, residual, options.tolerance);
    }
    return Code(int(out.code));
}

template <int D> Deepest ProgramOn<D>::deepest(const double* wrench, double tolerance, double* z, double* prices, bool inside) {
    const Arena::Scope scope;
    std::fill(prices, prices + limits, 0.0);
    Deepest found;
    if (!is_valid_wrench(wrench)) return found;
    Depth depth(in_, limits);
    found = depth.find(wrench, tolerance, inside_, inside);
    if (found.code == INFEASIBLE) std::copy(depth.prices().begin(), depth.prices().end(), prices);
    store_z(inside_, z);
    return found;
}

template <int D> Code ProgramOn<D>::least_phi(const Call& call, const double* weights, const double* row_weights, const double* z,
                                              const Record& record, double* prices) {
    const Arena::Scope scope;
    record.clear();
    std::fill(prices, prices + limits, 0.0);
    record.summary().code = REFUSED;
    if (!is_valid_wrench(call.wrench)) return REFUSED;
    std::copy(call.wrench, call.wrench + 6, record.summary().wrench.begin());
    criterion_ = Criterion::sum, size_ = 1.0, unit_ = in_.in_frame(call.wrench), turned_ = in_.solve_lower(unit_);
    load_z(z, inside_);
    has_inside_ = true;
    const auto take_start = [&](auto& engine) {
        set_right(engine);
        for (int i = 0; i < count; ++i) engine.z[i] = wide<std::decay_t<decltype(engine.value)>>(inside_[i]);
    };
    int spent = 0, trials = 0;
    // descend on Phi with lambda multiplied by `raised`
    const auto descend = [&](auto& engine, Call stage, double raised, const StopRule& stop) {
        stage.stop = stop;
        for (int i = 0; i < count; ++i) engine.weights[i] = {weights[2 * i], raised * weights[2 * i + 1]};
        for (int k = 0; k < limits; ++k) engine.row_weights[k] = raised * row_weights[k];
        const Code code = engine.run(stage, LONG);
        spent += engine.iterations, trials += engine.trials;
        return code;
    };
    const auto written = [&](auto& engine, Code code) {
        engine.iterations = spent, engine.trials = trials;
        return code == REFUSED ? code : write_phi(engine, code, call, record, prices);
    };
    const auto [tolerance, limit] = call.stop;
    PhiRows<double, D> quick(in_.template rows<double, 0>(limits), in_.soft, limits);
    take_start(quick);
    const Code first = descend(quick, call, 1.0, {tolerance, std::min(limit, PATIENCE)});
    if (first != STALLED && (first != LIMIT || limit <= PATIENCE)) return written(quick, first);
    // if steps along curved surfaces are short: follow the central path, which stays away from the surfaces
    double raised = 1.0;
    for (int i = 0; i < count; ++i) raised = std::max(raised, weights[2 * i] * z[4 * i] * z[4 * i] / weights[2 * i + 1]);
    PhiRows<DoubleDouble, D> careful(in_.template rows<DoubleDouble, 0>(limits), in_.soft, limits);
    take_start(careful), careful.balance();
    const Call path{.wrench = call.wrench};
    while ((raised /= FALL) > 1.0 && spent < limit)
        if (descend(careful, path, raised, {0.1, std::min(limit - spent, 2 * PATIENCE)}) == REFUSED) break;
    const Code code = descend(careful, call, 1.0, {tolerance, std::min(limit - spent, 2 * PATIENCE)});
    const bool worse = code == REFUSED || (code != CONVERGED && double(careful.value) > double(quick.value));
    if (worse) return written(quick, STALLED);
    return written(careful, code == LIMIT && spent < limit ? STALLED : code);
}

}  // namespace detail

// A general program. Its memory, for construction and calls, comes from the arena in use or from the heap.
class Program {
public:
    const int count, limits;

    explicit Program(const ProgramData& given) : count(given.count), limits(given.limits), on_(made(given)) {}
    // Bytes of an arena; joints: largest number of rows that act on several contacts.
    static std::size_t bytes_needed(int count, int limits, int joints, bool soft) {
        return soft ? detail::ProgramOn<4>::bytes_needed(count, limits, joints)
                    : detail::ProgramOn<3>::bytes_needed(count, limits, joints);
    }

    // Minimise a criterion, into a record, with prices (M,) >= 0 of the limits. INFEASIBLE: the record's multipliers are the twist
    // that proves it. REFUSED: numbers that are not finite, or neither a force nor a proof was found. LIMITS_EXCEEDED: outcome for
    // Criterion::excess, to EXCESS_WITHIN. budget: iterations of all attempts together.
    Code least(const double* wrench, Criterion criterion, const StopRule& options, const Record& record, double* prices,
               int budget = INT_MAX) {
        return std::visit([&](auto& on) { return on.least(wrench, criterion, options, record, prices, budget); }, on_);
    }
    // Find z (N, 4) [N], the force of largest depth m in all cones and rows, where forces and the wrench's share r sum to one, m <=
    // r. INFEASIBLE: prices (M,) are those of the limits in the proof.
    Deepest deepest(const double* wrench, double tolerance, double* z, double* prices, bool inside = false) {
        return std::visit([&](auto& on) { return on.deepest(wrench, tolerance, z, prices, inside); }, on_);
    }
    // Minimise Phi from z (N, 4), balanced and strictly inside, into a record; weights (N, 2) omega and lambda, row_weights (M,).
    // Uses wrench, stop, optimum and trace of the call. REFUSED: no such start.
    Code least_phi(const Call& call, const double* weights, const double* row_weights, const double* z, const Record& record,
                   double* prices) {
        return std::visit([&](auto& on) { return on.least_phi(call, weights, row_weights, z, record, prices); }, on_);
    }
    // Largest component of G z + w, z (N, 4), unit frame [N].
    double missed(const double* wrench, const double* z) {
        return std::visit([&](auto& on) { return on.missed(wrench, z); }, on_);
    }
    // Balance z (N, 4) by the least-norm change.
    void balance(const double* wrench, double* z) {
        std::visit([&](auto& on) { on.balance(wrench, z); }, on_);
    }
    // Smallest slack of z (N, 4) in cones, torsion and rows; above zero: strictly inside, rounding included.
    double slack(const double* z) {
        return std::visit([&](auto& on) { return on.least_slack(z); }, on_);
    }
    // Provide an internal force z (N, 4) for starts. Return false, so that `least` searches for one, unless it is strictly inside
    // the cones and the rows of torsion.
    bool set_internal_force(const double* z) {
        return std::visit([&](auto& on) { return on.set_internal_force(z); }, on_);
    }
    // Largest component of a wrench, unit frame [N].
    double unit_size(const double* wrench) const {
        return std::visit([&](const auto& on) { return on.unit_size(wrench); }, on_);
    }
    // True if the rows of balance are independent within rounding, except those that no contact can change.
    bool independent() const {
        return std::visit([&](const auto& on) { return on.independent(); }, on_);
    }
    // True if no forces, of any sign, make the wrench.
    bool is_out_of_reach(const double* wrench) const {
        return std::visit([&](const auto& on) { return on.is_out_of_reach(wrench); }, on_);
    }

private:
    using On = std::variant<detail::ProgramOn<3>, detail::ProgramOn<4>>;
    On on_;

    static On made(const ProgramData& given) {
        for (int i = 0; i < given.count; ++i)
            if (given.divisor[4 * i + 3] < infinity) return On(std::in_place_index<1>, given);
        return On(std::in_place_index<0>, given);
    }
};

}  // namespace grasp
