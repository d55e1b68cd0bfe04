// The front for control programs: contacts, limits and a wrench in, a certified grasp force out.
//
//     grasp::ForceOptimizer solver({.contacts = grasp::Contacts::from(positions, normals, 0.4)}, {.tolerance = 1e-6});
//     const grasp::Record& solution = solver.solve(wrench);
//     if (solution.code() == grasp::CONVERGED) use(solution.force());
//
// Setting up allocates, and throws std::invalid_argument, which says what is wrong. Solving never throws and never allocates: every call
// says how it ended. An object belongs to one thread at a time; several may run at once. Python's `ForceOptimizer` is this class.
#pragma once
#include <grasp/math/dispatch.hpp>
#include <grasp/engine.hpp>
#include <grasp/learned/model_file.hpp>

namespace grasp {

class ForceOptimizer {
public:
    // Throws std::invalid_argument.
    explicit ForceOptimizer(const Problem& problem, const Options& options = {})
        : engine_(make(problem, options)), rows_{std::vector<double>(engine_->size()), std::vector<double>(engine_->size())} {}
    ForceOptimizer(const ForceOptimizer& other)
        : engine_(other.engine_->clone()), rows_{other.rows_[0], other.rows_[1]}, known_(other.known_), record_(now()) {}
    ForceOptimizer(ForceOptimizer&&) = default;

    // The force for a wrench; the record is overwritten by the next call. `now`: what is different in this call alone.
    const Record& solve(Wrench wrench, const Now& now = {}) { return solve(Ask{.wrench = wrench.data(), .now = now}); }
    // The same with a start of its own, or with what studies ask for.
    const Record& solve(const Ask& asked) {
        Ask ask = asked;
        if (known_ && !ask.previous) ask.previous = rows_[0].data();
        engine_->solve(ask, rows_[1].data());
        const Record made(rows_[1].data());
        if (made.has_force()) {  // what has none leaves the previous solution as it is
            std::swap(rows_[0], rows_[1]), known_ = true;
            record_ = this->now();
        } else {
            record_ = made;
        }
        return record_;
    }
    // Into a row of the caller's, of `size()` numbers; what is previous is the caller's too.
    Code solve(const Ask& ask, double* row) { return engine_->solve(ask, row); }
    // The start of a call alone, in place of the force: LIMIT, or why there is none.
    Code start(const Ask& ask, double* row) { return engine_->start(ask, row); }
    // (13, 3N) the offline optima of the problem's contacts in cone coordinates, which the paper's starts combine, from elsewhere: it makes
    // them itself where its options ask for a flow or for such a start.
    void set_basis(Doubles basis) { engine_->set_basis(basis.data()); }
    // Fills these, and takes them; returns the worst relative gap, inf: it did not converge, nan: no force closure. warm: they hold those of nearby contacts.
    double make_basis(std::span<double> basis, bool warm = false) { return engine_->make_basis(basis.data(), warm); }
    // The force (N, 3) [N] and torsion (N,) [N m] deepest inside the cones and limits that balances the wrench, or the twist that proves that
    // none is inside. With wrench zero: force closure.
    Deepest deepest(Wrench wrench, std::span<double> force, std::span<double> torsion) {
        return engine_->deepest(wrench.data(), force.data(), torsion.data());
    }
    // From now on the contacts and limits are these; false, and nothing has changed: numbers that are not possible.
    bool update(const Now& now) { return engine_->update(now); }
    // (M, 6) wrenches into M rows of `size()` numbers, each as `solve` without a previous solution. This allocates.
    void solve_many(Doubles wrenches, std::span<double> rows) const {
        engine_->clone()->solve_many(std::ptrdiff_t(wrenches.size() / 6), wrenches.data(), rows.data());
    }

    // The last solution that holds a force.
    std::optional<Record> previous() { return known_ ? std::optional<Record>(now()) : std::nullopt; }
    // The next call does not know the calls before it.
    void forget() { known_ = false; }

    const Contacts& contacts() const { return engine_->home(); }
    int size() const { return engine_->size(); }

private:
    std::unique_ptr<detail::Engine> engine_;
    std::vector<double> rows_[2];  // the last solution with a force, and room for the next
    bool known_ = false;
    Record record_{rows_[0].data(), 0};

    Record now() { return Record(rows_[0].data()); }
    static std::unique_ptr<detail::Engine> make(const Problem& problem, const Options& options) {
        return instance<detail::Engine, detail::EngineOn>(problem.contacts.count, problem, options);
    }
};

}  // namespace grasp
