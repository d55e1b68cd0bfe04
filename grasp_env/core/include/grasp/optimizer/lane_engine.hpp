// The solver behind `ForceOptimizer`: runs the planned algorithm from a start, and falls back on the general program. The file is long
// because contacts, starts and algorithms of a call share one state.
#pragma once
#include <grasp/optimizer/current_contacts.hpp>
#include <grasp/optimizer/engine.hpp>
#include <grasp/many/basis.hpp>
#include <grasp/flow/flow.hpp>
#include <grasp/general/general.hpp>
#include <grasp/math/dispatch.hpp>
#include <grasp/newton/limited.hpp>
#include <grasp/optimizer/plans.hpp>
#include <grasp/newton/soft.hpp>

namespace grasp::detail {

template <class V, int B> class LaneEngine final : public Engine {
public:
    using Field = typename Cones<V, B>::Field;

    LaneEngine(const Problem& problem, const Options& options)
        : options_(options), current_(problem), newton_(current_.home.count, {options.gap(), options.limit}),
          conic_(current_.home.count, {options.gap(), std::min(options.limit, General::CONIC_ITERATIONS)}),
          home_tangents_(newton_.cones), internal_force_(newton_.cones.field()), descent_start_(internal_force_),
          work_(internal_force_), prediction_(internal_force_),
          general_(current_.home.count, current_.limits.rows, current_.home.soft()),
          current_row_(record_size(current_.home.count)), force_(3 * current_.home.count), torsion_(current_.home.count),
          prices_(current_.limits.rows), kept_row_(current_row_.size()), kept_prices_(prices_.size()) {
        if (current_.home.placing == Placing::refused || current_.home.reach.rank == 0)
            throw std::invalid_argument("the contacts must be placed: Contacts::from");
        if (current_.limits.rows) limited_.emplace(current_.home.count, newton_.options), limited_->elastic = options.elastic;
        if (current_.home.soft()) soft_.emplace(current_.home, newton_.options, current_.divisor.data());
        const bool flows = options.method == Method::reduced_flow || options.method == Method::full_flow;
        if (flows) {
            if (current_.limits.rows || current_.home.soft())
                throw std::invalid_argument("the flows know hard contacts without limits: use newton or conic");
            if (!is_full_rank(current_.home))
                throw std::invalid_argument(
                    "the flows need contacts that balance wrenches of every direction: use newton or conic");
            if (options.method == Method::full_flow && current_.home.count > FULL_CONTACTS)
                throw std::invalid_argument("the full flow is dense: at most 8 contacts");
        }
        if (!(options.tolerance <= 1.0)) throw std::invalid_argument("the tolerance is a part of the objective: at most 1");
        if (options.elastic && !current_.limits.rows) throw std::invalid_argument("elastic belongs to limits: add limits");
        if (options.criterion == Criterion::excess || (options.criterion != Criterion::sum && options.method != Method::conic))
            throw std::invalid_argument("the criterion belongs to conic: sum or largest");
        place_home();
        if (flows)
            flow_.emplace(newton_.cones, options.step_rule, options.method == Method::full_flow ? Form::full : Form::reduced);
        if (options.model) {
            if (!options.model->fits(current_.home.count))
                throw std::invalid_argument("the model is for another number of contacts");
            predicted_.emplace(newton_.cones, *options.model);
        }
        if (needs_basis()) fill_basis();
    }
    std::unique_ptr<Engine> clone() const override {
        auto made = std::make_unique<LaneEngine>(*this);
        made->place_home();  // space for all contacts, and no numbers of this object's last call
        return made;
    }
    const Contacts& home() const override { return current_.home; }
    int size() const override { return record_size(current_.home.count, current_.joints, current_.limits.rows); }

    void set_basis(const double* basis) override {
        place({});  // the last call may have used fewer contacts
        newton_.starter.set_basis(newton_.cones, basis, current_.home.frames.data());
    }
    double make_basis(double* basis, bool warm) override {
        place({});
        if (warm) newton_.starter.set_basis(newton_.cones, basis);
        const double gap = fill_basis(warm);
        if (gap < infinity)
            for (int k = 0; k < 13; ++k) newton_.cones.store(newton_.starter.basis[k], basis + 3 * current_.home.count * k);
        return gap;
    }

    Deepest deepest(const double* wrench, double* force, double* torsion) override {
        const bool ready = place({}) == CONVERGED && is_valid_wrench(wrench) && prepare_general();
        return ready ? general_.deepest(wrench, 1e-7, force, torsion) : Deepest{};
    }

    std::optional<Vec6> within_reach(const double* wrench, const Changes& now) override {
        if (place(now) != CONVERGED || !is_valid_wrench(wrench) || current_.now.reach.full()) return {};
        return current_.now.within_reach(wrench);
    }

    Code solve(const Request& ask, double* row) override {
        const Record out = open_row(ask, row);
        Code code = place(ask.now);
        if (code == CONVERGED) code = is_valid_wrench(ask.wrench) ? run_checked(ask, current_record()) : REFUSED;
        return write_answer(code, out);
    }

    Code start(const Request& ask, double* row) override {
        const Record out = open_row(ask, row);
        Code code = place(ask.now);
        if (code == CONVERGED) code = is_valid_wrench(ask.wrench) ? write_start(ask, current_record()) : REFUSED;
        return write_answer(code, out, false);
    }

    void solve_many(std::ptrdiff_t count, const double* wrenches, double* rows) override {
        const auto alone = [&](std::ptrdiff_t k) { solve({.wrench = wrenches + 6 * k}, rows + size() * k); };
        const bool placed = place({}) == CONVERGED;
        const auto algorithm = algorithm_for(options_, kind_);
        const bool side_by_side = count >= FEW_PROBLEMS && placed && options_.start == Start::standard &&
                                  (algorithm == Algorithm::newton || algorithm == Algorithm::conic) && find_internal_force();
        if (!side_by_side) {
            for (std::ptrdiff_t k = 0; k < count; ++k) alone(k);
            return;
        }
        std::vector<double> made(record_size(current_.home.count) * count);
        const SolveBatch many{count, wrenches, made.data()};
        if (algorithm == Algorithm::conic) {
            prepare_conic();
            conic_many(conic_, many);
        } else {
            newton_many(newton_, internal_force_, many);
        }
        for (std::ptrdiff_t k = 0; k < count; ++k) {
            const Record record = many.record(k, current_.home.count);
            if (record.code() != CONVERGED) {
                alone(k);
                continue;
            }
            used_start_ = algorithm == Algorithm::conic ? Start::central : Start::internal_force,
            start_replaced_ = outside_training_ = false;
            const Record out = open_row({.wrench = many.wrench(k)}, rows + size() * k);
            std::copy_n(&record.summary().code, record_size(current_.home.count), current_row_.data());
            write_answer(CONVERGED, out);
        }
    }

    bool update(const Changes& now) override {
        if (now.contacts != Changes{}.contacts) return false;  // a call says which contacts touch, an update cannot
        if (place(now) == REFUSED) {
            place_home();
            return false;
        }
        current_.home = current_.now;
        if (!now.jacobian.empty()) current_.limits.jacobian.assign(now.jacobian.begin(), now.jacobian.end());
        if (!now.torque_bias.empty()) current_.limits.torque_bias.assign(now.torque_bias.begin(), now.torque_bias.end());
        place_home();
        newton_.starter.has_basis = false;
        if (needs_basis()) fill_basis();
        return true;
    }

private:
    static constexpr double WELL_INSIDE = 1e-3;  // of the mean normal force: smallest slack of a start within limits
    // If Phi grows by this factor over the previous solution, another start is compared with it.
    static constexpr double CLOSE = 2.0;
    static constexpr double ROUNDED = 1e-13;  // fraction of the largest force: effect of its rounding on balance
    Options options_;
    CurrentContacts current_;
    NewtonSolver<V, B> newton_;
    std::optional<LimitedNewton<V, B>> limited_;
    std::optional<SoftNewton<V, B>> soft_;
    ConicSolver<V, B> conic_;
    std::optional<FlowSolver<V, B>> flow_;
    std::optional<Prediction<V, B>> predicted_;
    Tangents<V, B> home_tangents_;
    // An internal force; start of a descent; work space; prediction of a model.
    Field internal_force_, descent_start_, work_, prediction_;
    General general_;
    std::vector<double> current_row_;  // record of the current contacts
    std::vector<double> force_, torsion_;  // force and torsion of a start
    std::vector<double> prices_;  // (M,) prices of the limits: of the answer, or of the proof that no force keeps them
    std::vector<double> kept_row_, kept_prices_;  // an answer to which another may be preferred

    // State of the current contacts.
    Kind kind_ = Kind::hard;
    Code placed_code_ = REFUSED;
    bool is_home_ = false;  // true if they are the problem's own
    bool conic_ready_ = false, general_ready_ = false, flow_ready_ = false, internal_force_searched_ = false,
         has_internal_force_ = false;
    // State of this call's start.
    Start used_start_ = Start::standard;
    bool start_replaced_ = false, outside_training_ = false;
    bool answered_by_general_ = false;  // true if the general program made the answer
    Vec6 twist_{};

    // True if forces alone balance wrenches of every direction.
    static bool is_full_rank(const Contacts& contacts) { return contacts.placing == Placing::good; }
    Record current_record() { return Record(current_row_.data(), current_.now.count); }
    bool torsional() const { return kind_ == Kind::soft || (kind_ == Kind::other && current_.now.soft()); }

    Record open_row(const Request& ask, double* row) const {
        Summary& s = *reinterpret_cast<Summary*>(row);
        s = Summary{};
        s.contacts = current_.home.count, s.joints = current_.joints, s.limits = current_.limits.rows;
        if (is_valid_wrench(ask.wrench)) std::copy_n(ask.wrench, 6, s.wrench.begin());
        return Record(row);
    }

    // --- contacts and limits of a call

    bool needs_basis() const {
        return flow_ || options_.start == Start::linear_combination || options_.start == Start::linear_combination_printed ||
               options_.start == Start::single_value || options_.start == Start::lagrange;
    }
    // Compute the 12-basis of the problem's contacts. Without force closure no basis exists, and starts that need it are replaced.
    // warm: start from the basis of nearby contacts. Return the worst relative gap; inf: not converged, nan: no force closure.
    double fill_basis(bool warm = false) {
        auto& starter = newton_.starter;
        starter.has_basis = false;
        const bool usable = placed_code_ == CONVERGED && is_full_rank(current_.now);
        if (!usable || (!warm && !find_any_internal_force())) return std::numeric_limits<double>::quiet_NaN();
        const double gap = grasp::make_basis(newton_, warm);
        starter.has_basis = gap < ACCEPTED_GAP, starter.basis_tangents = starter.tangents;
        return gap;
    }
    // Find an internal force strictly inside the cones and store it in newton_.x.
    bool find_any_internal_force() {
        if (newton_.internal_force()) return true;
        const double nothing[6] = {};
        if (!prepare_general() || general_.deepest(nothing, 1e-7, force_.data(), nullptr).code != CONVERGED) return false;
        newton_.cones.load_force(force_.data(), newton_.x);
        return newton_.is_start(Vec6{});
    }

    // Return to the problem's own contacts and limits.
    void place_home() {
        is_home_ = false;
        if (limited_) limited_->newton.rows.reserve(newton_.cones, std::min(current_.limits.rows, LimitTable::MOST_ROWS));
        place({});
        home_tangents_.load(current_.home.frames.data(), current_.home.count);
    }

    // Load the contacts and limits of a call. Return CONVERGED if that succeeds.
    Code place(const Changes& now) {
        Changes given = now;
        if (current_.touching(now.contacts) == current_.touching(~std::uint64_t(0))) given.contacts = ~std::uint64_t(0);
        const bool plain = given.empty();
        if (plain && is_home_) return placed_code_;
        is_home_ = plain;
        return placed_code_ = load_call(given);
    }
    Code load_call(const Changes& now) {
        conic_ready_ = general_ready_ = flow_ready_ = internal_force_searched_ = has_internal_force_ = false;
        const Code code = current_.load_call(now);
        if (code != CONVERGED) return code;
        set_count(current_.now.count);
        newton_.cones.pack(current_.now);
        newton_.starter.tangents.load(current_.now.frames.data(), current_.now.count);
        newton_.starter.moved = !is_home_;
        const bool soft = current_.now.soft(), limited = current_.limits.rows > 0;
        kind_ = !is_full_rank(current_.now) || !current_.separate || (soft && limited) ? Kind::other
                : soft                                                                 ? Kind::soft
                : limited                                                              ? Kind::limited
                                                                                       : Kind::hard;
        if (kind_ == Kind::soft) {
            soft_->newton.cones = newton_.cones;
            soft_->newton.rows.pack(newton_.cones, current_.now, current_.divisor.data());
        } else if (kind_ == Kind::limited) {
            limited_->newton.cones = newton_.cones;
            limited_->newton.rows.pack(newton_.cones, current_.table.rows());
        }
        return CONVERGED;
    }
    // Set the number of contacts. Unused lanes hold a contact without effect.
    void set_count(int count) {
        if (newton_.cones.count == count) return;
        newton_.cones.count = count;
        const auto clear = [](Field& x) {
            for (auto& v : x) v = {all<V>(1.0), V{}, V{}};
        };
        clear(newton_.x), clear(descent_start_), clear(work_), clear(prediction_), clear(internal_force_);
        if (limited_) clear(limited_->newton.x);
        if (soft_) clear(soft_->newton.x);
    }
    void prepare_conic() {
        if (conic_ready_) return;
        conic_.cones = newton_.cones, conic_.rest = internal_force_, conic_ready_ = true;
    }
    bool prepare_general() {
        if (!general_ready_ || !general_.placed())  // a copied program has no contacts yet
            general_ready_ = general_.place(current_.now, torsional() ? current_.divisor.data() : nullptr,
                                            current_.limits.rows ? current_.limits_in_place() : ForceLimits{}, 4,
                                            internal_force_array()) == Placing::good;
        return general_ready_;
    }
    // An internal force in the form the general program takes; null if there is none.
    const double* internal_force_array() {
        if (torsional() || !is_full_rank(current_.now) || !find_internal_force(options_.method == Method::conic)) return nullptr;
        newton_.cones.store_force(internal_force_, force_.data());
        return force_.data();
    }
    // Find an internal force of the current contacts, scaled to least Phi. Return false without force closure.
    bool find_internal_force(bool thorough = false) {
        if (!internal_force_searched_ || (thorough && !has_internal_force_)) {
            internal_force_searched_ = true;
            has_internal_force_ = newton_.find_rest(internal_force_, !thorough);
        }
        return has_internal_force_;
    }

    // --- starts

    Start start_of(const Request& ask) const {
        const Start start = ask.start == Start::standard ? options_.start : ask.start;
        if (start != Start::standard) return start;
        return own_start();
    }

    // Write the start of a call, balanced and strictly inside the cones, into newton_.x. Otherwise return the reason.
    Code begin(const Request& ask, const Vec6& w) {
        const Code code = find_start(ask, w);
        if (code != CONVERGED) return code;
        newton_.cones.reset_unused_lanes(newton_.x);
        return ask.adjustment.empty() || adjust_start(ask.adjustment, w) ? CONVERGED : REFUSED;
    }
    // Add a force (N, 3) along the axes of the positions to the start and take the point of least Phi between the two.
    bool adjust_start(Doubles by, const Vec6& w) {
        if (by.size() != std::size_t(3 * current_.home.count)) return false;
        newton_.cones.store_force(work_ = newton_.x, force_.data());
        for (int i = 0; i < current_.now.count; ++i)
            for (int a = 0; a < 3; ++a)
                for (int r = 0; r < 3; ++r)
                    force_[3 * i + a] += current_.now.frames[9 * i + 3 * r + a] * by[3 * current_.chosen[i] + r];
        newton_.cones.load_force(force_.data(), newton_.x);
        if (!newton_.cones.is_in_range(newton_.x)) return false;
        newton_.cones.balance(newton_.x, w);
        newton_.starter.segment(newton_.cones, work_, newton_.x);
        return true;
    }
    Code find_start(const Request& ask, const Vec6& w) {
        start_replaced_ = outside_training_ = false;
        const Start start = used_start_ = start_of(ask);
        switch (start) {
            case Start::given: return load_force(ask.force) && newton_.is_start(w) ? CONVERGED : REFUSED;
            case Start::previous:
                if (!ask.previous && ask.force.empty()) return default_start(ask, w);
                if (carry_previous(ask, w)) return CONVERGED;
                break;
            case Start::guess:
                if (ask.force.size() != std::size_t(3 * current_.home.count)) return REFUSED;
                return default_start(ask, w) == CONVERGED && guess(ask, w) ? CONVERGED : UNDECIDED;
            case Start::learned:
                if (predicted_ && start_from_prediction(ask, w)) return CONVERGED;
                break;
            case Start::phase_one: return find_interior_or_deepest(ask, w);
            case Start::internal_force: return start_from_internal_force(ask, w);
            case Start::linear_combination:
            case Start::linear_combination_printed:
            case Start::single_value:
            case Start::lagrange:
                if (combine(ask.wrench, w, start)) return CONVERGED;
                break;
            default: return default_start(ask, w);
        }
        const Code code = default_start(ask, w);
        const bool named = ask.start != Start::standard || options_.start != Start::standard;
        start_replaced_ = named || used_start_ != Start::phase_one;  // without force closure, phase one is the default
        return code;
    }
    // The method's default start, or any force inside if the contacts have no force closure.
    Code default_start(const Request& ask, const Vec6& w) {
        const bool combines = flow_ || options_.start == Start::linear_combination;
        if (combines && combine(ask.wrench, w, used_start_ = Start::linear_combination)) return CONVERGED;
        return start_from_internal_force(ask, w);
    }
    Code start_from_internal_force(const Request& ask, const Vec6& w) {
        if (!find_internal_force()) return find_interior_or_deepest(ask, w);
        used_start_ = Start::internal_force;
        grasp::begin(newton_.cones, internal_force_, w, newton_.x);
        return newton_.cones.phi(newton_.x) < infinity ? CONVERGED : UNDECIDED;
    }
    // Find any force inside the cones, or a proof that no balanced force touches them. Return UNDECIDED if neither is found
    // quickly.
    Code find_interior(const Vec6& w) {
        used_start_ = Start::phase_one;
        prepare_conic();
        int steps = 0;
        const auto found = conic_.find_inside(w, newton_.x, twist_, steps);
        using Inside = typename ConicSolver<V, B>::Inside;
        if (found == Inside::none) twist_ = newton_.cones.unit.pull_back(twist_);
        if (found == Inside::found && !(newton_.cones.phi(newton_.x) < infinity)) return UNDECIDED;  // numbers out of range
        return found == Inside::found ? CONVERGED : found == Inside::none ? INFEASIBLE : UNDECIDED;
    }
    // Like `find_interior`; if that is undecided, find the deepest force.
    Code find_interior_or_deepest(const Request& ask, const Vec6& w) {
        if (const Code code = find_interior(w); code != UNDECIDED) return code;
        if (kind_ != Kind::hard || !prepare_general()) return UNDECIDED;
        const Deepest deep = general_.deepest(ask.wrench, 1e-7, force_.data(), nullptr);
        twist_ = deep.twist;
        if (deep.code != CONVERGED || deep.moved) return deep.code == INFEASIBLE ? INFEASIBLE : UNDECIDED;
        newton_.cones.load_force(force_.data(), newton_.x);
        return newton_.is_start(w) ? CONVERGED : UNDECIDED;
    }
    // A start from the offline optima: the paper's, or a relative of it.
    bool combine(const double* wrench, const Vec6& w, Start start) {
        auto& starter = newton_.starter;
        if (!starter.has_basis || current_.now.count != current_.home.count) return false;
        Field& x = newton_.x;
        if (start == Start::linear_combination) return starter.combination(newton_.cones, newton_.system, wrench, w, x);
        if (!is_home_) return false;
        const Field& rest = starter.basis[12];
        if (start == Start::linear_combination_printed) {
            starter.combine(wrench, x, true);
        } else if (start == Start::single_value) {
            for (int b = 0; b < int(x.size()); ++b) x[b] = -newton_.cones.blocks[b].least(w);
            const double least = std::max(1.1 * inside(newton_.cones, x, rest).low, 1.0);
            for (int b = 0; b < int(x.size()); ++b) x[b] += all<V>(least) * rest[b];
        } else if (!lagrange(w)) {
            return false;
        }
        return newton_.is_start(w);
    }
    // argmin (f - k n)^T W (f - k n) s.t. G f = -w, with W = diag(1, 10, 10) and n the unit normal forces. The solution is affine
    // in k. k moves it inside the cones: at least the mean normal force at rest, at most the middle of the feasible interval.
    bool lagrange(const Vec6& w) {
        constexpr double WEIGHT[3] = {1.0, 10.0, 10.0};
        const int size = 3 * current_.now.count;
        Packed6 s{};
        Vec6 squeezed{};
        for (int j = 0; j < size; ++j) {
            const Vec6 made = column(current_.now.force_rows.data(), size, j);
            for (int r = 0; r < 6; ++r) {
                for (int q = 0; q <= r; ++q) s[packed(r, q)] += made[r] * made[q] / WEIGHT[j % 3];
                if (j % 3 == 0) squeezed[r] += made[r];
            }
        }
        Ldl6 factor;
        if (!(factor.factor(s) > 0.0)) return false;
        const Vec6 of_wrench = factor.solve(w), of_squeeze = factor.solve(squeezed);
        const auto field = [&](const Vec6& by, double normal, Field& x) {
            for (int j = 0; j < size; ++j)
                force_[j] =
                    (j % 3 == 0 ? normal : 0.0) - dot(column(current_.now.force_rows.data(), size, j), by) / WEIGHT[j % 3];
            newton_.cones.load_force(force_.data(), x);
        };
        field(of_wrench, 0.0, newton_.x), field(of_squeeze, 1.0, work_);
        const auto [low, high] = inside(newton_.cones, newton_.x, work_);
        if (!(low < high)) return false;
        newton_.cones.store_force(newton_.starter.basis[12], force_.data());
        double floor = 0.0;
        for (int i = 0; i < current_.now.count; ++i) floor += force_[3 * i] / current_.now.count;
        const double k = std::min(std::max(1.1 * low, floor), 0.5 * (low + high));
        for (int b = 0; b < int(work_.size()); ++b) newton_.x[b] += all<V>(k) * work_[b];
        return true;
    }

    // Turn a previous solution into the current frames and balance it by the smallest change in the metric of the Hessian.
    bool carry_previous(const Request& ask, const Vec6& w) {
        if (!load_previous(ask)) return false;
        Field& x = newton_.x;
        const double before = newton_.cones.phi(x);
        const bool follows = before < infinity && newton_.starter.tangent(newton_.cones, newton_.system, w, x);
        if (follows && newton_.cones.phi(x) <= CLOSE * before) return true;
        if (!follows) newton_.cones.balance(x, w);
        descent_start_ = x;
        if (!find_internal_force()) return follows && newton_.cones.phi(x) < infinity;
        grasp::begin(newton_.cones, internal_force_, w, work_);
        x = descent_start_;
        return newton_.starter.segment(newton_.cones, work_, x) > 0.0;
    }
    // Load a caller's force (N, 3) of the touching contacts into newton_.x and force_.
    bool load_force(Doubles force) {
        if (force.size() != std::size_t(3 * current_.home.count)) return false;
        for (int i = 0; i < current_.now.count; ++i)
            std::copy_n(&force[3 * current_.chosen[i]], 3, &force_[3 * i]), torsion_[i] = 0.0;
        newton_.cones.load_force(force_.data(), newton_.x);
        return true;
    }
    // Load the previous solution of the touching contacts, in their current frames, into newton_.x, force_ and torsion_.
    bool load_previous(const Request& ask) {
        if (!ask.previous) return load_force(ask.force) && newton_.cones.is_in_range(newton_.x);
        const Record before(const_cast<double*>(ask.previous));  // only read
        if (before.contacts() != current_.home.count || !before.has_force()) return false;
        for (int i = 0; i < current_.now.count; ++i) {
            const double *f = before.force() + 3 * current_.chosen[i], *from = before.frames() + 9 * current_.chosen[i],
                         *to = &current_.now.frames[9 * i];
            double* out = &force_[3 * i];
            torsion_[i] = before.torsion()[current_.chosen[i]];
            if (std::equal(from, from + 9, to)) {
                std::copy_n(f, 3, out);
                continue;
            }
            out[0] = f[0];  // the component lost to the frames' tilt is dropped, so the force stays inside
            for (int a = 1; a < 3; ++a) {
                out[a] = 0.0;
                for (int r = 0; r < 3; ++r) out[a] += to[3 * r + a] * (from[3 * r + 1] * f[1] + from[3 * r + 2] * f[2]);
            }
        }
        newton_.cones.load_force(force_.data(), newton_.x);
        return newton_.cones.is_in_range(newton_.x) &&
               std::all_of(torsion_.begin(), torsion_.end(), [](double v) { return std::abs(v) < infinity; });
    }

    // Load a given force into force_ and torsion_. Return true if it is balanced and strictly inside the cones.
    bool load_given(const Request& ask) {
        const std::size_t all = current_.home.count;
        if (ask.force.size() != 3 * all || (!ask.torsion.empty() && ask.torsion.size() != all)) return false;
        double most = 0.0;
        for (int i = 0; i < current_.now.count; ++i) {
            const double* f = &ask.force[3 * current_.chosen[i]];
            std::copy_n(f, 3, &force_[3 * i]);
            torsion_[i] = ask.torsion.empty() ? 0.0 : ask.torsion[current_.chosen[i]];
            if (torsion_[i] != 0.0 && !(current_.divisor[i] * std::abs(torsion_[i]) < current_.now.scale[3 * i] * f[0]))
                return false;
            for (int a = 0; a < 3; ++a) most = std::max(most, std::abs(f[a]));
        }
        newton_.cones.load_force(force_.data(), newton_.x);
        if (!newton_.cones.is_in_range(newton_.x) || !(newton_.cones.phi(newton_.x) < infinity)) return false;
        const double missed = general_.missed(ask.wrench, force_.data(), torsion_.data());
        return missed <= General::BALANCE_TOLERANCE * (most + grasp::size(newton_.cones.unit.of(ask.wrench)));
    }

    // If Phi at the balanced newton_.x exceeds Phi at the default start in work_, take the point of least Phi between them. For a
    // guess, always do so.
    void bring_inside(const Vec6& w, Start start) {
        const auto& cones = newton_.cones;
        const double own = cones.phi(work_);
        double share = 1.0;
        if (start == Start::guess || !(cones.phi(newton_.x) <= own)) {
            share = newton_.starter.segment(cones, work_, newton_.x);
            if (!(cones.phi(newton_.x) <= own)) newton_.x = work_, share = 0.0;  // rounding
        }
        start_replaced_ = !(share > 0.0) && dot(w, w) > 0.0;
        if (!start_replaced_) used_start_ = start;
    }
    // Start from a caller's force, with the default start in newton_.x.
    bool guess(const Request& ask, const Vec6& w) {
        work_ = newton_.x;
        load_force(ask.force);
        newton_.cones.balance(newton_.x, w);
        bring_inside(w, Start::guess);
        return newton_.cones.phi(newton_.x) < infinity;
    }

    // Start from the model's prediction. Phi is never above that of the default start. If a previous solution is given, the better
    // of the two is used.
    bool start_from_prediction(const Request& ask, const Vec6& w) {
        if (current_.now.count != current_.home.count) return false;
        const auto& cones = newton_.cones;
        auto& starter = newton_.starter;
        outside_training_ = !predicted_->covers(w);
        if (default_start(ask, w) != CONVERGED) return false;
        work_ = newton_.x;
        Field& x = newton_.x;
        if (is_home_) {
            for (int b = 0; b < int(x.size()); ++b) x[b] = -cones.blocks[b].least(w);
            predicted_->add(w, x);
        } else {  // the predicted internal force turns with the contacts
            for (auto& v : descent_start_) v = {V{}, V{}, V{}};
            predicted_->add(w, descent_start_);
            starter.turn(cones, descent_start_, home_tangents_, x);
            cones.balance(x, w);
        }
        const Start from = used_start_;
        bring_inside(w, Start::learned);
        if (ask.previous) {
            prediction_ = x;
            const Start now = used_start_;
            if (carry_previous(ask, w) && cones.phi(x) < cones.phi(prediction_))
                used_start_ = Start::previous, start_replaced_ = false;
            else x = prediction_, used_start_ = now;
        }
        if (start_replaced_) used_start_ = from;
        return true;
    }

    // Write the start that a solve would use as a record.
    Code write_start(const Request& ask, const Record& record) {
        record.clear();
        std::copy_n(ask.wrench, 6, record.summary().wrench.begin());
        const Vec6 w = newton_.cones.unit.of(ask.wrench);
        answered_by_general_ = false;
        const bool general_serves =
            algorithm_for(options_, kind_) == Algorithm::general || (kind_ == Kind::soft && start_of(ask) == Start::given);
        const Code code = general_serves ? UNDECIDED : begin(ask, w);
        if (code == CONVERGED) {
            newton_.cones.store_force(newton_.x, record.initial_force());
            newton_.cones.certify(newton_.x, w, record);
            record.summary().objective = newton_.cones.phi(newton_.x), record.summary().lower_bound = -infinity;
            return LIMIT;
        }
        if (code == INFEASIBLE && kind_ != Kind::soft) return write_proof(w, record);
        if (code == REFUSED) return REFUSED;
        if (flow_) return code;
        const Code made = general(ask, record, {options_.gap(), 0});
        keep_prices(made, record);
        return made == CONVERGED || made == STALLED ? LIMIT : made;
    }

    // --- algorithms

    // Run the planned algorithm. If a start that depends on more than contacts and wrench leads to no answer, solve again from the
    // method's own start.
    Code run_checked(const Request& ask, const Record& record) {
        const Code code = run(ask, record);
        if (code == CONVERGED || code == INFEASIBLE || has_own_start(ask)) return code;
        const bool sound = is_sound(code, record);
        return code == REFUSED || (sound && code != STALLED) ? code : run_again(ask, code, sound, record);
    }
    // Solve again from the method's own start, within the steps that are left. The first force stays if it is sound, unless the second
    // answer is proven or better.
    [[gnu::cold, gnu::noinline]] Code run_again(const Request& ask, Code first, bool sound, const Record& record) {
        const Summary before = record.summary();
        const Start used = used_start_;
        const bool replaced = start_replaced_, outside = outside_training_;
        if (sound) kept_row_ = current_row_, kept_prices_ = prices_;
        const int limit = options_.limit, spent = std::min(int(before.iterations), limit);
        const auto trace = ask.trace.subspan(std::min(std::size_t(spent), ask.trace.size()));
        const double traced = trace.empty() ? 0.0 : trace[0];
        set_limit(limit - spent);
        const Code found = run({.wrench = ask.wrench, .start = own_start(), .optimum = ask.optimum, .trace = trace}, record);
        set_limit(limit);
        const bool proven = found == CONVERGED || found == INFEASIBLE || found == LIMITS_EXCEEDED;
        if (sound && !proven && !(is_sound(found, record) && record.summary().objective < before.objective)) {
            current_row_ = kept_row_, prices_ = kept_prices_;
            used_start_ = used, start_replaced_ = replaced, outside_training_ = outside;
            if (!trace.empty()) trace[0] = traced;
            return first;
        }
        record.summary().iterations += before.iterations, record.summary().trials += before.trials;
        start_replaced_ = true;
        return found;
    }
    Start own_start() const { return flow_ ? Start::linear_combination : Start::internal_force; }
    // True if the start of a call is the method's own, or found for this call alone.
    bool has_own_start(const Request& ask) const {
        const Start start = start_of(ask);
        if (options_.method == Method::conic) return true;
        return ask.adjustment.empty() && (start == own_start() || start == Start::phase_one || start == Start::central);
    }
    // True if the outcome can be used: an optimum, a proof, or a force that is balanced and inside the cones.
    bool is_sound(Code code, const Record& record) const {
        if (code == CONVERGED || !Record::has_force(code)) return code == CONVERGED || code == INFEASIBLE;
        const Summary& s = record.summary();
        double most = 0.0;
        for (int i = 0; i < current_.now.count; ++i) most = std::max(most, record.force()[3 * i]);
        const double allowed = balance_tolerance(grasp::size(newton_.cones.unit.of(s.wrench.data())), most) +
                               (ROUNDED + current_.now.reach.rounding * current_.now.count) * most + NOTHING;
        return s.residual <= allowed && s.margin >= 0.0 && s.objective < infinity && most <= LARGEST &&
               grasp::size(s.multipliers) < infinity;
    }
    void set_limit(int limit) {
        options_.limit = newton_.options.limit = limit;
        if (limited_) limited_->newton.options.limit = limit;
        if (soft_) soft_->newton.options.limit = limit;
    }

    Code run(const Request& ask, const Record& record) {
        Summary& s = record.summary();
        s = Summary{};
        std::copy_n(ask.wrench, 6, s.wrench.begin());
        const auto algorithm = algorithm_for(options_, kind_);
        if (!algorithm) return current_.now.placing == Placing::rank_lost ? RANK_LOST : REFUSED;
        const Vec6 w = newton_.cones.unit.of(ask.wrench);
        answered_by_general_ = false;
        const Code code = run(*algorithm, ask, w, record);
        keep_prices(code, record);
        return code;
    }
    // Keep the prices of the limits at an answer, or of the general program's proof; another proof has written its own.
    void keep_prices(Code code, const Record& record) {
        if (answered_by_general_) {
            std::ranges::copy(general_.prices(), prices_.begin());
        } else if (current_.limits.rows && Record::has_force(code)) {
            for (int k = 0; k < int(current_.table.owners.size()); ++k) prices_[k] = row_price(k, record);
        }
    }
    Code run(Algorithm algorithm, const Request& ask, const Vec6& w, const Record& record) {
        switch (algorithm) {
            case Algorithm::newton: return newton(ask, w, record);
            case Algorithm::limited: return is_study(ask) ? general(ask, record) : within_limits(ask, w, record);
            case Algorithm::soft: return soft(ask, w, record);
            case Algorithm::flow: return flow(ask, w, record);
            case Algorithm::conic: return conic(ask, w, record);
            default: return general(ask, record);
        }
    }
    static bool is_study(const Request& ask) { return ask.optimum == ask.optimum || !ask.trace.empty(); }
    static Call call_of(const Request& ask, From from = From::given) {
        return {.wrench = ask.wrench,
                .start = from,
                .optimum = ask.optimum,
                .trace = ask.trace.data(),
                .traced = int(ask.trace.size())};
    }
    // Record a proof that uses only the cones.
    Code write_proof(const Vec6& w, const Record& record) {
        std::fill(prices_.begin(), prices_.end(), 0.0);
        return record.refute((1.0 / grasp::size(twist_)) * twist_, grasp::size(w));
    }

    Code newton(const Request& ask, const Vec6& w, const Record& record) {
        const Code begun = begin(ask, w);
        if (begun == INFEASIBLE) return write_proof(w, record);
        if (begun == REFUSED) return REFUSED;
        Code code = REFUSED;
        if (begun == CONVERGED) {
            descent_start_ = newton_.x;
            code = newton_.descend_from(descent_start_, call_of(ask), w, record);
        }
        if (code == REFUSED && used_start_ == Start::given) return REFUSED;
        if (!has_own_start(ask)) return code == REFUSED ? UNDECIDED : code;
        if (code == REFUSED) return general(ask, record);
        if (code == STALLED && !is_study(ask) && prepare_general()) code = general_.phi_from(newton_.options, record);
        return code;
    }

    Code flow(const Request& ask, const Vec6& w, const Record& record) {
        const Code begun = begin(ask, w);
        if (begun == INFEASIBLE) return write_proof(w, record);
        if (begun != CONVERGED) return begun;
        if (!flow_ready_) flow_ready_ = flow_->place(newton_.cones);
        return flow_ready_ ? flow_->descend(newton_, call_of(ask), w, record) : REFUSED;
    }

    Code within_limits(const Request& ask, const Vec6& w, const Record& record) {
        auto& on = limited_->newton;
        Call call = call_of(ask);
        Code begun = CONVERGED;
        used_start_ = start_of(ask), start_replaced_ = outside_training_ = false;
        if (used_start_ == Start::previous && load_previous(ask)) {
            call.start = From::tangent, call.force = force_.data();
            call.exceeding = ask.previous && Record(const_cast<double*>(ask.previous)).code() == LIMITS_EXCEEDED;
        }
        const bool follows = call.start == From::tangent;
        const auto make = [&](const Vec6&, bool previous) {
            begun = previous  ? (carry_previous(ask, w) ? CONVERGED : UNDECIDED)
                    : follows ? (start_replaced_ = true, default_start(ask, w))
                              : begin(ask, w);
            if (begun == CONVERGED) on.x = newton_.x;
            return begun == CONVERGED;
        };
        Code code = limited_->solve(call, record, make);
        if (code == INFEASIBLE)
            limited_->newton.rows.prices(
                [&](int m, double price) { prices_[m] = limited_->proof_scale * price / current_.table.sizes[m]; });
        if (code != REFUSED) return code;
        if (begun == INFEASIBLE) return write_proof(w, record);
        if (begun == REFUSED) return REFUSED;
        return has_own_start(ask) ? general(ask, record) : UNDECIDED;
    }

    Code soft(const Request& ask, const Vec6& w, const Record& record) {
        Call call = call_of(ask);
        used_start_ = start_of(ask), start_replaced_ = outside_training_ = false;
        if (used_start_ == Start::given) return general(ask, record);
        if (used_start_ == Start::previous && load_previous(ask)) {
            call.start = From::tangent, call.force = force_.data(), call.torsion = torsion_.data();
        }
        const bool follows = call.start == From::tangent;
        const auto make = [&](const Vec6&) {
            const Code begun = follows ? (start_replaced_ = true, default_start(ask, w)) : begin(ask, w);
            if (begun == CONVERGED) soft_->newton.x = newton_.x;
            return begun == CONVERGED;
        };
        if (call.start != From::tangent) call.torsion = nullptr;
        const Code code = soft_->solve(call, record, make);
        if (code != REFUSED) return code;
        return has_own_start(ask) ? general(ask, record) : UNDECIDED;
    }

    Code conic(const Request& ask, const Vec6& w, const Record& record) {
        used_start_ = Start::central, start_replaced_ = outside_training_ = false;
        if (!find_internal_force()) {
            const Code found = find_interior(w);
            used_start_ = Start::central, conic_ready_ = false;
            if (found == INFEASIBLE) return write_proof(w, record);
            if (!find_internal_force(true)) return general(ask, record);
        }
        prepare_conic();
        const Code code = conic_.solve(ask.wrench, record);
        if (code == REFUSED) return general(ask, record);
        return code != CONVERGED && prepare_general() ? general_.conic_from(newton_.options, record) : code;
    }

    // Run the general program from its own centre, a given force or the previous solution.
    Code general(const Request& ask, const Record& record) { return general(ask, record, newton_.options); }
    Code general(const Request& ask, const Record& record, const StopRule& stop) {
        if (!prepare_general()) return UNDECIDED;
        answered_by_general_ = true;
        if (options_.method == Method::conic) {
            used_start_ = Start::central;
            general_.conic(ask.wrench, options_.criterion, stop, record);
        } else {
            Call call = call_of(ask, From::combination);
            const Start start = start_of(ask);
            used_start_ = Start::phase_one;
            if (start == Start::given) {
                if (!load_given(ask)) return REFUSED;
                used_start_ = start, call.start = From::given, call.force = force_.data(), call.torsion = torsion_.data();
            } else if (start == Start::previous && load_previous(ask)) {
                used_start_ = start, call.start = From::tangent, call.force = force_.data(), call.torsion = torsion_.data();
            }
            const bool own = start == Start::internal_force || start == Start::phase_one ||
                             (start == Start::previous && !ask.previous && ask.force.empty());
            start_replaced_ = !own && (used_start_ == Start::phase_one || !general_.starts_from(call));
            if (start_replaced_) used_start_ = Start::phase_one, call.start = From::combination;
            StopRule left = stop;
            int spent = 0;
            if (used_start_ == Start::phase_one && start != Start::phase_one) {
                // half of the steps at most, so that some are left if it fails
                const bool good = unlimited_optimum(ask, options_.limit / 2, spent);
                left.limit = std::max(0, left.limit - spent);
                if (good) call.start = From::given, call.force = force_.data(), call.torsion = torsion_.data();
            }
            general_.phi(call, left, record);
            record.summary().iterations += spent, record.summary().trials += spent;
        }
        if (options_.elastic && record.code() == INFEASIBLE) return general_.excess(stop, record);
        return record.code();
    }

    // Solve without limits into force_ and torsion_. Return true if that optimum is well within the limits: such a start costs a tenth
    // of the deepest force. spent: number of steps.
    bool unlimited_optimum(const Request& ask, int limit, int& spent) {
        if (kind_ != Kind::other || !is_full_rank(current_.now) || !find_internal_force()) return false;
        const Record record(newton_.row.data(), current_.now.count);
        const Vec6 w = newton_.cones.unit.of(ask.wrench);
        grasp::begin(newton_.cones, internal_force_, w, newton_.x);
        const Call call{.wrench = ask.wrench};
        Code code = REFUSED;
        if (current_.now.soft()) {
            auto& on = soft_->newton;
            on.cones = newton_.cones, on.rows.pack(on.cones, current_.now, current_.divisor.data());
            on.options.limit = limit;
            code = soft_->solve(call, record, [&](const Vec6&) { return on.x = newton_.x, true; });
        } else {
            newton_.options.limit = limit;
            descent_start_ = newton_.x;
            code = newton_.descend_from(descent_start_, call, w, record);
        }
        if (soft_) soft_->newton.options.limit = options_.limit;
        newton_.options.limit = options_.limit;
        spent = int(record.summary().iterations);
        if (code != CONVERGED) return false;
        std::copy_n(record.force(), 3 * current_.now.count, force_.data()),
            std::copy_n(record.torsion(), current_.now.count, torsion_.data());
        double normals = 0.0;
        for (int i = 0; i < current_.now.count; ++i) normals += force_[3 * i] / current_.now.count;
        return general_.slack(force_.data(), torsion_.data()) > WELL_INSIDE * normals;
    }

    // --- the answer

    // Write `current_record` as a row of all contacts. optimum: true if it is an answer, with prices of the limits; false: a start.
    Code write_answer(Code code, const Record& out, bool optimum = true) {
        Summary& s = out.summary();
        const int all = current_.home.count;
        // rounding may leave no usable force; a start may miss balance by what is allowed for given forces
        const Record made = current_record();
        const bool usable = optimum ? is_sound(code, made) : made.summary().objective < infinity;
        if (Record::has_force(code) && !usable) code = UNDECIDED;
        s.code = code;
        if (!out.has_force()) {
            std::fill(out.force(), out.force() + size() - SUMMARY, 0.0);
            s.objective = infinity, s.lower_bound = -infinity;  // of no force; every bound holds where none exists
            if (code == INFEASIBLE) {
                const Summary& from = made.summary();
                s.iterations = from.iterations, s.trials = from.trials, s.residual = from.residual,
                s.multipliers = from.multipliers;
                s.lower_bound = infinity, s.start = double(used_start_), s.replaced = start_replaced_;
                current_.fill_prices(out.prices(), [&](int row) { return prices_[row]; });
            }
            return code;
        }
        const Record from = current_record();
        const Vec6 wrench = s.wrench;
        const double contacts = s.contacts, joints = s.joints, rows = s.limits;
        s = from.summary();
        s.code = code, s.wrench = wrench, s.contacts = contacts, s.joints = joints, s.limits = rows;
        s.start = double(used_start_), s.replaced = start_replaced_, s.outside = outside_training_;
        if (current_.now.count == all) {
            std::copy_n(from.force(), 7 * all, out.force());
            std::copy_n(current_.now.frames.data(), 9 * all, out.frames());
        } else {
            std::fill(out.force(), out.frames() + 9 * all, 0.0);
            for (int i = 0; i < current_.now.count; ++i) {
                const int to = current_.chosen[i];
                std::copy_n(from.force() + 3 * i, 3, out.force() + 3 * to);
                std::copy_n(from.initial_force() + 3 * i, 3, out.initial_force() + 3 * to);
                out.torsion()[to] = from.torsion()[i];
                std::copy_n(&current_.now.frames[9 * i], 9, out.frames() + 9 * to);
            }
        }
        if (current_.joints) current_.torques(from, out.torques());
        if (current_.limits.rows) {
            s.limit_excess = current_.excess(out);
            const bool priced = optimum && code != LIMITS_EXCEEDED;
            current_.fill_prices(out.prices(), [&](int row) { return priced ? prices_[row] : 0.0; });
        }
        if (code == LIMITS_EXCEEDED) s.objective = s.limit_excess;
        return code;
    }
    // Price of the k-th row of the current contacts at an optimum of Phi.
    double row_price(int k, const Record& from) const {
        const int i = current_.table.owners[k];
        double slack = current_.table.bounds[k];
        for (int a = 0; a < 3; ++a)
            slack -= current_.table.normals[3 * k + a] * from.force()[3 * i + a] * current_.now.scale[3 * i + a];
        return slack > 0.0 ? current_.table.weights[k] / (slack * slack * current_.table.sizes[k]) : 0.0;
    }
};

template <class V, int B> std::unique_ptr<Engine> make_lane_engine(const Problem& problem, const Options& options) {
    return std::make_unique<LaneEngine<V, B>>(problem, options);
}
template <int registers> std::unique_ptr<Engine> make_engine(const Problem& problem, const Options& options) {
    return dispatch(problem.contacts.count, [&]<class V, int B>() { return make_lane_engine<V, B>(problem, options); });
}

}  // namespace grasp::detail
