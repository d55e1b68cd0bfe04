// Contacts that move from call to call: frames and G, the start, Newton or the flow, and the certificates in one call.
#pragma once
#include <memory>
#include <optional>
#include <grasp/contacts/adjust.hpp>
#include <grasp/phi/basis.hpp>
#include <grasp/flow/flow.hpp>
#include <grasp/math/dispatch.hpp>
#include <grasp/phi/newton.hpp>

namespace grasp {

// What is held between calls, written in the contact frames that it was found in.
struct Held {
    std::vector<double> x;             // (3N,) the last optimum, cone coordinates [N]; nan: none
    std::vector<double> frames;        // (N, 3, 3) its contact frames, columns (n, o, t), object frame
    std::vector<double> cone_matrix;   // (6, 3N) its G in cone coordinates
    std::vector<double> basis;         // (13, 3N) the offline basis, cone coordinates
    std::vector<double> basis_frames;  // (N, 3, 3) the contact frames it is written in

    explicit Held(int count)
        : x(3 * count), frames(9 * count), cone_matrix(18 * count), basis(39 * count), basis_frames(9 * count) {}
};

struct Load {
    const double *points, *normals;  // (N, 3) contact points [m] and inward unit normals, object frame
    const double* wrench;            // (6,) [N, N m], object frame
    const double* adjust = nullptr;  // (3N - 6,) coordinates [N] of an internal force added to the start, or none
};

// How a force was carried.
enum Carried { CARRIED, REPAIRED, CLIPPED };

template <class V, int B> class PipelineOn {
public:
    using Field = typename Cones<V, B>::Field;
    Contacts contacts;  // of the last call
    NewtonOn<V, B> newton;
    Held held;
    bool remembers;  // whether to start from the last optimum

    // basis: (13, 3N) of the nominal contacts, whose frames (N, 3, 3) it is written in.
    // flows: the rule of the reduced flow, or null: Newton.
    PipelineOn(const Contacts& nominal, const Stop& options, const double* basis, const double* frames, bool remembers,
               const double* reference, const StepRule* flows)
        : contacts(nominal), newton(nominal.count, options), held(nominal.count), remembers(remembers),
          nominal_(basis, basis + 39 * nominal.count), nominal_frames_(frames, frames + 9 * nominal.count),
          space_(nominal.count, reference), adjusted_(3 * nominal.count), spare_(newton.starter.basis), last_(newton.cones),
          turned_(newton.cones.field()), safe_(newton.cones.field()) {
        if (flows) flow_.emplace(newton.cones, *flows, Form::reduced);
        reset();
    }

    // Forgets all calls.
    void reset() {
        set_basis(nominal_.data(), nominal_frames_.data());
        forget();
    }
    void forget() { std::fill(held.x.begin(), held.x.end(), std::numeric_limits<double>::quiet_NaN()); }

    void set_basis(const double* basis, const double* frames) {
        newton.starter.set_basis(newton.cones, basis, frames);
        std::copy(basis, basis + 39 * contacts.count, held.basis.begin());
        std::copy(frames, frames + 9 * contacts.count, held.basis_frames.begin());
    }

    // REFUSED: the general path has to say why, and the last optimum stays.
    Code solve(const Load& load, double* row) {
        const Record record(row, contacts.count);
        record.summary().code = REFUSED;
        if (!begin(load) || (load.adjust && !adjust(load))) return REFUSED;
        const Code code = descend(load.wrench, record);
        if (code != REFUSED) keep(record);
        return code;
    }

    // Between two solves: the last optimum carried to the current contacts and wrench, back inside the cones if need be. Changes
    // nothing that is held. force: (N, 3) [N] in the frames of the current contacts.
    Carried carry(const Load& load, double* force) {
        const Placing placed = place(load);
        newton.cones.load(held.x.data(), newton.x);
        return carry_turned(load, placed, held.frames.data(), force);
    }
    // The same of forces (N, 3) [N] in frames (N, 3, 3) of contacts nearby; `force` may be `then`.
    Carried carry_from(const Load& load, const double* then, const double* frames, double* force) {
        const Placing placed = place(load);
        newton.cones.load_force(then, newton.x);
        return carry_turned(load, placed, frames, force);
    }

private:
    // What is in newton.x, in such frames, carried.
    Carried carry_turned(const Load& load, Placing placed, const double* frames, double* force) {
        const auto& cones = newton.cones;
        auto& starter = newton.starter;
        if (placed == Placing::refused) {
            std::fill(force, force + 3 * contacts.count, 0.0);
            return CLIPPED;
        }
        turn_from(frames);
        const Vec6 w = cones.unit.of(load.wrench);
        Field& x = newton.x;
        x = turned_;
        const bool spans = placed == Placing::good;
        Carried outcome = CARRIED;
        if (spans && newton.system.assemble(cones, x)) newton.system.restore(cones, newton.system.made + w, x);
        if (!spans || !(cones.phi(x) < infinity)) {
            starter.combine(load.wrench, turned_);
            starter.turn(cones, turned_, starter.basis_tangents, safe_);
            if (!cones.sane(x)) x = safe_;
            if (spans && starter.tangent(cones, newton.system, w, safe_) && cones.phi(safe_) < infinity) {
                starter.segment(cones, safe_, x);
                outcome = REPAIRED;
            } else {  // give up a little balance (a pose feedback takes it back), never the friction cone
                for (auto& v : x) v.u = max(v.u, 1.05 * sqrt(v.o * v.o + v.t * v.t));
                outcome = CLIPPED;
            }
        }
        cones.store_force(x, force);
        return outcome;
    }

    std::vector<double> nominal_, nominal_frames_;
    NullSpace space_;
    std::vector<double> adjusted_;  // (3N,) a start to work with
    std::optional<FlowOn<V, B>> flow_;
    std::array<Field, 13> spare_;
    Tangents<V, B> last_;  // those of the last optimum
    Field turned_, safe_;

    // Current contacts and the start there, in newton.x; false where there is none.
    bool begin(const Load& load) {
        if (place(load) != Placing::good) return false;
        const Vec6 w = newton.cones.unit.of(load.wrench);
        auto& starter = newton.starter;
        if (!starter.combination(newton.cones, newton.system, load.wrench, w, safe_)) {
            if (!renew()) return false;
            starter.combine(load.wrench, safe_);
            newton.cones.balance(safe_, w);
        }
        const bool carried = remembers && turn_last();
        newton.x = carried ? turned_ : safe_;
        if (carried) starter.carry(newton.cones, newton.system, safe_, w, From::tangent, newton.x);
        return true;
    }

    // An internal force, in (3N - 6,) coordinates [N], added to the start, which is then repaired; false where it is not finite
    // or the coordinates end here.
    bool adjust(const Load& load) {
        if (!space_.place(contacts)) return false;
        newton.cones.store(newton.x, adjusted_.data());
        for (int j = 0; j < 3 * contacts.count; ++j) adjusted_[j] += space_.force(j, load.adjust) * contacts.scale[j];
        newton.cones.load(adjusted_.data(), newton.x);
        if (!newton.cones.sane(newton.x)) return false;
        newton.cones.balance(newton.x, newton.cones.unit.of(load.wrench));
        newton.starter.segment(newton.cones, safe_, newton.x);
        return true;
    }

    // Newton, or the flow, from the start in newton.x.
    Code descend(const double* wrench, const Record& record) {
        const Vec6 w = newton.cones.unit.of(wrench);
        const Call call{.wrench = wrench, .start = From::given};
        if (flow_) return flow_->place(newton.cones) ? flow_->descend(newton, call, w, record) : REFUSED;
        turned_ = newton.x;
        return newton.descend_from(turned_, call, w, record);
    }

    // The force of the current contacts becomes the last optimum; also one cut short: balanced and inside the cones.
    void keep(const Record& record) {
        const double* force = record.force();
        for (int j = 0; j < 3 * contacts.count; ++j) held.x[j] = force[j] * contacts.scale[j];
        held.frames = contacts.frames, held.cone_matrix = contacts.cone_matrix;
    }

    Placing place(const Load& load) {
        if (!sane_wrench(load.wrench)) return Placing::refused;
        const Placing placed = contacts.place(load.points, load.normals);
        if (placed == Placing::refused) return placed;
        newton.cones.pack(contacts);
        newton.starter.tangents.load(contacts.frames.data(), contacts.count);
        newton.starter.moved = true;
        return placed;
    }

    // The last optimum in the current frames; false where there is none.
    bool turn_last() {
        newton.cones.load(held.x.data(), newton.x);
        turn_from(held.frames.data());
        return newton.cones.phi(newton.x) < infinity;
    }
    void turn_from(const double* frames) {
        last_.load(frames, contacts.count);
        newton.starter.turn(newton.cones, newton.x, last_, turned_);
    }

    // The offline basis of the current contacts in place of the one that is held; false: none found from there.
    bool renew() {
        auto& starter = newton.starter;
        spare_ = starter.basis;
        for (int k = 0; k < 13; ++k) starter.turn(newton.cones, spare_[k], starter.basis_tangents, starter.basis[k]);
        const bool found = make_basis(newton, true) < ACCEPTED_GAP;
        starter.has_basis = true;
        if (!found) {
            starter.basis = spare_, starter.moved = true;
            return false;
        }
        for (int k = 0; k < 13; ++k) newton.cones.store(starter.basis[k], &held.basis[3 * contacts.count * k]);
        held.basis_frames = contacts.frames;
        starter.basis_tangents = starter.tangents;
        return true;
    }
};

// Contacts that move from call to call; see `PipelineOn`.
class alignas(64) Pipeline {
public:
    static std::unique_ptr<Pipeline> make(const Contacts& nominal, const Stop& options, const double* basis, const double* frames,
                                          bool remembers, const double* reference, const StepRule* flows);
    virtual ~Pipeline() = default;
    virtual Held& held() = 0;
    virtual const Contacts& contacts() const = 0;
    virtual void reset() = 0;
    virtual void forget() = 0;
    virtual void set_basis(const double* basis, const double* frames) = 0;
    virtual Code solve(const Load& load, double* row) = 0;
    virtual Carried carry(const Load& load, double* force) = 0;
    virtual Carried carry_from(const Load& load, const double* then, const double* frames, double* force) = 0;
};

namespace detail {

template <class V, int B> class PipelineAny final : public Pipeline {
public:
    template <class... Arguments> explicit PipelineAny(const Arguments&... arguments) : on_(arguments...) {}
    Held& held() override { return on_.held; }
    const Contacts& contacts() const override { return on_.contacts; }
    void reset() override { on_.reset(); }
    void forget() override { on_.forget(); }
    void set_basis(const double* basis, const double* frames) override { on_.set_basis(basis, frames); }
    Code solve(const Load& load, double* row) override { return on_.solve(load, row); }
    Carried carry(const Load& load, double* force) override { return on_.carry(load, force); }
    Carried carry_from(const Load& load, const double* then, const double* frames, double* force) override {
        return on_.carry_from(load, then, frames, force);
    }

private:
    PipelineOn<V, B> on_;
};

}  // namespace detail

inline std::unique_ptr<Pipeline> Pipeline::make(const Contacts& nominal, const Stop& options, const double* basis,
                                                const double* frames, bool remembers, const double* reference,
                                                const StepRule* flows) {
    return instance<Pipeline, detail::PipelineAny>(nominal.count, nominal, options, basis, frames, remembers, reference, flows);
}

}  // namespace grasp
