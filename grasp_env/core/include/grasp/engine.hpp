// The solver behind `ForceOptimizer`: chooses the algorithm for a problem and its start, and falls back on the general program.
#pragma once
#include <grasp/current.hpp>
#include <grasp/phi/basis.hpp>
#include <grasp/general/general.hpp>
#include <grasp/terms/limited.hpp>
#include <grasp/problem.hpp>
#include <grasp/terms/soft.hpp>

namespace grasp::detail {

// Classes of problems with an algorithm of their own.
enum class Kind {
    hard,  // hard, elliptic and frictionless contacts
    limited,  // the same, with limits on one contact each: normal forces, joints of one finger
    soft,  // some contacts are soft, and the normal and tangential forces alone give force closure
    other,  // everything else: joints that several fingers share, soft contacts within limits, force closure by torsion only
};
enum class Algorithm { newton, limited, soft, flow, conic, general };

// The algorithm for each method and kind of problem. If Newton, its variants or `conic` give up, the general program takes over. A
// flow has no fallback.
struct Plan {
    Method method;
    Kind kind;
    Algorithm algorithm;
};
inline constexpr Plan PLANS[] = {
    {Method::newton, Kind::hard, Algorithm::newton},     {Method::newton, Kind::limited, Algorithm::limited},
    {Method::newton, Kind::soft, Algorithm::soft},       {Method::newton, Kind::other, Algorithm::general},
    {Method::reduced_flow, Kind::hard, Algorithm::flow}, {Method::full_flow, Kind::hard, Algorithm::flow},
    {Method::conic, Kind::hard, Algorithm::conic},       {Method::conic, Kind::limited, Algorithm::general},
    {Method::conic, Kind::soft, Algorithm::general},     {Method::conic, Kind::other, Algorithm::general},
};
inline std::optional<Algorithm> planned(const Options& options, Kind kind) {
    for (const Plan& plan : PLANS)
        if (plan.method == options.method && plan.kind == kind)
            return plan.algorithm == Algorithm::conic && options.criterion != Criterion::sum ? Algorithm::general
                                                                                             : plan.algorithm;
    return {};
}

class alignas(64) Engine {
public:
    virtual ~Engine() = default;
    virtual std::unique_ptr<Engine> clone() const = 0;
    virtual Code solve(const Ask& ask, double* row) = 0;
    // Write the start alone into a record. Return LIMIT, since a descent would continue from it.
    virtual Code start(const Ask& ask, double* row) = 0;
    virtual void solve_many(std::ptrdiff_t count, const double* wrenches, double* rows) = 0;
    virtual bool update(const Now& now) = 0;
    virtual Deepest deepest(const double* wrench, double* force, double* torsion) = 0;
    // Set the offline optima of the problem's contacts, (13, 3N) in cone coordinates.
    virtual void set_basis(const double* basis) = 0;
    virtual double make_basis(double* basis, bool warm) = 0;
    virtual const Contacts& home() const = 0;
    virtual int size() const = 0;  // numbers in a row
};

template <class V, int B> class EngineOn final : public Engine {
public:
    using Field = typename Cones<V, B>::Field;

    EngineOn(const Problem& problem, const Options& options)
        : options_(options), at_(problem), newton_(at_.home.count, {options.gap(), options.limit}),
          conic_(at_.home.count, {options.gap(), std::min(options.limit, General::CONIC_ITERATIONS)}),
          home_tangents_(newton_.cones), rest_(newton_.cones.field()), origin_(rest_), spare_(rest_), guess_(rest_),
          general_(at_.home.count, at_.limits.rows, at_.home.soft()), inner_(record_size(at_.home.count)),
          force_(3 * at_.home.count), turn_(at_.home.count), proof_(at_.limits.rows) {
        if (at_.home.placing == Placing::refused || at_.home.placing == Placing::rank_lost)
            throw std::invalid_argument("the contacts must be placed: Contacts::from");
        if (at_.limits.rows) limited_.emplace(at_.home.count, newton_.options), limited_->elastic = options.elastic;
        if (at_.home.soft()) soft_.emplace(at_.home, newton_.options, at_.divisor.data());
        const bool flows = options.method == Method::reduced_flow || options.method == Method::full_flow;
        if (flows) {
            if (at_.limits.rows || at_.home.soft())
                throw std::invalid_argument("the flows know hard contacts without limits: use newton or conic");
            if (options.method == Method::full_flow && at_.home.count > FULL_CONTACTS)
                throw std::invalid_argument("the full flow is dense: at most 8 contacts");
        }
        if (!(options.tolerance <= 1.0)) throw std::invalid_argument("the tolerance is a part of the objective: at most 1");
        if (options.elastic && !at_.limits.rows) throw std::invalid_argument("elastic belongs to limits: add limits");
        if (options.criterion == Criterion::excess || (options.criterion != Criterion::sum && options.method != Method::conic))
            throw std::invalid_argument("the criterion belongs to conic: sum or largest");
        settle();
        if (flows)
            flow_.emplace(newton_.cones, options.step_rule, options.method == Method::full_flow ? Form::full : Form::reduced);
        if (options.model) {
            if (!options.model->fits(at_.home.count)) throw std::invalid_argument("the model is for another number of contacts");
            predicted_.emplace(newton_.cones, *options.model);
        }
        if (needs_basis()) fill_basis();
    }
    std::unique_ptr<Engine> clone() const override {
        auto made = std::make_unique<EngineOn>(*this);
        made->settle();  // space for all contacts, and no numbers of this object's last call
        return made;
    }
    const Contacts& home() const override { return at_.home; }
    int size() const override { return record_size(at_.home.count, at_.joints, at_.limits.rows); }

    void set_basis(const double* basis) override {
        place({});  // the last call may have used fewer contacts
        newton_.starter.set_basis(newton_.cones, basis, at_.home.frames.data());
    }
    double make_basis(double* basis, bool warm) override {
        place({});
        if (warm) newton_.starter.set_basis(newton_.cones, basis);
        const double gap = fill_basis(warm);
        if (gap < infinity)
            for (int k = 0; k < 13; ++k) newton_.cones.store(newton_.starter.basis[k], basis + 3 * at_.home.count * k);
        return gap;
    }

    Deepest deepest(const double* wrench, double* force, double* torsion) override {
        const bool ready = place({}) == CONVERGED && sane_wrench(wrench) && ready_general();
        return ready ? general_.deepest(wrench, 1e-7, force, torsion) : Deepest{};
    }

    Code solve(const Ask& ask, double* row) override {
        const Record out = opened(ask, row);
        Code code = place(ask.now);
        if (code == CONVERGED) code = sane_wrench(ask.wrench) ? run(ask, inner()) : REFUSED;
        return deliver(code, out);
    }

    Code start(const Ask& ask, double* row) override {
        const Record out = opened(ask, row);
        Code code = place(ask.now);
        if (code == CONVERGED) code = sane_wrench(ask.wrench) ? write_start(ask, inner()) : REFUSED;
        return deliver(code, out, false);
    }

    void solve_many(std::ptrdiff_t count, const double* wrenches, double* rows) override {
        const auto alone = [&](std::ptrdiff_t k) { solve({.wrench = wrenches + 6 * k}, rows + size() * k); };
        const bool placed = place({}) == CONVERGED;
        const auto algorithm = planned(options_, kind_);
        const bool side_by_side = count >= FEW && placed && options_.start == Start::standard &&
                                  (algorithm == Algorithm::newton || algorithm == Algorithm::conic) && rest();
        if (!side_by_side) {
            for (std::ptrdiff_t k = 0; k < count; ++k) alone(k);
            return;
        }
        std::vector<double> made(record_size(at_.home.count) * count);
        const Many many{count, wrenches, made.data()};
        if (algorithm == Algorithm::conic) {
            ready_conic();
            conic_many(conic_, many);
        } else {
            newton_many(newton_, rest_, many);
        }
        for (std::ptrdiff_t k = 0; k < count; ++k) {
            const Record record = many.record(k, at_.home.count);
            if (record.code() != CONVERGED) {
                alone(k);
                continue;
            }
            used_ = algorithm == Algorithm::conic ? Start::central : Start::internal_force, replaced_ = outside_ = false;
            const Record out = opened({.wrench = many.wrench(k)}, rows + size() * k);
            std::copy_n(&record.summary().code, record_size(at_.home.count), inner_.data());
            deliver(CONVERGED, out);
        }
    }

    bool update(const Now& now) override {
        if (now.contacts != Now{}.contacts) return false;  // a call says which contacts touch, an update cannot
        if (place(now) == REFUSED) {
            settle();
            return false;
        }
        at_.home = at_.now;
        if (!now.jacobian.empty()) at_.limits.jacobian.assign(now.jacobian.begin(), now.jacobian.end());
        if (!now.torque_bias.empty()) at_.limits.torque_bias.assign(now.torque_bias.begin(), now.torque_bias.end());
        settle();
        newton_.starter.has_basis = false;
        if (needs_basis()) fill_basis();
        return true;
    }

private:
    static constexpr double WELL_INSIDE = 1e-3;  // of the mean normal force: smallest slack of a start within limits
    // If Phi grows by this factor over the previous solution, another start is compared with it.
    static constexpr double CLOSE = 2.0;
    Options options_;
    Current at_;
    NewtonOn<V, B> newton_;
    std::optional<LimitedOn<V, B>> limited_;
    std::optional<SoftOn<V, B>> soft_;
    ConicOn<V, B> conic_;
    std::optional<FlowOn<V, B>> flow_;
    std::optional<Prediction<V, B>> predicted_;
    Tangents<V, B> home_tangents_;
    Field rest_, origin_, spare_, guess_;  // an internal force; start of a descent; work space; prediction of a model
    General general_;
    std::vector<double> inner_;  // record of the current contacts
    std::vector<double> force_, turn_;  // force and torsion of a start
    std::vector<double> proof_;  // (M,) prices of the limits in the proof that no force keeps them

    // State of the current contacts.
    Kind kind_ = Kind::hard;
    Code placed_ = REFUSED;
    bool home_now_ = false;  // true if they are the problem's own
    bool conic_ready_ = false, general_ready_ = false, flow_ready_ = false, rest_sought_ = false, has_rest_ = false;
    // State of this call's start.
    Start used_ = Start::standard;
    bool replaced_ = false, outside_ = false;
    bool by_general_ = false;  // true if the general program made the answer
    Vec6 twist_{};

    Record inner() { return Record(inner_.data(), at_.now.count); }
    bool torsional() const { return kind_ == Kind::soft || (kind_ == Kind::other && at_.now.soft()); }

    Record opened(const Ask& ask, double* row) const {
        Summary& s = *reinterpret_cast<Summary*>(row);
        s = Summary{};
        s.contacts = at_.home.count, s.joints = at_.joints, s.limits = at_.limits.rows;
        if (sane_wrench(ask.wrench)) std::copy_n(ask.wrench, 6, s.wrench.begin());
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
        if (placed_ != CONVERGED || (!warm && !squeezes())) return std::numeric_limits<double>::quiet_NaN();
        const double gap = grasp::make_basis(newton_, warm);
        starter.has_basis = gap < ACCEPTED_GAP, starter.basis_tangents = starter.tangents;
        return gap;
    }
    // Find an internal force strictly inside the cones and store it in newton_.x.
    bool squeezes() {
        if (newton_.internal_force()) return true;
        const double nothing[6] = {};
        if (!ready_general() || general_.deepest(nothing, 1e-7, force_.data(), nullptr).code != CONVERGED) return false;
        newton_.cones.load_force(force_.data(), newton_.x);
        return newton_.is_start(Vec6{});
    }

    // Return to the problem's own contacts and limits.
    void settle() {
        home_now_ = false;
        if (limited_) limited_->newton.rows.reserve(newton_.cones, std::min(at_.limits.rows, LimitTable::MOST_ROWS));
        place({});
        home_tangents_.load(at_.home.frames.data(), at_.home.count);
    }

    // Load the contacts and limits of a call. Return CONVERGED if that succeeds.
    Code place(const Now& now) {
        Now given = now;
        if (at_.touching(now.contacts) == at_.touching(~std::uint64_t(0))) given.contacts = ~std::uint64_t(0);
        const bool plain = given.empty();
        if (plain && home_now_) return placed_;
        home_now_ = plain;
        return placed_ = take(given);
    }
    Code take(const Now& now) {
        conic_ready_ = general_ready_ = flow_ready_ = rest_sought_ = has_rest_ = false;
        const Code code = at_.take(now);
        if (code != CONVERGED) return code;
        set_count(at_.now.count);
        newton_.cones.pack(at_.now);
        newton_.starter.tangents.load(at_.now.frames.data(), at_.now.count);
        newton_.starter.moved = !home_now_;
        const bool soft = at_.now.soft(), closes = at_.now.placing != Placing::needs_torsion;
        kind_ = !at_.separate || (soft && (at_.limits.rows || !closes)) ? Kind::other
                : soft                                                  ? Kind::soft
                : at_.limits.rows                                       ? Kind::limited
                                                                        : Kind::hard;
        if (kind_ == Kind::soft) {
            soft_->newton.cones = newton_.cones;
            soft_->newton.rows.pack(newton_.cones, at_.now, at_.divisor.data());
        } else if (kind_ == Kind::limited) {
            limited_->newton.cones = newton_.cones;
            limited_->newton.rows.pack(newton_.cones, at_.table.rows());
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
        clear(newton_.x), clear(origin_), clear(spare_), clear(guess_), clear(rest_);
        if (limited_) clear(limited_->newton.x);
        if (soft_) clear(soft_->newton.x);
    }
    void ready_conic() {
        if (conic_ready_) return;
        conic_.cones = newton_.cones, conic_.rest = rest_, conic_ready_ = true;
    }
    bool ready_general() {
        if (!general_ready_ || !general_.placed())  // a copied program has no contacts yet
            general_ready_ =
                general_.place(at_.now, torsional() ? at_.divisor.data() : nullptr,
                               at_.limits.rows ? at_.limits_in_place() : ForceLimits{}, 4, internal()) == Placing::good;
        return general_ready_;
    }
    // An internal force in the form the general program takes; null if there is none.
    const double* internal() {
        if (torsional() || !rest(options_.method == Method::conic)) return nullptr;
        newton_.cones.store_force(rest_, force_.data());
        return force_.data();
    }
    // Find an internal force of the current contacts, scaled to least Phi. Return false without force closure.
    bool rest(bool thorough = false) {
        if (!rest_sought_ || (thorough && !has_rest_)) {
            rest_sought_ = true;
            has_rest_ = newton_.find_rest(rest_, !thorough);
        }
        return has_rest_;
    }

    // --- starts

    Start asked(const Ask& ask) const {
        const Start start = ask.start == Start::standard ? options_.start : ask.start;
        if (start != Start::standard) return start;
        return flow_ ? Start::linear_combination : Start::internal_force;
    }

    // Write the start of a call, balanced and strictly inside the cones, into newton_.x. Otherwise return the reason.
    Code begin(const Ask& ask, const Vec6& w) {
        const Code code = find_start(ask, w);
        if (code != CONVERGED) return code;
        newton_.cones.settle(newton_.x);
        return ask.adjustment.empty() || adjust(ask.adjustment, w) ? CONVERGED : REFUSED;
    }
    // Add a force (N, 3) along the axes of the positions to the start and take the point of least Phi between the two.
    bool adjust(Doubles by, const Vec6& w) {
        if (by.size() != std::size_t(3 * at_.home.count)) return false;
        newton_.cones.store_force(spare_ = newton_.x, force_.data());
        for (int i = 0; i < at_.now.count; ++i)
            for (int a = 0; a < 3; ++a)
                for (int r = 0; r < 3; ++r) force_[3 * i + a] += at_.now.frames[9 * i + 3 * r + a] * by[3 * at_.chosen[i] + r];
        newton_.cones.load_force(force_.data(), newton_.x);
        if (!newton_.cones.sane(newton_.x)) return false;
        newton_.cones.balance(newton_.x, w);
        newton_.starter.segment(newton_.cones, spare_, newton_.x);
        return true;
    }
    Code find_start(const Ask& ask, const Vec6& w) {
        replaced_ = outside_ = false;
        const Start start = used_ = asked(ask);
        switch (start) {
            case Start::given: return load_force(ask.force) && newton_.is_start(w) ? CONVERGED : REFUSED;
            case Start::previous:
                if (!ask.previous && ask.force.empty()) return standard(ask, w);
                if (carry(ask, w)) return CONVERGED;
                break;
            case Start::guess:
                if (ask.force.size() != std::size_t(3 * at_.home.count)) return REFUSED;
                return standard(ask, w) == CONVERGED && guess(ask, w) ? CONVERGED : UNDECIDED;
            case Start::learned:
                if (predicted_ && predict(ask, w)) return CONVERGED;
                break;
            case Start::phase_one: return search(ask, w);
            case Start::internal_force: return squeeze(ask, w);
            case Start::linear_combination:
            case Start::linear_combination_printed:
            case Start::single_value:
            case Start::lagrange:
                if (combine(ask.wrench, w, start)) return CONVERGED;
                break;
            default: return standard(ask, w);
        }
        const Code code = standard(ask, w);
        const bool named = ask.start != Start::standard || options_.start != Start::standard;
        replaced_ = named || used_ != Start::phase_one;  // without force closure, phase one is the default
        return code;
    }
    // The method's default start, or any force inside if the contacts have no force closure.
    Code standard(const Ask& ask, const Vec6& w) {
        const bool combines = flow_ || options_.start == Start::linear_combination;
        if (combines && combine(ask.wrench, w, used_ = Start::linear_combination)) return CONVERGED;
        return squeeze(ask, w);
    }
    Code squeeze(const Ask& ask, const Vec6& w) {
        if (!rest()) return search(ask, w);
        used_ = Start::internal_force;
        grasp::begin(newton_.cones, rest_, w, newton_.x);
        return newton_.cones.phi(newton_.x) < infinity ? CONVERGED : UNDECIDED;
    }
    // Find any force inside the cones, or a proof that no balanced force touches them. Return UNDECIDED if neither is found
    // quickly.
    Code look(const Vec6& w) {
        used_ = Start::phase_one;
        ready_conic();
        int steps = 0;
        const auto found = conic_.find_inside(w, newton_.x, twist_, steps);
        using Inside = typename ConicOn<V, B>::Inside;
        if (found == Inside::none) twist_ = newton_.cones.unit.pull_back(twist_);
        if (found == Inside::found && !(newton_.cones.phi(newton_.x) < infinity)) return UNDECIDED;  // numbers out of range
        return found == Inside::found ? CONVERGED : found == Inside::none ? INFEASIBLE : UNDECIDED;
    }
    // Like `look`; if that is undecided, find the deepest force.
    Code search(const Ask& ask, const Vec6& w) {
        if (const Code code = look(w); code != UNDECIDED) return code;
        if (kind_ != Kind::hard || !ready_general()) return UNDECIDED;
        const Deepest deep = general_.deepest(ask.wrench, 1e-7, force_.data(), nullptr);
        twist_ = deep.twist;
        if (deep.code != CONVERGED) return deep.code == INFEASIBLE ? INFEASIBLE : UNDECIDED;
        newton_.cones.load_force(force_.data(), newton_.x);
        return newton_.is_start(w) ? CONVERGED : UNDECIDED;
    }
    // A start from the offline optima: the paper's, or a relative of it.
    bool combine(const double* wrench, const Vec6& w, Start start) {
        auto& starter = newton_.starter;
        if (!starter.has_basis || at_.now.count != at_.home.count) return false;
        Field& x = newton_.x;
        if (start == Start::linear_combination) return starter.combination(newton_.cones, newton_.system, wrench, w, x);
        if (!home_now_) return false;
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
        const int size = 3 * at_.now.count;
        Packed6 s{};
        Vec6 squeezed{};
        for (int j = 0; j < size; ++j) {
            const Vec6 made = column(at_.now.force_rows.data(), size, j);
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
                force_[j] = (j % 3 == 0 ? normal : 0.0) - dot(column(at_.now.force_rows.data(), size, j), by) / WEIGHT[j % 3];
            newton_.cones.load_force(force_.data(), x);
        };
        field(of_wrench, 0.0, newton_.x), field(of_squeeze, 1.0, spare_);
        const auto [low, high] = inside(newton_.cones, newton_.x, spare_);
        if (!(low < high)) return false;
        newton_.cones.store_force(newton_.starter.basis[12], force_.data());
        double floor = 0.0;
        for (int i = 0; i < at_.now.count; ++i) floor += force_[3 * i] / at_.now.count;
        const double k = std::min(std::max(1.1 * low, floor), 0.5 * (low + high));
        for (int b = 0; b < int(spare_.size()); ++b) newton_.x[b] += all<V>(k) * spare_[b];
        return true;
    }

    // Turn a previous solution into the current frames and balance it by the smallest change in the metric of the Hessian.
    bool carry(const Ask& ask, const Vec6& w) {
        if (!load_previous(ask)) return false;
        Field& x = newton_.x;
        const double before = newton_.cones.phi(x);
        const bool follows = before < infinity && newton_.starter.tangent(newton_.cones, newton_.system, w, x);
        if (follows && newton_.cones.phi(x) <= CLOSE * before) return true;
        if (!follows) newton_.cones.balance(x, w);
        origin_ = x;
        if (!rest()) return follows && newton_.cones.phi(x) < infinity;
        grasp::begin(newton_.cones, rest_, w, spare_);
        x = origin_;
        return newton_.starter.segment(newton_.cones, spare_, x) > 0.0;
    }
    // Load a caller's force (N, 3) of the touching contacts into newton_.x and force_.
    bool load_force(Doubles force) {
        if (force.size() != std::size_t(3 * at_.home.count)) return false;
        for (int i = 0; i < at_.now.count; ++i) std::copy_n(&force[3 * at_.chosen[i]], 3, &force_[3 * i]), turn_[i] = 0.0;
        newton_.cones.load_force(force_.data(), newton_.x);
        return true;
    }
    // Load the previous solution of the touching contacts, in their current frames, into newton_.x, force_ and turn_.
    bool load_previous(const Ask& ask) {
        if (!ask.previous) return load_force(ask.force) && newton_.cones.sane(newton_.x);
        const Record before(const_cast<double*>(ask.previous));  // only read
        if (before.contacts() != at_.home.count || !before.has_force()) return false;
        for (int i = 0; i < at_.now.count; ++i) {
            const double *f = before.force() + 3 * at_.chosen[i], *from = before.frames() + 9 * at_.chosen[i],
                         *to = &at_.now.frames[9 * i];
            double* out = &force_[3 * i];
            turn_[i] = before.torsion()[at_.chosen[i]];
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
        return newton_.cones.sane(newton_.x) &&
               std::all_of(turn_.begin(), turn_.end(), [](double v) { return std::abs(v) < infinity; });
    }

    // Load a given force into force_ and turn_. Return true if it is balanced and strictly inside the cones.
    bool load_given(const Ask& ask) {
        const std::size_t all = at_.home.count;
        if (ask.force.size() != 3 * all || (!ask.torsion.empty() && ask.torsion.size() != all)) return false;
        double most = 0.0;
        for (int i = 0; i < at_.now.count; ++i) {
            const double* f = &ask.force[3 * at_.chosen[i]];
            std::copy_n(f, 3, &force_[3 * i]);
            turn_[i] = ask.torsion.empty() ? 0.0 : ask.torsion[at_.chosen[i]];
            if (turn_[i] != 0.0 && !(at_.divisor[i] * std::abs(turn_[i]) < at_.now.scale[3 * i] * f[0])) return false;
            for (int a = 0; a < 3; ++a) most = std::max(most, std::abs(f[a]));
        }
        newton_.cones.load_force(force_.data(), newton_.x);
        if (!newton_.cones.sane(newton_.x) || !(newton_.cones.phi(newton_.x) < infinity)) return false;
        const double missed = general_.missed(ask.wrench, force_.data(), turn_.data());
        return missed <= General::BALANCE_TOLERANCE * (most + grasp::size(newton_.cones.unit.of(ask.wrench)));
    }

    // If Phi at the balanced newton_.x exceeds Phi at the default start in spare_, take the point of least Phi between them. For a
    // guess, always do so.
    void bring_inside(const Vec6& w, Start start) {
        const auto& cones = newton_.cones;
        const double own = cones.phi(spare_);
        double share = 1.0;
        if (start == Start::guess || !(cones.phi(newton_.x) <= own)) {
            share = newton_.starter.segment(cones, spare_, newton_.x);
            if (!(cones.phi(newton_.x) <= own)) newton_.x = spare_, share = 0.0;  // rounding
        }
        replaced_ = !(share > 0.0) && dot(w, w) > 0.0;
        if (!replaced_) used_ = start;
    }
    // Start from a caller's force, with the default start in newton_.x.
    bool guess(const Ask& ask, const Vec6& w) {
        spare_ = newton_.x;
        load_force(ask.force);
        newton_.cones.balance(newton_.x, w);
        bring_inside(w, Start::guess);
        return newton_.cones.phi(newton_.x) < infinity;
    }

    // Start from the model's prediction. Phi is never above that of the default start. If a previous solution is given, the better
    // of the two is used.
    bool predict(const Ask& ask, const Vec6& w) {
        if (at_.now.count != at_.home.count) return false;
        const auto& cones = newton_.cones;
        auto& starter = newton_.starter;
        outside_ = !predicted_->covers(w);
        if (standard(ask, w) != CONVERGED) return false;
        spare_ = newton_.x;
        Field& x = newton_.x;
        if (home_now_) {
            for (int b = 0; b < int(x.size()); ++b) x[b] = -cones.blocks[b].least(w);
            predicted_->add(w, x);
        } else {  // the predicted internal force turns with the contacts
            for (auto& v : origin_) v = {V{}, V{}, V{}};
            predicted_->add(w, origin_);
            starter.turn(cones, origin_, home_tangents_, x);
            cones.balance(x, w);
        }
        const Start from = used_;
        bring_inside(w, Start::learned);
        if (ask.previous) {
            guess_ = x;
            const Start now = used_;
            if (carry(ask, w) && cones.phi(x) < cones.phi(guess_)) used_ = Start::previous, replaced_ = false;
            else x = guess_, used_ = now;
        }
        if (replaced_) used_ = from;
        return true;
    }

    // Write the start that a solve would use as a record.
    Code write_start(const Ask& ask, const Record& record) {
        record.clear();
        const Vec6 w = newton_.cones.unit.of(ask.wrench);
        by_general_ = false;
        const bool general_serves =
            planned(options_, kind_) == Algorithm::general || (kind_ == Kind::soft && asked(ask) == Start::given);
        const Code code = general_serves ? UNDECIDED : begin(ask, w);
        if (code == CONVERGED) {
            newton_.cones.store_force(newton_.x, record.initial_force());
            newton_.cones.certify(newton_.x, w, record);
            record.summary().objective = newton_.cones.phi(newton_.x), record.summary().lower_bound = -infinity;
            return LIMIT;
        }
        if (code == INFEASIBLE && kind_ != Kind::soft) return refuted(w, record);
        if (code == REFUSED) return REFUSED;
        if (flow_) return code;
        const Code made = general(ask, record, {options_.gap(), 0});
        return made == CONVERGED || made == STALLED ? LIMIT : made;
    }

    // --- algorithms

    Code run(const Ask& ask, const Record& record) {
        Summary& s = record.summary();
        s = Summary{};
        std::copy_n(ask.wrench, 6, s.wrench.begin());
        const auto algorithm = planned(options_, kind_);
        if (!algorithm) return REFUSED;
        const Vec6 w = newton_.cones.unit.of(ask.wrench);
        by_general_ = false;
        switch (*algorithm) {
            case Algorithm::newton: return newton(ask, w, record);
            case Algorithm::limited: return studied(ask) ? general(ask, record) : within_limits(ask, w, record);
            case Algorithm::soft: return soft(ask, w, record);
            case Algorithm::flow: return flow(ask, w, record);
            case Algorithm::conic: return conic(ask, w, record);
            default: return general(ask, record);
        }
    }
    static bool studied(const Ask& ask) { return ask.optimum == ask.optimum || !ask.trace.empty(); }
    static Call call_of(const Ask& ask, From from = From::given) {
        return {.wrench = ask.wrench,
                .start = from,
                .optimum = ask.optimum,
                .trace = ask.trace.data(),
                .traced = int(ask.trace.size())};
    }
    // Record a proof that uses only the cones.
    Code refuted(const Vec6& w, const Record& record) {
        std::fill(proof_.begin(), proof_.end(), 0.0);
        return record.refute((1.0 / grasp::size(twist_)) * twist_, grasp::size(w));
    }

    Code newton(const Ask& ask, const Vec6& w, const Record& record) {
        const Code begun = begin(ask, w);
        if (begun == INFEASIBLE) return refuted(w, record);
        if (begun == REFUSED) return REFUSED;
        Code code = REFUSED;
        if (begun == CONVERGED) {
            origin_ = newton_.x;
            code = newton_.descend_from(origin_, call_of(ask), w, record);
        }
        if (code == REFUSED) return used_ == Start::given ? REFUSED : general(ask, record);
        if (code == STALLED && !studied(ask) && ready_general()) code = general_.phi_from(newton_.options, record);
        return code;
    }

    Code flow(const Ask& ask, const Vec6& w, const Record& record) {
        const Code begun = begin(ask, w);
        if (begun == INFEASIBLE) return refuted(w, record);
        if (begun != CONVERGED) return begun;
        if (!flow_ready_) flow_ready_ = flow_->place(newton_.cones);
        return flow_ready_ ? flow_->descend(newton_, call_of(ask), w, record) : REFUSED;
    }

    Code within_limits(const Ask& ask, const Vec6& w, const Record& record) {
        auto& on = limited_->newton;
        Call call = call_of(ask);
        Code begun = CONVERGED;
        used_ = asked(ask), replaced_ = outside_ = false;
        if (used_ == Start::previous && load_previous(ask)) {
            call.start = From::tangent, call.force = force_.data();
            call.exceeding = ask.previous && Record(const_cast<double*>(ask.previous)).code() == LIMITS_EXCEEDED;
        }
        const bool follows = call.start == From::tangent;
        const auto make = [&](const Vec6&, bool previous) {
            begun = previous  ? (carry(ask, w) ? CONVERGED : UNDECIDED)
                    : follows ? (replaced_ = true, standard(ask, w))
                              : begin(ask, w);
            if (begun == CONVERGED) on.x = newton_.x;
            return begun == CONVERGED;
        };
        Code code = limited_->solve(call, record, make);
        if (code == INFEASIBLE)
            limited_->newton.rows.prices([&](int m, double price) { proof_[m] = limited_->per * price / at_.table.sizes[m]; });
        if (code != REFUSED) return code;
        if (begun == INFEASIBLE) return refuted(w, record);
        if (begun == REFUSED && used_ == Start::given) return REFUSED;
        return general(ask, record);
    }

    Code soft(const Ask& ask, const Vec6& w, const Record& record) {
        Call call = call_of(ask);
        used_ = asked(ask), replaced_ = outside_ = false;
        if (used_ == Start::given) return general(ask, record);
        if (used_ == Start::previous && load_previous(ask)) {
            call.start = From::tangent, call.force = force_.data(), call.torsion = turn_.data();
        }
        const bool follows = call.start == From::tangent;
        const auto make = [&](const Vec6&) {
            const Code begun = follows ? (replaced_ = true, standard(ask, w)) : begin(ask, w);
            if (begun == CONVERGED) soft_->newton.x = newton_.x;
            return begun == CONVERGED;
        };
        if (call.start != From::tangent) call.torsion = nullptr;
        const Code code = soft_->solve(call, record, make);
        return code == REFUSED ? general(ask, record) : code;
    }

    Code conic(const Ask& ask, const Vec6& w, const Record& record) {
        used_ = Start::central, replaced_ = outside_ = false;
        if (!rest()) {
            const Code found = look(w);
            used_ = Start::central, conic_ready_ = false;
            if (found == INFEASIBLE) return refuted(w, record);
            if (!rest(true)) return general(ask, record);
        }
        ready_conic();
        const Code code = conic_.solve(ask.wrench, record);
        if (code == REFUSED) return general(ask, record);
        return code != CONVERGED && ready_general() ? general_.conic_from(newton_.options, record) : code;
    }

    // Run the general program from its own centre, a given force or the previous solution.
    Code general(const Ask& ask, const Record& record) { return general(ask, record, newton_.options); }
    Code general(const Ask& ask, const Record& record, const Stop& stop) {
        if (!ready_general()) return UNDECIDED;
        by_general_ = true;
        if (options_.method == Method::conic) {
            used_ = Start::central;
            general_.conic(ask.wrench, options_.criterion, stop, record);
        } else {
            Call call = call_of(ask, From::combination);
            const Start start = asked(ask);
            used_ = Start::phase_one;
            if (start == Start::given) {
                if (!load_given(ask)) return REFUSED;
                used_ = start, call.start = From::given, call.force = force_.data(), call.torsion = turn_.data();
            } else if (start == Start::previous && load_previous(ask)) {
                used_ = start, call.start = From::tangent, call.force = force_.data(), call.torsion = turn_.data();
            }
            const bool own = start == Start::internal_force || start == Start::phase_one ||
                             (start == Start::previous && !ask.previous && ask.force.empty());
            replaced_ = !own && (used_ == Start::phase_one || !general_.starts_from(call));
            if (replaced_) used_ = Start::phase_one, call.start = From::combination;
            Stop left = stop;
            int spent = 0;
            if (used_ == Start::phase_one && start != Start::phase_one && free_optimum(ask, options_.limit, spent)) {
                left.limit = std::max(0, left.limit - spent);
                call.start = From::given, call.force = force_.data(), call.torsion = turn_.data();
            }
            general_.phi(call, left, record);
            record.summary().iterations += spent, record.summary().trials += spent;
        }
        if (options_.elastic && record.code() == INFEASIBLE) return general_.excess(stop, record);
        return record.code();
    }

    // Solve without limits into force_ and turn_. Return true if that optimum is well within the limits: such a start costs a tenth
    // of the deepest force. spent: number of steps.
    bool free_optimum(const Ask& ask, int limit, int& spent) {
        if (kind_ != Kind::other || at_.now.placing != Placing::good || !rest()) return false;
        const Record record(newton_.row.data(), at_.now.count);
        const Vec6 w = newton_.cones.unit.of(ask.wrench);
        grasp::begin(newton_.cones, rest_, w, newton_.x);
        const Call call{.wrench = ask.wrench};
        Code code = REFUSED;
        if (at_.now.soft()) {
            auto& on = soft_->newton;
            on.cones = newton_.cones, on.rows.pack(on.cones, at_.now, at_.divisor.data());
            on.options.limit = limit;
            code = soft_->solve(call, record, [&](const Vec6&) { return on.x = newton_.x, true; });
        } else {
            newton_.options.limit = limit;
            origin_ = newton_.x;
            code = newton_.descend_from(origin_, call, w, record);
        }
        if (soft_) soft_->newton.options.limit = options_.limit;
        newton_.options.limit = options_.limit;
        spent = int(record.summary().iterations);
        if (code != CONVERGED) return false;
        std::copy_n(record.force(), 3 * at_.now.count, force_.data()), std::copy_n(record.torsion(), at_.now.count, turn_.data());
        double normals = 0.0;
        for (int i = 0; i < at_.now.count; ++i) normals += force_[3 * i] / at_.now.count;
        return general_.slack(force_.data(), turn_.data()) > WELL_INSIDE * normals;
    }

    // --- the answer

    // Write `inner` as a row of all contacts. optimum: true if the limits have prices there.
    Code deliver(Code code, const Record& out, bool optimum = true) {
        Summary& s = out.summary();
        const int all = at_.home.count;
        // without a finite objective, rounding left no usable force
        if ((code == STALLED || code == LIMIT) && !(inner().summary().objective < infinity)) code = UNDECIDED;
        s.code = code;
        if (!out.has_force()) {
            std::fill(out.force(), out.force() + size() - SUMMARY, 0.0);
            if (code == INFEASIBLE) {
                const Summary& from = inner().summary();
                s.iterations = from.iterations, s.trials = from.trials, s.residual = from.residual,
                s.multipliers = from.multipliers;
                s.objective = s.lower_bound = infinity, s.start = double(used_), s.replaced = replaced_;
                at_.fill_prices(out.prices(), [&](int row) { return by_general_ ? general_.prices()[row] : proof_[row]; });
            }
            return code;
        }
        const Record from = inner();
        const Vec6 wrench = s.wrench;
        const double contacts = s.contacts, joints = s.joints, rows = s.limits;
        s = from.summary();
        s.code = code, s.wrench = wrench, s.contacts = contacts, s.joints = joints, s.limits = rows;
        s.start = double(used_), s.replaced = replaced_, s.outside = outside_;
        if (at_.now.count == all) {
            std::copy_n(from.force(), 7 * all, out.force());
            std::copy_n(at_.now.frames.data(), 9 * all, out.frames());
        } else {
            std::fill(out.force(), out.frames() + 9 * all, 0.0);
            for (int i = 0; i < at_.now.count; ++i) {
                const int to = at_.chosen[i];
                std::copy_n(from.force() + 3 * i, 3, out.force() + 3 * to);
                std::copy_n(from.initial_force() + 3 * i, 3, out.initial_force() + 3 * to);
                out.torsion()[to] = from.torsion()[i];
                std::copy_n(&at_.now.frames[9 * i], 9, out.frames() + 9 * to);
            }
        }
        if (at_.joints) at_.torques(from, out.torques());
        if (at_.limits.rows) {
            s.limit_excess = at_.excess(out);
            const bool priced = optimum && code != LIMITS_EXCEEDED;
            at_.fill_prices(out.prices(), [&](int row) { return priced ? row_price(row, from) : 0.0; });
        }
        if (code == LIMITS_EXCEEDED) s.objective = s.limit_excess;
        return code;
    }
    // Price of the k-th row of the current contacts at an optimum.
    double row_price(int k, const Record& from) const {
        if (by_general_) return general_.prices()[k];
        const int i = at_.table.owners[k];
        double slack = at_.table.bounds[k];
        for (int a = 0; a < 3; ++a) slack -= at_.table.normals[3 * k + a] * from.force()[3 * i + a] * at_.now.scale[3 * i + a];
        return slack > 0.0 ? at_.table.weights[k] / (slack * slack * at_.table.sizes[k]) : 0.0;
    }
};

}  // namespace grasp::detail
