// The general program of a grasp: soft, elliptic and frictionless contacts, least and largest normal forces, joint torques; the least sum
// or the least maximum of the normal forces, the least excess over limits that no force keeps (`excess.hpp`, for any rows and contacts),
// and the force deepest inside everything, or the twist that proves that there is none.
//
// Contact i has z_i = (u, o, t, w): cone coordinates and, where it is soft, w = u - |torsion| in units of its limit with a row w <= 2u.
// Balance is taken with orthonormal rows, G = L Q, so that contacts close to each other cost no digits; forces are of the size of the
// least-norm one, so that tolerances mean the same from 1e-6 to 1e4 N.
#pragma once
#include <memory>
#include <optional>
#include "excess.hpp"
#include "interior_point.hpp"
#include "phi_rows.hpp"

namespace grasp {

// A margin up to this, of one for forces that sum to one, counts as the boundary: no force strictly inside.
inline constexpr double CLEAR = 1e-9;

// What a program is made of; arrays are row-major.
struct Given {
    int count, limits;      // N, M
    const double* frame;    // (6, 6) wrenches into the unit frame
    const double* balance;  // (6, N, 4) of (u, o, t, w), unit frame
    const double* rows;     // (M, N, 4) of length one: rows . z <= bound; those of torsion come first
    const double* bound;    // (M,) [N]
    const double* divisor;  // (N, 4) force and torsion from z; inf where nothing is transmitted
    const double* shares;   // (M,) [N] by how much a bound grows where its limit grows by all of itself; 0: never
    bool elastic;           // whether the least excess will be asked
};

// `excess`: the largest part of itself by which a limit is exceeded, t with rows . z <= bound + t share.
enum class Criterion { sum, largest, excess };

struct Deepest {
    Code code = REFUSED;  // INFEASIBLE: no force strictly inside, `twist` is the proof
    int iterations = 0;
    double margin = 0.0;
    Vec6 twist{};  // [linear; angular], largest component one
};

class Program {
public:
    const int count, limits;
    static std::unique_ptr<Program> make(const Given& given);
    virtual ~Program() = default;
    virtual std::unique_ptr<Program> clone() const = 0;

    // Into a record, with prices (M,) >= 0 of the limits. INFEASIBLE: the record's multipliers are the twist that proves it. REFUSED: numbers
    // that are not finite, or neither a force nor a proof was found. LIMITS_EXCEEDED: what `excess` ends with, to EXCESS_WITHIN.
    virtual Code least(const double* wrench, Criterion criterion, const Options& options, const Record& record, double* prices) = 0;
    // z (N, 4) [N]: the force of largest m with depth m in all cones and rows, where forces and the wrench's share r sum to one, m <= r.
    virtual Deepest deepest(const double* wrench, double tolerance, double* z) = 0;

    // The least Phi from z (N, 4), balanced and strictly inside, into a record; weights (N, 2) omega and lambda, row_weights (M,). Of the
    // call wrench, optimum and trace are read. REFUSED: no such start.
    virtual Code least_phi(const Call& call, const double* weights, const double* row_weights, const double* z, const Options& options,
                           const Record& record, double* prices) = 0;

protected:
    Program(int count, int limits) : count(count), limits(limits) {}
};

namespace detail {

template <int D> class ProgramOn final : public Program {
public:
    using Field = std::vector<Tuple<double, D>>;
    template <class R, int T> using Engine = InteriorPoint<R, D, T>;
    // The same program in two precisions: the second is asked where the first ends short.
    template <int T> struct Pair {
        Engine<double, T> quick;
        Engine<Twice, T> careful;
        Pair(const ProgramOn& program, int many, Criterion criterion = Criterion::sum)
            : quick(program.rows<double, T>(many, criterion), program.soft_), careful(program.rows<Twice, T>(many, criterion), program.soft_) {
            set(quick, program), set(careful, program);
        }
        template <class R> static void set(Engine<R, T>& engine, const ProgramOn& program) {
            if constexpr (T == 1) engine.shared_cost = {R(1.0)};
            if constexpr (T == 2) engine.shared_cost = {R(-1.0), R(0.0)};
            if constexpr (T == 0)
                for (int i = 0; i < program.count; ++i) engine.cost[i][0] = program.price_[i];
        }
    };

    explicit ProgramOn(const Given& given)
        : Program(given.count, given.limits), soft_(count), price_(count), divisor_(given.divisor, given.divisor + 4 * count),
          bound_(given.bound, given.bound + limits), shares_(given.shares, given.shares + limits), rest_(count), inside_(count), z_(count), best_(count),
          room_(count + limits + count), room_inside_(room_), prices_(limits), best_prices_(limits) {
        std::copy(given.frame, given.frame + 36, &frame_[0][0]);
        for (int i = 0; i < count; ++i) soft_[i] = divisor_[4 * i + 3] < infinity, price_[i] = 1.0 / divisor_[4 * i];
        const auto rows_of = [&](const double* from, int many, std::vector<Field>& to) {
            to.assign(many, Field(count));
            for (int k = 0; k < many; ++k)
                for (int i = 0; i < count; ++i) std::copy(from + 4 * (count * k + i), from + 4 * (count * k + i) + D, to[k][i].begin());
        };
        rows_of(given.balance, 6, balance_), rows_of(given.rows, limits, limit_);
        torsion_row_.assign(count, -1);
        for (int i = 0, next = 0; i < count; ++i)
            if (soft_[i]) torsion_row_[i] = next++;
        torsions_ = int(std::count(soft_.begin(), soft_.end(), 1));
        orthonormalise();
        sum_.emplace(*this, limits), largest_.emplace(*this, limits, Criterion::largest), depth_.emplace(*this, limits);
        cones_.emplace(*this, torsions_);
        if (given.elastic) excess_.emplace(*this, limits, Criterion::excess);
        phi_.emplace(Descents{{rows<double, 0>(limits), soft_, limits}, {rows<Twice, 0>(limits), soft_, limits}});
        find_rest();
    }
    std::unique_ptr<Program> clone() const override { return std::make_unique<ProgramOn>(*this); }

    Code least(const double* wrench, Criterion criterion, const Options& options, const Record& record, double* prices) override {
        record.clear();
        std::fill(prices, prices + limits, 0.0);
        Summary& out = record.summary();
        out.code = REFUSED;
        if (!sane_wrench(wrench) || (criterion == Criterion::excess && !excess_)) return REFUSED;
        std::copy(wrench, wrench + 6, out.wrench.begin());
        criterion_ = criterion;
        const Vec6 load = in_frame(wrench);
        const Vec6 turned = solve_lower(load);
        size_ = largest_of(turned);
        double most = 0.0;
        for (int k = 0; k < limits; ++k) most = std::max(most, -bound_[k]);
        if (size_ < NOTHING && !(most > 0.0)) {  // no force is needed, and none is less
            out.code = CONVERGED;
            return CONVERGED;
        }
        size_ = std::max(size_, most);
        unit_ = (1.0 / size_) * load, turned_ = (1.0 / size_) * turned;
        best_value_ = infinity, best_bound_ = 0.0, best_nu_ = Vec6{}, residual_ = 0.0;
        std::fill(best_prices_.begin(), best_prices_.end(), 0.0);
        has_inside_ = false;
        const Code code = criterion == Criterion::sum       ? solve(*sum_, wrench, options, out)
                          : criterion == Criterion::largest ? solve(*largest_, wrench, options, out)
                                                            : solve(*excess_, wrench, options, out);
        if (code == INFEASIBLE) return record.refute(out.multipliers, size(load));
        if (code == REFUSED) return code;
        write(code, record, prices);
        return Code(int(out.code));
    }

    Deepest deepest(const double* wrench, double tolerance, double* z) override {
        Deepest found;
        if (!sane_wrench(wrench)) return found;
        found = dive(*depth_, wrench, tolerance, limits, inside_);
        for (int i = 0; i < count; ++i)
            for (int a = 0; a < 4; ++a) z[4 * i + a] = a < D ? inside_[i][a] : 1.0;
        return found;
    }

    Code least_phi(const Call& call, const double* weights, const double* row_weights, const double* z, const Options& options,
                   const Record& record, double* prices) override {
        record.clear();
        std::fill(prices, prices + limits, 0.0);
        record.summary().code = REFUSED;
        if (!sane_wrench(call.wrench)) return REFUSED;
        std::copy(call.wrench, call.wrench + 6, record.summary().wrench.begin());
        criterion_ = Criterion::sum, size_ = 1.0, unit_ = in_frame(call.wrench), turned_ = solve_lower(unit_);
        for (int i = 0; i < count; ++i)
            for (int a = 0; a < D; ++a) inside_[i][a] = z[4 * i + a];
        has_inside_ = true;
        const auto take_start = [&](auto& engine) {
            set_right(engine);
            for (int i = 0; i < count; ++i) engine.z[i] = wide<std::decay_t<decltype(engine.value)>>(inside_[i]);
        };
        int spent = 0, trials = 0;
        // on Phi with lambda times `raised`
        const auto descend = [&](auto& engine, const Call& call, double raised, double tolerance, int limit) {
            for (int i = 0; i < count; ++i) engine.weights[i] = {weights[2 * i], raised * weights[2 * i + 1]};
            for (int k = 0; k < limits; ++k) engine.row_weights[k] = raised * row_weights[k];
            const Code code = engine.run(call, tolerance, limit, LONG);
            spent += engine.iterations, trials += engine.trials;
            return code;
        };
        const auto written = [&](auto& engine, Code code) {
            engine.iterations = spent, engine.trials = trials;
            return code == REFUSED ? code : write_phi(engine, code, call, options.tolerance, record, prices);
        };
        auto& [quick, careful] = *phi_;
        take_start(quick);
        const Code first = descend(quick, call, 1.0, options.tolerance, std::min(options.limit, PATIENCE));
        if (first != STALLED && (first != LIMIT || options.limit <= PATIENCE)) return written(quick, first);
        // where surfaces are curved against the forces steps along them are short: down the central path, which is far from them
        double raised = 1.0;
        for (int i = 0; i < count; ++i)
            raised = std::max(raised, weights[2 * i] * z[4 * i] * z[4 * i] / weights[2 * i + 1]);
        take_start(careful);
        const Call path{.wrench = call.wrench};
        while ((raised /= FALL) > 1.0 && spent < options.limit)
            if (descend(careful, path, raised, 0.1, std::min(options.limit - spent, 2 * PATIENCE)) == REFUSED) break;
        const Code code = descend(careful, call, 1.0, options.tolerance, std::min(options.limit - spent, 2 * PATIENCE));
        const bool worse = code == REFUSED || (code != CONVERGED && double(careful.value) > double(quick.value));
        if (worse) return written(quick, STALLED);
        return written(careful, code == LIMIT && spent < options.limit ? STALLED : code);
    }

private:
    static constexpr double PAD = 6e-16;       // of the numbers that make a slack: what rounding may cost on the way to forces
    static constexpr double LAST = 4e-16;      // of the largest normal force: what rounding it may cost balance
    static constexpr double BALANCED = 1e-9;   // of the wrench: what an optimal force may miss
    static constexpr double BELOW = -1e-9;     // rounding by which an objective may fall short of its bound
    static constexpr double ROUNDING = 1e-14;  // of the numbers that make a proof, per term: far above what rounding may cost
    static constexpr double MOST = 1e4;        // of the largest normal force of a start: normal forces among which an excess is the least
    static constexpr double BEGIN = 1.5;       // of a start's excess: how much limits are raised there
    static constexpr int FIRST_TRY = 40;       // iterations, of which a dozen is usual, before another start or more digits are tried
    static constexpr int PATIENCE = 200;       // iterations on Phi, of which twenty are usual, before the central path is tried
    static constexpr double FALL = 30.0;       // of lambda from one stage of the path to the next
    std::vector<char> soft_;
    std::vector<double> price_, divisor_, bound_, shares_;
    std::vector<Field> balance_, limit_, turn_;  // (6,) G, (M,), (6,) Q
    std::vector<int> torsion_row_;
    int torsions_ = 0;
    double frame_[6][6], lower_[6][6] = {};
    std::optional<Pair<0>> sum_;
    std::optional<Pair<1>> largest_, excess_;
    std::optional<Pair<2>> depth_, cones_;  // inside everything; inside the cones alone
    struct Descents {
        PhiRows<double, D> quick;
        PhiRows<Twice, D> careful;
    };
    std::optional<Descents> phi_;
    Field rest_, inside_, z_, best_;  // an internal force strictly inside the cones; a force strictly inside everything
    bool has_rest_ = false, has_inside_ = false;
    std::vector<double> room_, room_inside_, prices_, best_prices_;
    Vec6 unit_{}, turned_{}, best_nu_{};  // the wrench of this call, of size one, and L^-1 of it
    Criterion criterion_ = Criterion::sum;
    double raised_ = 1.0, most_ = 1.0;  // the excess that is one unit of t; the largest normal force that is looked at
    double size_ = 1.0, best_value_ = infinity, best_bound_ = 0.0, residual_ = 0.0, best_residual_ = 0.0;

    // G = L Q by Gram and Schmidt, twice.
    void orthonormalise() {
        turn_ = balance_;
        for (int r = 0; r < 6; ++r) {
            for (int pass = 0; pass < 2; ++pass)
                for (int q = 0; q < r; ++q) {
                    const double along = product(turn_[r], turn_[q]);
                    lower_[r][q] += along;
                    for (int i = 0; i < count; ++i) add(turn_[r][i], -along, turn_[q][i]);
                }
            lower_[r][r] = std::sqrt(product(turn_[r], turn_[r]));
            for (auto& z : turn_[r])
                for (double& value : z) value /= lower_[r][r];
        }
    }
    static double product(const Field& a, const Field& b) {
        double total = 0.0;
        for (std::size_t i = 0; i < a.size(); ++i) total += inner(a[i], b[i]);
        return total;
    }
    Vec6 in_frame(const double* wrench) const {
        Vec6 out{};
        for (int r = 0; r < 6; ++r)
            for (int q = 0; q < 6; ++q) out[r] += frame_[r][q] * wrench[q];
        return out;
    }
    Vec6 solve_lower(Vec6 a) const {
        for (int r = 0; r < 6; ++r) {
            for (int q = 0; q < r; ++q) a[r] -= lower_[r][q] * a[q];
            a[r] /= lower_[r][r];
        }
        return a;
    }
    // Multipliers of the wrench as it is given from those of the turned balance.
    Vec6 pull_back(const Vec6& a) const { return out_of_frame(solve_upper(a)); }
    Vec6 solve_upper(Vec6 a) const {
        for (int r = 5; r >= 0; --r) {
            for (int q = r + 1; q < 6; ++q) a[r] -= lower_[q][r] * a[q];
            a[r] /= lower_[r][r];
        }
        return a;
    }
    Vec6 out_of_frame(const Vec6& a) const {
        Vec6 out{};
        for (int q = 0; q < 6; ++q)
            for (int r = 0; r < 6; ++r) out[q] += frame_[r][q] * a[r];
        return out;
    }
    // The largest number of the least-norm force of a turned wrench: a size that does not hang on units.
    double largest_of(const Vec6& turned) const {
        double most = 0.0;
        for (int i = 0; i < count; ++i)
            for (int a = 0; a < D; ++a) {
                double value = 0.0;
                for (int r = 0; r < 6; ++r) value += turn_[r][i][a] * turned[r];
                most = std::abs(value) <= most ? most : std::abs(value);
            }
        return most;
    }
    // z -= Q^T a
    void subtract(Field& z, const Vec6& a) const {
        for (int r = 0; r < 6; ++r)
            for (int i = 0; i < count; ++i) add(z[i], -a[r], turn_[r][i]);
    }
    Vec6 wrench_of(const Field& z) const {
        Vec6 out;
        for (int r = 0; r < 6; ++r) out[r] = product(balance_[r], z);
        return out;
    }
    // What G z + w misses off z, by the least change; returns what is left. What is z's own rounding stays: where contacts are close to each
    // other its least change is far larger than it.
    double balance(Field& z, const Vec6& unit) const {
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
                for (int i = 0; i < count; ++i) shared[0] += inward(i, turn_[r][i]);
            out.add_joint(turned(turn_[r]), shared, -1);
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
                if (inner(limit_[k][i], limit_[k][i]) > 0.0) ++touched, last = i;
            if (touched > 1) out.add_joint(turned(limit_[k]), shared, k);
            else out.add_own(last, last < count ? wide<R>(limit_[k][last]) : Tuple<R, D>{}, shared, k);
        }
        if constexpr (T == 1)
            for (int i = 0; i < count; ++i) {  // normal <= t, or where t is an excess <= most_
                Tuple<R, D> row{};
                row[0] = price_[i];
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
    template <class R> static Tuple<R, D> wide(const Tuple<double, D>& a) {
        Tuple<R, D> out;
        for (int j = 0; j < D; ++j) out[j] = a[j];
        return out;
    }
    template <class R> static Tuple<double, D> narrow(const Tuple<R, D>& a) {
        Tuple<double, D> out;
        for (int j = 0; j < D; ++j) out[j] = double(a[j]);
        return out;
    }
    // What a row makes of (1, 0, 0, 1), the way into a cone.
    double inward(int i, const Tuple<double, D>& row) const { return row[0] + (D == 4 && soft_[i] ? row[D - 1] : 0.0); }

    // Slack of every cone, w and limit, less what rounding may cost.
    template <class Bound> void rooms(const Field& z, int many, std::vector<double>& out, Bound&& right) const {
        int next = 0;
        for (int i = 0; i < count; ++i) {
            out[next++] = slack(cone(z[i])) - PAD * z[i][0];
            if (D == 4 && soft_[i]) out[next++] = z[i][D - 1] - PAD * z[i][0];
        }
        for (int k = 0; k < many; ++k) {
            double value = right(k), sizes = std::abs(value);
            for (int i = 0; i < count; ++i)
                for (int a = 0; a < D; ++a) {
                    const double part = limit_[k][i][a] * z[i][a];
                    value -= part, sizes += std::abs(part);
                }
            out[next++] = value - PAD * sizes;
        }
        std::fill(out.begin() + next, out.end(), infinity);
    }
    static double least_of(const std::vector<double>& values) {
        double least = infinity;
        for (double value : values) least = value >= least ? least : value;
        return least;
    }

    // The deepest force for the first `many` limits, into z [N].
    Deepest dive(Pair<2>& engines, const double* wrench, double tolerance, int many, Field& z) {
        const Deepest found = dive(engines.quick, wrench, tolerance, many, z);
        return found.code == CONVERGED || found.code == INFEASIBLE ? found : dive(engines.careful, wrench, tolerance, many, z);
    }
    template <class R> Deepest dive(Engine<R, 2>& engine, const double* wrench, double tolerance, int many, Field& z) {
        const Vec6 load = in_frame(wrench);
        double size = grasp::size(load);
        bool free = size == 0.0;
        for (int k = 0; k < many; ++k) size = std::max(size, -bound_[k]), free = free && bound_[k] == 0.0;
        if (!(size > NOTHING)) size = 1.0;
        const Vec6 unit = (1.0 / size) * load, turned = solve_lower(unit);
        auto& at = engine.at;
        for (int r = 0; r < engine.rows.joint; ++r) {
            const int name = engine.rows.label[r];
            if (r < 6) engine.rows.coupling[r][1] = turned[r];
            engine.rows.right[r] = r == 6 ? 1.0 : 0.0;
            if (name >= 0) {
                const double part = evened(name, size);
                engine.rows.coupling[r] = {R(part * inset(name)), R(-part * bound_[name] / size)};
                for (int i = 0; i < count; ++i)
                    for (int a = 0; a < D; ++a) engine.rows.columns[engine.rows.joint * i + r][a] = part * limit_[name][i][a];
            }
            at.joint[r] = r < 7 ? 0.0 : 1.0, at.joint_slack[r] = 1.0;
        }
        for (int k = 0; k < int(engine.rows.own.size()); ++k) {
            auto& row = engine.rows.own[k];
            if (row.label >= 0) {
                const double part = evened(row.label, size);
                row.shared = {R(part * inset(row.label)), R(-part * bound_[row.label] / size)};
                if (row.contact < count)
                    for (int a = 0; a < D; ++a) row.row[a] = part * limit_[row.label][row.contact][a];
            }
            at.own[k] = at.own_slack[k] = 1.0;
        }
        at.t = {};
        for (int i = 0; i < count; ++i) at.z[i] = at.s[i] = wide<R>(unit_tuple());
        Deepest found;
        found.code = engine.run(tolerance, 0.1 * CLEAR, 0.0, 200, [] { return 0.0; });
        found.iterations = engine.iterations, found.margin = double(at.t[0]);
        const double part = double(at.t[1]), scale = free ? 1.0 : 1.0 / part;
        for (int i = 0; i < count; ++i) {
            z[i] = narrow(at.z[i]);
            add(z[i], found.margin, unit_tuple());
            if (D == 4 && !soft_[i]) z[i][D - 1] = 1.0;
            for (double& value : z[i]) value *= scale;
        }
        if (free || part > 0.0) balance(z, unit);
        for (auto& each : z)
            for (double& value : each) value *= size;
        Vec6 y;
        for (int r = 0; r < 6; ++r) y[r] = double(at.joint[r]);
        y = solve_upper(y);
        const Vec6 twist = out_of_frame(y);
        found.twist = (1.0 / std::max(grasp::size(twist), 1e-300)) * twist;
        rooms(z, many, room_, [&](int k) { return bound_[k]; });
        if (found.margin > CLEAR && least_of(room_) > 0.0) found.code = CONVERGED;
        else if (found.margin <= CLEAR && found.code == CONVERGED) found.code = INFEASIBLE;
        else if (separates(engine, y, unit, size, many)) found.code = INFEASIBLE, found.margin = std::min(found.margin, 0.0);
        else if (found.code == CONVERGED) found.code = STALLED;  // slow is not infeasible
        return found;
    }
    // What a row is multiplied by there: a bound far above the wrench makes a row of its size, not a huge one.
    double evened(int k, double size) const { return 1.0 / std::max(1.0, std::abs(bound_[k]) / size); }
    // What a unit of depth takes of a limit's slack.
    double inset(int k) const {
        double total = 1.0;
        for (int i = 0; i < count; ++i) total += inward(i, limit_[k][i]);
        return total;
    }
    // Whether y, a twist in the unit frame, proves with the limits' multipliers that no force is within the first `many` limits, wherever they
    // come from: G^T y + sum price row is in every dual cone and y . w > sum price bound, both by more than rounding can have made.
    template <class R> bool separates(const Engine<R, 2>& engine, const Vec6& y, const Vec6& unit, double size, int many) {
        const auto& rows = engine.rows;
        for (const auto& row : rows.own)
            if (row.label >= 0) prices_[row.label] = evened(row.label, size) * std::max(double(engine.at.own[&row - rows.own.data()]), 0.0);
        for (int r = rows.equal; r < rows.joint; ++r) prices_[rows.label[r]] = evened(rows.label[r], size) * std::max(double(engine.at.joint[r]), 0.0);
        const double rounding = ROUNDING * (8 + many);
        for (int i = 0; i < count; ++i) {
            Tuple<double, D> dual{};
            double terms = 0.0;
            const auto take = [&](double part, const Tuple<double, D>& row) {
                add(dual, part, row);
                for (double value : row) terms += std::abs(part * value);
            };
            for (int r = 0; r < 6; ++r) take(y[r], balance_[r][i]);
            for (int k = 0; k < many; ++k) take(prices_[k], limit_[k][i]);
            if (D == 4 && soft_[i] && !(dual[D - 1] > rounding * terms)) {  // w has no price to move away from: see `certify`
                const Tuple<double, D>& row = limit_[torsion_row_[i]][i];
                const double raised = (2.0 * rounding * terms - dual[D - 1]) / row[D - 1];
                prices_[torsion_row_[i]] += raised, take(raised, row);
            }
            if (!(slack(cone(dual)) > rounding * terms)) return false;
        }
        double value = 0.0, terms = 0.0;
        const auto take = [&](double part) { value += part, terms += std::abs(part); };
        for (int r = 0; r < 6; ++r) take(y[r] * unit[r]);
        for (int k = 0; k < many; ++k) take(-prices_[k] * bound_[k] / size);
        return value > rounding * terms && terms < infinity;
    }
    static Tuple<double, D> unit_tuple() {
        Tuple<double, D> out{};
        out[0] = 1.0;
        if (D == 4) out[D - 1] = 1.0;
        return out;
    }

    void find_rest() {
        const double nothing[6] = {};
        const Deepest found = dive(*cones_, nothing, 1e-2, torsions_, rest_);
        has_rest_ = found.code == CONVERGED;
    }

    bool elastic() const { return criterion_ == Criterion::excess; }
    int kept() const { return elastic() ? torsions_ : limits; }  // limits that no force may exceed

    template <int T> Code solve(Pair<T>& engines, const double* wrench, const Options& options, Summary& out) {
        int spent = 0;
        // from a strictly feasible z where one is known, in one precision, then in the other
        const auto attempt = [&](auto& engine, bool known) {
            set_right(engine);
            if (known) place_inside(engine);
            else if (begin(engine)) inside_from_start(engine);
            const int limit = std::min(options.limit, watches(engine) ? options.limit : FIRST_TRY);
            const double enough = elastic() ? EXCESS_FLOOR / raised_ : 0.0;
            const Code code = engine.run(options.tolerance, enough, watches(engine) ? 0.1 : 0.0, limit, [&] { return consider(engine); });
            spent += engine.iterations;
            if (code != CONVERGED && consider(engine) <= options.tolerance) return CONVERGED;
            return code == LIMIT && limit < options.limit ? STALLED : code;
        };
        Code code = attempt(engines.quick, false);
        if (code != CONVERGED && !has_inside_) {
            const Deepest found = dive(elastic() ? *cones_ : *depth_, wrench, 1e-7, kept(), z_);
            if (found.code != CONVERGED) {
                out.multipliers = found.twist, out.iterations = spent;
                return found.code == INFEASIBLE ? INFEASIBLE : REFUSED;
            }
            for (int i = 0; i < count; ++i)
                for (int a = 0; a < D; ++a) inside_[i][a] = z_[i][a] / size_;
            has_inside_ = true;
            if (consider(engines.quick) <= options.tolerance) code = CONVERGED;
            else if (options.limit > 0) code = attempt(engines.quick, true);
        }
        if (code == STALLED) code = attempt(engines.careful, has_inside_);
        out.iterations = out.trials = spent;
        return code;
    }
    // Whether the last iterate that is strictly inside in doubles is kept, to mix the next ones with.
    template <class R, int T> static constexpr bool watches(const Engine<R, T>&) { return std::is_same_v<R, Twice>; }
    template <class Engine> void set_right(Engine& engine) const {
        auto& joint = engine.rows.right;
        for (int r = 0; r < engine.rows.joint; ++r) joint[r] = r < 6 ? -turned_[r] : bound_[engine.rows.label[r]] / size_;
        for (auto& row : engine.rows.own) row.right = row.label >= 0 ? bound_[row.label] / size_ : 0.0;
    }
    // The largest part of itself by which z exceeds a limit.
    double excess(const Field& z) const {
        double most = 0.0;
        for (int k = torsions_; k < limits; ++k)
            if (shares_[k] > 0.0) most = std::max(most, (size_ * product(limit_[k], z) - bound_[k]) / shares_[k]);
        return most;
    }
    // t in units of an excess above that of a start z, where it begins at one; normal forces up to a multiple of those of z.
    template <class R> void raise(Engine<R, 1>& engine, const Field& z) {
        raised_ = BEGIN * excess(z) + EXCESS_FLOOR, most_ = 1.0, best_bound_ = 0.0;
        for (int i = 0; i < count; ++i) most_ = std::max(most_, price_[i] * z[i][0]);
        most_ *= MOST;
        const auto raise = [&](Tuple<R, 1>& shared, int name) {
            if (name >= 0) shared[0] = -raised_ * shares_[name] / size_;
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
    // A start; true where it is strictly inside everything and balanced.
    template <class R, int T> bool begin(Engine<R, T>& engine) {
        if (has_rest_) {
            for (auto& each : z_) each = {};
            subtract(z_, turned_);
            double squeeze = 1e-6;
            rooms(z_, torsions_, room_, [](int) { return 0.0; });
            rooms(rest_, torsions_, room_inside_, [](int) { return 0.0; });
            for (std::size_t k = 0; k < room_.size(); ++k)
                if (room_[k] < infinity) squeeze = std::max(squeeze, -room_[k] / room_inside_[k]);
            for (int i = 0; i < count; ++i) {
                add(z_[i], 1.3 * squeeze, rest_[i]);
                if (D == 4 && !soft_[i]) z_[i][D - 1] = 1.0;
            }
        } else {
            for (auto& each : z_) each = unit_tuple();
        }
        for (int i = 0; i < count; ++i) engine.at.z[i] = wide<R>(z_[i]);
        const bool slack = place(engine, has_rest_ ? 1e-3 : 1.0);
        return has_rest_ && slack;
    }

    // Slacks and a dual strictly inside for the z of a start: s = c + the limits' part, balance's multipliers zero. Slacks below `least` of
    // the largest force are lifted to it; false where that was needed.
    template <class R, int T> bool place(Engine<R, T>& engine, double least) {
        auto& at = engine.at;
        const auto& rows = engine.rows;
        R largest = 0.0, product = 0.0, normal = 0.0;
        for (int i = 0; i < count; ++i) {
            largest = max(largest, at.z[i][0]), normal = max(normal, price_[i] * at.z[i][0]);
            at.s[i] = engine.cost[i];
            if constexpr (T == 1) at.s[i][0] = price_[i] / count;
            product += at.z[i][0] * at.s[i][0] / count;
            if (D == 4) at.s[i][D - 1] = soft_[i] ? 0.25 * at.s[i][0] : R(1.0);
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
        const double share = 0.1 / std::max(1, limits - torsions_);
        for (int i = 0; i <= count; ++i)
            for (int k = rows.first[i]; k < rows.first[i + 1]; ++k) {
                const auto& row = rows.own[k];
                R slack = row.right - inner(row.shared, at.t);
                if (i < count) slack -= inner(row.row, at.z[i]);
                at.own_slack[k] = lift(slack);
                if (row.label < 0) at.own[k] = R(1.0) / count;
                else if (row.label < torsions_) at.own[k] = at.s[i][D - 1] / row.row[D - 1];
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
            if (elastic()) {  // t's price, as its equation says where that is one
                R left = 1.0;
                for (int r = rows.equal; r < rows.joint; ++r) left += at.joint[r] * rows.coupling[r][0];
                for (std::size_t k = 0; k + 1 < rows.own.size(); ++k) left += at.own[k] * rows.own[k].shared[0];
                at.own.back() = max(left, R(1e-3));
            }
        for (int i = 0; i < count; ++i) {  // s as its equation says
            Tuple<R, D> s = engine.cost[i];
            for (int k = rows.first[i]; k < rows.first[i + 1]; ++k) add(s, at.own[k], rows.own[k].row);
            for (int r = rows.equal; r < rows.joint; ++r) add(s, at.joint[r], rows.columns[rows.joint * i + r]);
            if (D == 4 && !soft_[i]) s[D - 1] = 1.0;
            at.s[i] = s;
        }
        return kept;
    }
    template <int T> double engine_price(int i) const { return T == 1 ? price_[i] / count : price_[i]; }

    // Balances the iterate, takes it into the limits and bounds its objective; keeps the best force and the best bound. Returns the gap.
    template <class R, int T> double consider(const Engine<R, T>& engine) {
        const auto right = [&](int k) { return bound_[k] / size_; };
        for (int i = 0; i < count; ++i) z_[i] = narrow(engine.at.z[i]);
        residual_ = balance(z_, unit_);
        rooms(z_, kept(), room_, right);
        double least = least_of(room_);
        if (least > 0.0 && watches(engine)) inside_ = z_, has_inside_ = true;
        if (least < 0.0 && has_inside_) {  // mixed with as little of a force inside as takes the last digits in
            rooms(inside_, kept(), room_inside_, right);
            double part = 0.0;
            for (std::size_t k = 0; k < room_.size(); ++k)
                if (room_[k] < 0.0) part = std::max(part, -room_[k] / (room_inside_[k] - room_[k]));
            part = std::min(1.0, 1.01 * part);
            for (int i = 0; i < count; ++i)
                for (int a = 0; a < D; ++a) z_[i][a] = (1.0 - part) * z_[i][a] + part * inside_[i][a];
            residual_ = grasp::size(wrench_of(z_) + unit_);
            rooms(z_, kept(), room_, right);
            least = least_of(room_);
        }
        certify(engine);
        double force = 0.0;
        for (int i = 0; i < count; ++i) {
            const double normal = price_[i] * z_[i][0];
            force = T == 1 ? std::max(force, normal) : force + normal;
        }
        const double value = elastic() ? excess(z_) : force;
        const bool good = least >= 0.0 && residual_ <= BALANCED * grasp::size(unit_) + 1e-15 * force;
        if (good && value < best_value_) best_value_ = value, best_ = z_, best_residual_ = residual_;
        return gap();
    }
    double gap() const {
        if (!(best_value_ < infinity)) return infinity;
        const double found = elastic() ? (best_value_ - best_bound_) / std::max(best_bound_, EXCESS_FLOOR / EXCESS_WITHIN)
                             : best_bound_ > 0.0 ? (best_value_ - best_bound_) / best_bound_ : best_value_ == 0.0 ? 0.0 : infinity;
        return found >= BELOW ? found : infinity;
    }

    // The dual value at the multipliers, on the segment to interior ones where that takes to be feasible: s = c + C^T y in the dual cones,
    // y >= 0 on the limits. Of an excess: at multipliers that price t at one; what they lack of the dual cones is paid for by forces up to most_.
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
            for (int k = torsions_; k < limits; ++k) price += prices_[k] * shares_[k];
            theta = price > 0.0 ? size_ / price : 0.0;
        }
        for (int i = 0; i < count; ++i) {
            Tuple<double, D> safe{}, end{};
            safe[0] = engine_price<T>(i), end[0] = elastic() ? 0.0 : price_[i];
            if (T == 1 && !elastic()) end[0] *= std::max(double(at.own[rows.first[i + 1] - 1]), 0.0) / shares;
            for (int r = 0; r < 6; ++r) add(end, double(at.joint[r]), turn_[r][i]);
            for (int r = rows.equal; r < rows.joint; ++r) add(end, prices_[rows.label[r]], limit_[rows.label[r]][i]);
            for (int k = rows.first[i]; k < rows.first[i + 1]; ++k)
                if (rows.own[k].label >= 0) add(end, prices_[rows.own[k].label], limit_[rows.own[k].label][i]);
            if (D == 4 && soft_[i] && end[D - 1] < 0.0) {
                // w has no price to move away from: raise its row's multiplier, at the expense of u
                const Tuple<double, D>& row = limit_[torsion_row_[i]][i];
                const double raised = -end[D - 1] / row[D - 1];
                prices_[torsion_row_[i]] += raised, add(end, raised, row);
            }
            const Vec3<double> last = cone(end);
            if (slack(last) >= 0.0) continue;
            if (elastic()) {
                paid -= slack(last) * most_ / price_[i];
                continue;
            }
            const double per = Boundary<double>(cone(safe)).per(last - cone(safe));
            theta = per > 1.0 ? std::min(theta, 1.0 / per) : per == per ? theta : 0.0;
        }
        double value = 0.0;
        Vec6 y;
        for (int r = 0; r < 6; ++r) y[r] = double(at.joint[r]), value += y[r] * turned_[r];
        for (int k = 0; k < limits; ++k) value -= prices_[k] * bound_[k] / size_;
        value = theta * (value - paid);
        if (value > best_bound_ && value < infinity) {
            best_bound_ = value, best_nu_ = -theta * y;
            for (int k = 0; k < limits; ++k) best_prices_[k] = theta * prices_[k];
        }
    }

    // Optimal where what is returned is: balanced, inside, its gap within the tolerance.
    template <class R> Code write_phi(PhiRows<R, D>& engine, Code code, const Call& call, double tolerance, const Record& record, double* prices) {
        for (int i = 0; i < count; ++i) best_[i] = narrow(engine.z[i]);
        best_residual_ = balance(best_, unit_);
        for (double part = 1e-15;; part = std::min(1.0, 4.0 * part)) {  // what rounding took outside goes back, on the way to the start
            for (int i = 0; i < count; ++i) engine.z[i] = wide<R>(best_[i]);
            engine.evaluate();
            rooms(best_, limits, room_, [&](int k) { return bound_[k]; });
            if ((least_of(room_) >= 0.0 && engine.value < infinity) || best_ == inside_) break;
            for (int i = 0; i < count; ++i)
                for (int a = 0; a < D; ++a) best_[i][a] = part < 1.0 ? best_[i][a] + part * (inside_[i][a] - best_[i][a]) : inside_[i][a];
            best_residual_ = grasp::size(wrench_of(best_) + unit_);
        }
        best_value_ = double(engine.value), best_bound_ = double(engine.bound);
        for (int r = 0; r < 6; ++r) best_nu_[r] = -double(engine.proof.joint[r]);
        for (int k = 0; k < int(engine.rows.own.size()); ++k) best_prices_[engine.rows.own[k].label] = double(engine.proof.own[k]);
        for (int r = engine.rows.equal; r < engine.rows.joint; ++r) best_prices_[engine.rows.label[r]] = double(engine.proof.joint[r]);
        double force = 0.0;
        for (int i = 0; i < count; ++i) force = std::max(force, best_[i][0]);
        const bool good = least_of(room_) >= 0.0 && best_residual_ <= BALANCED * (force + grasp::size(unit_));
        const bool near = best_bound_ > 0.0 && best_value_ - best_bound_ <= tolerance * best_bound_;
        if (code == CONVERGED && !(good && (near || call.optimum == call.optimum))) code = STALLED;
        write(code, record, prices);
        record.summary().iterations = engine.iterations, record.summary().trials = engine.trials;
        return code;
    }

    void write(Code code, const Record& record, double* prices) {
        Summary& out = record.summary();
        if (!(best_value_ < infinity)) {  // the last force known to be inside, or nothing
            if (!has_inside_ || elastic()) {
                out.code = REFUSED;
                return;
            }
            best_ = inside_;
        }
        const double unit = elastic() ? 1.0 : size_;  // of the objective
        out.code = code, out.objective = unit * best_value_, out.lower_bound = unit * best_bound_;
        if (elastic()) {
            out.code = code == CONVERGED ? LIMITS_EXCEEDED : code, out.limit_excess = best_value_;
            best_nu_ = (1.0 / size_) * best_nu_;
            for (double& price : best_prices_) price /= size_;
        }
        out.residual = size_ * best_residual_, out.multipliers = pull_back(best_nu_), out.margin = infinity;
        for (int i = 0; i < count; ++i) {
            Vec3<double> x = cone(best_[i]);
            double* force = record.force() + 3 * i;
            for (int a = 0; a < 3; ++a) force[a] = size_ * x[a] / divisor_[4 * i + a];
            std::copy(force, force + 3, record.initial_force() + 3 * i);
            if (D == 4 && soft_[i]) record.torsion()[i] = size_ * (best_[i][0] - best_[i][D - 1]) / divisor_[4 * i + 3];
            for (int a = 1; a < 3; ++a)
                if (!(divisor_[4 * i + a] < infinity)) x[a] = 0.0;
            out.margin = std::min(out.margin, size_ * slack(x));
        }
        std::copy(best_prices_.begin(), best_prices_.end(), prices);
    }
};

}  // namespace detail

inline std::unique_ptr<Program> Program::make(const Given& given) {
    for (int i = 0; i < given.count; ++i)
        if (given.divisor[4 * i + 3] < infinity) return std::make_unique<detail::ProgramOn<4>>(given);
    return std::make_unique<detail::ProgramOn<3>>(given);
}

}  // namespace grasp
