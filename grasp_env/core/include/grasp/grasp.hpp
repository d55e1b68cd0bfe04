// The front for control programs: contacts in, certified grasp forces out, with the words, units and results of the Python package.
//
//     const auto contacts = grasp::Contacts::from(positions, normals, 0.4);
//     grasp::Newton newton(contacts, {.tolerance = 1e-6});
//     const grasp::Record solution = newton.solve(wrench);
//     if (solution.code() == grasp::CONVERGED) use(solution.force());
//
// To set up allocates, takes some 0.1 ms, and throws std::invalid_argument, which says what is wrong. Calls that solve never throw
// and never allocate: they say how they ended. An object belongs to one thread at a time; several may run at once. README.md in
// grasp_env/core tells the rest.
#pragma once
#include "force_limits.hpp"
#include "model_file.hpp"
#include "solvers.hpp"

namespace grasp {

inline constexpr int CONIC_ITERATIONS = 100;  // far more than it ever takes

using Wrench = std::span<const double, 6>;  // external, on the object: force [N], moment [N m], object frame
using Triples = std::span<const double>;  // (N, 3) contact by contact

// The offline part, (13, 3N): the optima of Phi for the 12 unit wrenches and for none, cone coordinates. Throws without force closure.
inline std::vector<double> offline_basis(const Contacts& contacts) {
    std::vector<double> basis(39 * contacts.count);
    if (!(generic::Newton::make(contacts, {1.0, 0})->make_basis(false, nullptr, basis.data()) < ACCEPTED_GAP))
        throw std::invalid_argument("the contacts have no force closure: no forces within friction balance every wrench");
    return basis;
}

// What every solver here has: the solution of the last call, and the forces of the last one that had any.
class Solutions {
public:
    // (3N,) [N] of the last call that balanced its wrench within the friction cones; zeros: none yet.
    Triples last() const { return {last_.data(), std::size_t(3 * count_)}; }
    // The next call does not know the calls before it.
    void forget() { known_ = false; }

protected:
    explicit Solutions(int count) : count_(count), row_(record_size(count)), last_(4 * count) {}

    // run(row) -> Code into the record, which is overwritten by the next call
    template <class F> Record ended(F&& run) {
        const Record record(row_.data(), count_);
        record.summary().margin = 0.0;
        const Code code = run(row_.data());
        record.summary().code = code;
        if (code != REFUSED && code != INFEASIBLE) {
            std::copy_n(record.force(), 3 * count_, last_.data());
            std::copy_n(record.torsion(), count_, last_.data() + 3 * count_);
            known_ = true;
        }
        return record;
    }
    Call previous(Wrench wrench) const {
        if (!known_) return {.wrench = wrench.data()};
        return {.wrench = wrench.data(), .start = From::tangent, .force = last_.data(), .torsion = last_.data() + 3 * count_};
    }
    bool known() const { return known_; }
    bool is_triples(Triples given) const { return given.size() == std::size_t(3 * count_); }

private:
    int count_;
    std::vector<double> row_, last_;
    bool known_ = false;
};

// Newton on Phi: forces of least cost that keep their distance to the friction cones.
class Newton : public Solutions {
public:
    explicit Newton(const Contacts& contacts, const Stop& options = {})
        : Solutions(contacts.count), on_(generic::Newton::make(contacts, options)) {
        on_->set_basis(offline_basis(contacts).data());
    }
    // From the combination of the 12 offline optima.
    Record solve(Wrench wrench) {
        return ended([&](double* row) { return on_->solve({.wrench = wrench.data()}, row); });
    }
    // From the last solution, where that is better: what a control loop calls.
    Record follow(Wrench wrench) {
        return ended([&](double* row) { return on_->solve(previous(wrench), row); });
    }
    // From a force (3N,) [N] that is balanced and strictly inside the cones.
    Record from(Wrench wrench, Triples force) {
        return ended([&](double* row) {
            if (!is_triples(force)) return REFUSED;
            return on_->solve({.wrench = wrench.data(), .start = From::given, .force = force.data()}, row);
        });
    }
    const Contacts& contacts() const { return on_->contacts; }

private:
    std::unique_ptr<generic::Newton> on_;
};

// The least sum of normal forces, exactly on the cones where that is least.
class Conic : public Solutions {
public:
    explicit Conic(const Contacts& contacts, const Stop& options = {1e-6, CONIC_ITERATIONS})
        : Solutions(contacts.count), on_(generic::Conic::make(contacts, options, interior(contacts).data())) {}
    Record solve(Wrench wrench) {
        return ended([&](double* row) { return on_->solve(wrench.data(), row); });
    }
    const Contacts& contacts() const { return on_->contacts; }

private:
    std::unique_ptr<generic::Conic> on_;

    static std::vector<double> interior(const Contacts& contacts) {
        std::vector<double> x(3 * contacts.count);
        if (!generic::Newton::make(contacts, {1.0, 0})->internal_force(x.data()))
            throw std::invalid_argument("the contacts have no force closure: no forces within friction balance every wrench");
        return x;
    }
};

// What to do with limits that no force keeps: say so, with a proof; or exceed them least.
enum class Limits { strict, elastic };

// Newton within limits on normal forces and joint torques, of fingers with joints of their own.
class LimitedNewton : public Solutions {
public:
    LimitedNewton(const Contacts& contacts, const ForceLimits& limits, Limits kind = Limits::elastic, const Stop& options = {})
        : Solutions(contacts.count), on_(made(contacts, limits, kind, options, table_)) {}
    Record solve(Wrench wrench) { return run({.wrench = wrench.data()}); }
    // From the last solution.
    Record follow(Wrench wrench) { return run(previous(wrench)); }
    // Contacts and limits are now these, a little away from those it was made for: as many contacts, joints and limits as there.
    // False: they are not, or not finite; then `solve` refuses until they are.
    bool move(Triples positions, Triples normals, const ForceLimits& limits) {
        ready_ = is_triples(positions) && is_triples(normals) && !wrong(on_->contacts.count, limits) &&
                 table_.fill(on_->contacts, limits) &&
                 on_->move(positions.data(), normals.data(), table_.rows()) == Placing::good;
        return ready_;
    }
    const Contacts& contacts() const { return on_->contacts; }

private:
    LimitTable table_;
    std::unique_ptr<generic::LimitedNewton> on_;
    bool ready_ = true;

    Record run(const Call& call) {
        return ended([&](double* row) {
            const Code code = ready_ ? on_->solve(call, row) : REFUSED;
            return code == REFUSED && serves(call.wrench, Record(row, contacts().count)) ? STALLED : code;
        });
    }

    // Where hardly any force keeps the limits, or hardly none: whether what was found is balanced and inside the cones all the same.
    bool serves(const double* wrench, const Record& record) const {
        constexpr double MISSED = 1e-8;  // part of wrench and forces
        const Summary& s = record.summary();
        if (!(s.margin > 0.0 && s.margin < infinity)) return false;
        double most = size(contacts().unit.of(wrench));
        for (int j = 0; j < 3 * contacts().count; ++j) most += std::abs(record.force()[j]);
        return s.residual <= MISSED * most;
    }
    // What is wrong with the sizes of limits.
    static const char* wrong(int count, const ForceLimits& limits) {
        const std::size_t size = std::size_t(count), joints = limits.torque_limit.size();
        for (const auto& each : {limits.min_normal, limits.max_normal})
            if (!each.empty() && each.size() != size) return "limits of normal forces must be one of each contact, or none";
        if (limits.jacobian.size() != 3 * size * joints) return "the jacobian must be (N, 3, J) and torque_limit (J,)";
        if (!limits.torque_bias.empty() && limits.torque_bias.size() != joints) return "torque_bias must be (J,), or none";
        return nullptr;
    }
    static std::unique_ptr<generic::LimitedNewton> made(const Contacts& contacts, const ForceLimits& limits, Limits kind,
                                                        const Stop& options, LimitTable& table) {
        if (const char* said = wrong(contacts.count, limits)) throw std::invalid_argument(said);
        if (!table.fill(contacts, limits))
            throw std::invalid_argument(
                "limits must be finite, and no joint may move two contacts: those are for the Python package");
        return generic::LimitedNewton::make(contacts, options, table.rows(), offline_basis(contacts).data(),
                                            kind == Limits::elastic);
    }
};

// Newton from what a trained model predicts; never worse in Phi than the combination. Model: `ModelFile::load`.
class Learned : public Solutions {
public:
    Learned(const Contacts& contacts, const Model& model, const Stop& options = {}) : Solutions(contacts.count) {
        if (!model.fits(contacts.count)) throw std::invalid_argument("the model is for another number of contacts");
        on_ = generic::Learned::make(contacts, options, offline_basis(contacts).data(), model);
    }
    Record solve(Wrench wrench) {
        return ended([&](double* row) { return on_->solve(wrench.data(), nullptr, row); });
    }
    // From the last solution, where that is better.
    Record follow(Wrench wrench) {
        return ended([&](double* row) { return on_->solve(wrench.data(), known() ? last().data() : nullptr, row); });
    }
    // Whether the last wrench was one that training did not cover: the start is safe there, too, but perhaps no good.
    bool outside() const { return on_->outside(); }
    // Whether nothing of the last prediction was kept: the start was the combination.
    bool replaced() const { return on_->replaced(); }
    const Contacts& contacts() const { return on_->contacts; }

private:
    std::unique_ptr<generic::Learned> on_;
};

// Newton for contacts that move a little from call to call, from the last optimum carried along; their number and friction stay.
class Pipeline : public Solutions {
public:
    explicit Pipeline(const Contacts& nominal, const Stop& options = {})
        : Solutions(nominal.count),
          on_(generic::Pipeline::make(nominal, options, offline_basis(nominal).data(), nominal.frames.data(), true,
                                      std::vector<double>(9 * nominal.count * nominal.count).data(), nullptr)) {}
    Record solve(Triples positions, Triples normals, Wrench wrench) {
        return ended([&](double* row) {
            if (!is_triples(positions) || !is_triples(normals)) return REFUSED;
            return on_->solve({positions.data(), normals.data(), wrench.data()}, row);
        });
    }
    // As new: also the offline basis is that of the nominal contacts again.
    void reset() { on_->reset(), Solutions::forget(); }
    void forget() { on_->forget(), Solutions::forget(); }
    // Those of the last call, whose frames (n, o, t) forces are written in.
    const Contacts& contacts() const { return on_->contacts(); }

private:
    std::unique_ptr<generic::Pipeline> on_;
};

}  // namespace grasp
