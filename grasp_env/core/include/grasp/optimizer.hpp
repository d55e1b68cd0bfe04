// The front for control programs: contacts, limits and a wrench go in, a certified grasp force comes out.
//
//     grasp::ForceOptimizer solver({.contacts = grasp::Contacts::from(positions, normals, 0.4)}, {.tolerance = 1e-6});
//     const grasp::Record& solution = solver.solve(wrench);
//     if (solution.code() == grasp::CONVERGED) use(solution.force());
//
// The constructor allocates; it throws std::invalid_argument with a message about the wrong argument. `solve` never throws or
// allocates: the code of its record tells how it ended. Use one object per thread; several objects may run at once. Python's
// `ForceOptimizer` is this class.
#pragma once
#include <grasp/math/dispatch.hpp>
#include <grasp/engine.hpp>
#include <grasp/learned/model_file.hpp>

namespace grasp {

namespace detail {

// A program of many files compiles the solvers once: all of them define GRASP_COMPILED_ENGINE, and one includes grasp/compiled_engine.hpp.
#ifdef GRASP_COMPILED_ENGINE
std::unique_ptr<Engine> make_engine(const Problem& problem, const Options& options);
#else
inline std::unique_ptr<Engine> make_engine(const Problem& problem, const Options& options) {
    return instance<Engine, LaneEngine>(problem.contacts.count, problem, options);
}
#endif

}  // namespace detail

class ForceOptimizer {
public:
    // Throws std::invalid_argument.
    explicit ForceOptimizer(const Problem& problem, const Options& options = {})
        : engine_(make(problem, options)), rows_{std::vector<double>(engine_->size()), std::vector<double>(engine_->size())} {}
    ForceOptimizer(const ForceOptimizer& other)
        : engine_(other.engine_->clone()), rows_{other.rows_[0], other.rows_[1]}, has_previous_(other.has_previous_),
          record_(last_record()) {}
    ForceOptimizer(ForceOptimizer&&) = default;

    // Solve for the force that balances a wrench. The next call overwrites the record. now: what differs in this call only.
    const Record& solve(Wrench wrench, const Changes& now = {}) { return solve(Request{.wrench = wrench.data(), .now = now}); }
    // Solve with a start for this call, or with the options for studies.
    const Record& solve(const Request& request) {
        Request ask = request;
        if (has_previous_ && !ask.previous) ask.previous = rows_[0].data();
        engine_->solve(ask, rows_[1].data());
        const Record made(rows_[1].data());
        if (made.has_force()) {  // without a force, the previous solution stays
            std::swap(rows_[0], rows_[1]), has_previous_ = true;
            record_ = last_record();
        } else {
            record_ = made;
        }
        return record_;
    }
    // Solve into a row of `size()` numbers that the caller owns; the previous solution is the caller's as well.
    Code solve(const Request& ask, double* row) { return engine_->solve(ask, row); }
    // Write only the start of a call, in place of the force. Return LIMIT, or the reason why there is no start.
    Code start(const Request& ask, double* row) { return engine_->start(ask, row); }
    // Set the offline optima that the paper's starts combine, (13, 3N) in cone coordinates, for the problem's contacts. Not needed
    // otherwise: if the options call for a flow or such a start, the constructor computes them.
    void set_basis(Doubles basis) { engine_->set_basis(basis.data()); }
    // Compute the basis into `basis` and use it. Return the worst relative gap; inf: not converged, nan: no force closure. warm:
    // `basis` holds the optima of nearby contacts to start from.
    double make_basis(std::span<double> basis, bool warm = false) { return engine_->make_basis(basis.data(), warm); }
    // Find the force (N, 3) [N] and torsion (N,) [N m] that balances the wrench deepest inside cones and limits, or the twist that
    // proves that no force is inside. With a zero wrench this tests force closure.
    Deepest deepest(Wrench wrench, std::span<double> force, std::span<double> torsion) {
        return engine_->deepest(wrench.data(), force.data(), torsion.data());
    }
    // Replace contacts and limits for all later calls. Return false, with nothing changed, if the numbers are not possible.
    bool update(const Changes& now) { return engine_->update(now); }
    // Solve (M, 6) wrenches into M rows of `size()` numbers, each as `solve` without a previous solution. Allocates.
    void solve_many(Doubles wrenches, std::span<double> rows) const {
        engine_->clone()->solve_many(std::ptrdiff_t(wrenches.size() / 6), wrenches.data(), rows.data());
    }

    // Last solution that holds a force.
    std::optional<Record> previous() { return has_previous_ ? std::optional<Record>(last_record()) : std::nullopt; }
    // Forget the last solution, so that the next call does not start from it.
    void forget() { has_previous_ = false; }

    const Contacts& contacts() const { return engine_->home(); }
    int size() const { return engine_->size(); }

private:
    std::unique_ptr<detail::Engine> engine_;
    std::vector<double> rows_[2];  // last solution with a force, and space for the next
    bool has_previous_ = false;
    Record record_{rows_[0].data(), 0};

    Record last_record() { return Record(rows_[0].data()); }
    static std::unique_ptr<detail::Engine> make(const Problem& problem, const Options& options) {
        return detail::make_engine(problem, options);
    }
};

}  // namespace grasp
