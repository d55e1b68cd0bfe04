// The solvers whatever the number of contacts: what the bindings are made of. C++ programs include optimizer.hpp.
#pragma once
#include <grasp/conic/conic.hpp>
#include <grasp/math/dispatch.hpp>
#include <grasp/many/grasps.hpp>
#include <grasp/learned/learned.hpp>
#include <grasp/terms/limited.hpp>
#include <grasp/hand/pipeline.hpp>
#include <grasp/terms/soft.hpp>

namespace grasp::generic {

// Newton on Phi, and the starts, on the contacts of one grasp. Forces are (3N,) [N], x is (3N,) in cone coordinates [N].
// Aligned as their registers are: who deletes through them need not know.
class alignas(64) Newton {
public:
    const Contacts contacts;
    Stop options;

    static std::unique_ptr<Newton> make(const Contacts& contacts, const Stop& options);
    virtual ~Newton() = default;
    virtual std::unique_ptr<Newton> clone() const = 0;

    virtual Code solve(const Call& call, double* row) = 0;
    // Many wrenches, from the combination or by the tangent correction from previous solutions.
    virtual void solve_many(const Many& many) = 0;
    // (13, 3N) the optima of Phi for +e_1..+e_6, -e_1..-e_6 and for no wrench; returns the worst relative gap, inf: failed.
    // basis: that of nearby contacts, where `warm`; interior: an internal force x strictly inside, or null: it is searched.
    virtual double make_basis(bool warm, const double* interior, double* basis) = 0;
    virtual void set_basis(const double* basis) = 0;
    virtual bool has_basis() const = 0;
    virtual bool internal_force(double* x) = 0;
    // A previous optimum for this wrench; false where a number is not finite.
    virtual bool carry(const double* wrench, const double* previous, From how, double* force) = 0;
    // The force of least Phi on the way from the combination to a candidate, balanced by the least change.
    virtual bool repair(const double* wrench, const double* candidate, double* force) = 0;
    virtual Interval inside(const double* point, const double* ray) = 0;
    // The Newton step at x, its multipliers (given frame); returns the squared decrement, negative: S lost definiteness.
    virtual double newton_step(const double* wrench, const double* x, double* step, double* multipliers) = 0;
    // x = the least Phi on the segment from `safe` to it; returns how far along
    virtual double segment(const double* safe, double* x) = 0;

protected:
    Newton(const Contacts& contacts, const Stop& options) : contacts(contacts), options(options) {}
};

// The paper's gradient flows: all of Newton, but `solve` takes their steps.
class alignas(64) Flow : public Newton {
public:
    // Form::full takes up to FULL_CONTACTS.
    static std::unique_ptr<Flow> make(const Contacts& contacts, const Stop& options, Form form, const StepRule& rule);
    // Makes the step at x (3N,) so many times and returns its last number: for measurements of the product.
    virtual double repeat(const double* x, int times) = 0;

protected:
    using Newton::Newton;
};

// Newton on Phi within limits on each contact's force; see `LimitedOn`.
class alignas(64) LimitedNewton {
public:
    Contacts contacts;  // the current ones

    // basis: (13, 3N) as of `Newton`
    static std::unique_ptr<LimitedNewton> make(const Contacts& contacts, const Stop& options, const LimitRows& rows,
                                               const double* basis, bool elastic);
    virtual ~LimitedNewton() = default;
    virtual std::unique_ptr<LimitedNewton> clone() const = 0;
    // The contacts and their limits are now these, a little away from those of the basis. Allocates nothing where each contact had
    // as many rows before. Unless `good`, nothing may be solved before it is called again.
    virtual Placing move(const double* positions, const double* normals, const LimitRows& rows) = 0;
    virtual Code solve(const Call& call, double* row) = 0;
    virtual void solve_many(const Many& many) = 0;

protected:
    explicit LimitedNewton(const Contacts& contacts) : contacts(contacts) {}
};

// Newton on Phi with soft contacts; see `SoftOn`.
class alignas(64) SoftNewton {
public:
    const Contacts contacts;

    // divisor: (N,) torsion in units of its limit / torsion [1 / m], inf: not soft; basis: (13, 3N) as of `Newton`
    static std::unique_ptr<SoftNewton> make(const Contacts& contacts, const Stop& options, const double* divisor,
                                            const double* basis);
    virtual ~SoftNewton() = default;
    virtual std::unique_ptr<SoftNewton> clone() const = 0;
    virtual Code solve(const Call& call, double* row) = 0;
    virtual void solve_many(const Many& many) = 0;

protected:
    explicit SoftNewton(const Contacts& contacts) : contacts(contacts) {}
};

// The least sum of normal forces on the contacts of one grasp.
class alignas(64) Conic {
public:
    const Contacts contacts;

    // interior: (3N,) an internal force strictly inside the cones, cone coordinates
    static std::unique_ptr<Conic> make(const Contacts& contacts, const Stop& options, const double* interior);
    virtual ~Conic() = default;
    virtual std::unique_ptr<Conic> clone() const = 0;
    virtual Code solve(const double* wrench, double* row) = 0;
    virtual void solve_many(const Many& many) = 0;

protected:
    explicit Conic(const Contacts& contacts) : contacts(contacts) {}
};

// A trained model's starts on the contacts of one grasp, and Newton from them; see `LearnedOn`.
class alignas(64) Learned {
public:
    const Contacts contacts;
    Stop options;

    // basis: (13, 3N) the offline optima; model: one that `fits` the contacts
    static std::unique_ptr<Learned> make(const Contacts& contacts, const Stop& options, const double* basis, const Model& model);
    virtual ~Learned() = default;
    virtual std::unique_ptr<Learned> clone() const = 0;
    virtual Code start(const double* wrench, const double* previous, double* row) = 0;
    virtual Code solve(const double* wrench, const double* previous, double* row) = 0;
    virtual void solve_many(const Many& many) = 0;
    virtual bool predict(const double* wrench, double* force) = 0;
    virtual bool covers(const double* wrench) const = 0;
    virtual bool outside() const = 0;
    virtual bool replaced() const = 0;

protected:
    Learned(const Contacts& contacts, const Stop& options) : contacts(contacts), options(options) {}
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

// One after the other.
template <class Solver> void solve_each(Solver& solver, const Many& many) {
    for (std::ptrdiff_t k = 0; k < many.count; ++k)
        solver.solve(many.call(k, solver.contacts.count), many.rows + record_size(solver.contacts.count) * k);
}

// The descents and their starts; Base: Newton, or what derives from it.
template <class Base, class V, int B> class DescentAny : public Base {
public:
    using Base::contacts, Base::options;

    DescentAny(const Contacts& contacts, const Stop& options) : Base(contacts, options), on_(contacts.count, options) {
        on_.cones.pack(contacts);
    }

    Code solve(const Call& call, double* row) override {
        on_.options = options;
        return on_.solve(call, Record(row, contacts.count));
    }
    void solve_many(const Many& many) override { solve_each(*this, many); }
    double make_basis(bool warm, const double* interior, double* basis) override {
        if (warm) set_basis(basis);
        else if (interior) on_.cones.load(interior, on_.x);
        else if (!on_.internal_force()) return infinity;
        const double gap = grasp::make_basis(on_, warm);
        for (int k = 0; k < 13; ++k) on_.cones.store(on_.starter.basis[k], basis + 3 * contacts.count * k);
        return gap;
    }
    void set_basis(const double* basis) override { on_.starter.set_basis(on_.cones, basis); }
    bool has_basis() const override { return on_.starter.has_basis; }
    bool internal_force(double* x) override {
        const bool found = on_.internal_force();
        on_.cones.store(on_.x, x);
        return found;
    }
    bool carry(const double* wrench, const double* previous, From how, double* force) override {
        const Vec6 w = on_.cones.unit.of(wrench);
        const bool found = sane_wrench(wrench) && on_.begin({.wrench = wrench, .start = how, .force = previous}, w);
        if (found) on_.cones.store_force(on_.x, force);
        return found;
    }
    bool repair(const double* wrench, const double* candidate, double* force) override {
        if (!sane_wrench(wrench) || !has_basis()) return false;
        auto& safe = on_.starter.safe();
        on_.starter.combine(wrench, safe);
        on_.cones.load_force(candidate, on_.x);
        on_.cones.balance(on_.x, on_.cones.unit.of(wrench));
        on_.starter.segment(on_.cones, safe, on_.x);
        on_.cones.store_force(on_.x, force);
        return true;
    }
    Interval inside(const double* point, const double* ray) override {
        on_.cones.load(point, on_.x), on_.cones.load(ray, on_.starter.safe());
        return grasp::inside(on_.cones, on_.x, on_.starter.safe());
    }
    double newton_step(const double* wrench, const double* x, double* step, double* multipliers) override {
        on_.cones.load(x, on_.x);
        Vec6 nu{};
        const double decrement = on_.newton_step(on_.cones.unit.of(wrench), on_.starter.safe(), nu);
        on_.cones.store(on_.starter.safe(), step);
        nu = on_.cones.unit.pull_back(nu);
        std::copy(nu.begin(), nu.end(), multipliers);
        return decrement;
    }
    double segment(const double* safe, double* x) override {
        on_.cones.load(safe, on_.starter.safe()), on_.cones.load(x, on_.x);
        const double along = on_.starter.segment(on_.cones, on_.starter.safe(), on_.x);
        on_.cones.store(on_.x, x);
        return along;
    }

protected:
    NewtonOn<V, B> on_;
};

template <class V, int B> class NewtonAny final : public DescentAny<Newton, V, B> {
public:
    using DescentAny<Newton, V, B>::DescentAny;
    std::unique_ptr<Newton> clone() const override { return std::make_unique<NewtonAny>(*this); }

    void solve_many(const Many& many) override {
        this->on_.options = this->options;
        newton_many(this->on_, many);
    }
};

template <class V, int B> class FlowAny final : public DescentAny<Flow, V, B> {
public:
    FlowAny(const Contacts& contacts, const Stop& options, Form form, const StepRule& rule)
        : DescentAny<Flow, V, B>(contacts, options), flow_(on_.cones, rule, form), placed_(flow_.place(on_.cones)) {}
    std::unique_ptr<Newton> clone() const override { return std::make_unique<FlowAny>(*this); }

    Code solve(const Call& call, double* row) override {
        const Record record(row, this->contacts.count);
        on_.options = this->options;
        record.summary().code = REFUSED;
        if (!placed_ || !sane_wrench(call.wrench)) return REFUSED;
        const Vec6 w = on_.cones.unit.of(call.wrench);
        return on_.begin(call, w) ? flow_.descend(on_, call, w, record) : REFUSED;
    }
    double repeat(const double* x, int times) override {
        on_.cones.load(x, on_.x);
        return flow_.repeat(on_.cones, on_.x, times);
    }

private:
    using DescentAny<Flow, V, B>::on_;
    FlowOn<V, B> flow_;
    bool placed_;
};

template <class V, int B> class LimitedAny final : public LimitedNewton {
public:
    LimitedAny(const Contacts& contacts, const Stop& options, const LimitRows& rows, const double* basis, bool elastic)
        : LimitedNewton(contacts), on_(contacts.count, options) {
        auto& newton = on_.newton;
        newton.cones.pack(contacts);
        newton.rows.pack(newton.cones, rows);
        newton.starter.set_basis(newton.cones, basis, contacts.frames.data());
        on_.elastic = elastic;
    }
    std::unique_ptr<LimitedNewton> clone() const override { return std::make_unique<LimitedAny>(*this); }
    Placing move(const double* positions, const double* normals, const LimitRows& rows) override {
        auto& newton = on_.newton;
        const Placing placed = contacts.place(positions, normals);
        if (placed != Placing::good) return placed;
        newton.cones.pack(contacts);
        newton.rows.pack(newton.cones, rows);
        newton.starter.tangents.load(contacts.frames.data(), contacts.count);
        newton.starter.moved = true;
        return placed;
    }
    Code solve(const Call& call, double* row) override { return on_.solve(call, Record(row, contacts.count)); }
    void solve_many(const Many& many) override { solve_each(*this, many); }

private:
    LimitedOn<V, B> on_;
};

template <class V, int B> class SoftAny final : public SoftNewton {
public:
    SoftAny(const Contacts& contacts, const Stop& options, const double* divisor, const double* basis)
        : SoftNewton(contacts), on_(contacts, options, divisor) {
        on_.newton.starter.set_basis(on_.newton.cones, basis);
    }
    std::unique_ptr<SoftNewton> clone() const override { return std::make_unique<SoftAny>(*this); }
    Code solve(const Call& call, double* row) override { return on_.solve(call, Record(row, contacts.count)); }
    void solve_many(const Many& many) override { solve_each(*this, many); }

private:
    SoftOn<V, B> on_;
};

template <class V, int B> class ConicAny final : public Conic {
public:
    ConicAny(const Contacts& contacts, const Stop& options, const double* interior)
        : Conic(contacts), on_(contacts.count, options) {
        on_.cones.pack(contacts);
        on_.cones.load(interior, on_.rest);
    }
    std::unique_ptr<Conic> clone() const override { return std::make_unique<ConicAny>(*this); }
    Code solve(const double* wrench, double* row) override { return on_.solve(wrench, Record(row, contacts.count)); }
    void solve_many(const Many& many) override { conic_many(on_, many); }

private:
    ConicOn<V, B> on_;
};

template <class V, int B> class LearnedAny final : public Learned {
public:
    LearnedAny(const Contacts& contacts, const Stop& options, const double* basis, const Model& model)
        : Learned(contacts, options), on_(contacts, options, basis, model) {}
    std::unique_ptr<Learned> clone() const override { return std::make_unique<LearnedAny>(*this); }

    Code start(const double* wrench, const double* previous, double* row) override {
        on_.newton.options = options;
        return on_.start(wrench, previous, Record(row, contacts.count));
    }
    Code solve(const double* wrench, const double* previous, double* row) override {
        on_.newton.options = options;
        return on_.solve(wrench, previous, Record(row, contacts.count));
    }
    void solve_many(const Many& many) override {
        on_.newton.options = options;
        const auto begin = [&](std::ptrdiff_t k, const Vec6& w) {
            return on_.begin(many.wrench(k), many.call(k, contacts.count).force, w);
        };
        newton_many(on_.newton, many, begin, [&](std::ptrdiff_t k, const Record& record) {
            on_.solve(many.wrench(k), many.call(k, contacts.count).force, record);
        });
    }
    bool predict(const double* wrench, double* force) override { return on_.predict(wrench, force); }
    bool covers(const double* wrench) const override { return on_.covers(wrench); }
    bool outside() const override { return on_.outside; }
    bool replaced() const override { return on_.replaced; }

private:
    LearnedOn<V, B> on_;
};

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

inline std::unique_ptr<Newton> Newton::make(const Contacts& contacts, const Stop& options) {
    return instance<Newton, detail::NewtonAny>(contacts.count, contacts, options);
}
inline std::unique_ptr<Flow> Flow::make(const Contacts& contacts, const Stop& options, Form form, const StepRule& rule) {
    return instance<Flow, detail::FlowAny>(contacts.count, contacts, options, form, rule);
}
inline std::unique_ptr<LimitedNewton> LimitedNewton::make(const Contacts& contacts, const Stop& options, const LimitRows& rows,
                                                          const double* basis, bool elastic) {
    return instance<LimitedNewton, detail::LimitedAny>(contacts.count, contacts, options, rows, basis, elastic);
}
inline std::unique_ptr<SoftNewton> SoftNewton::make(const Contacts& contacts, const Stop& options, const double* divisor,
                                                    const double* basis) {
    return instance<SoftNewton, detail::SoftAny>(contacts.count, contacts, options, divisor, basis);
}
inline std::unique_ptr<Conic> Conic::make(const Contacts& contacts, const Stop& options, const double* interior) {
    return instance<Conic, detail::ConicAny>(contacts.count, contacts, options, interior);
}
inline std::unique_ptr<Learned> Learned::make(const Contacts& contacts, const Stop& options, const double* basis,
                                              const Model& model) {
    return instance<Learned, detail::LearnedAny>(contacts.count, contacts, options, basis, model);
}
inline std::unique_ptr<Pipeline> Pipeline::make(const Contacts& nominal, const Stop& options, const double* basis,
                                                const double* frames, bool remembers, const double* reference,
                                                const StepRule* flows) {
    return instance<Pipeline, detail::PipelineAny>(nominal.count, nominal, options, basis, frames, remembers, reference, flows);
}

}  // namespace grasp::generic
