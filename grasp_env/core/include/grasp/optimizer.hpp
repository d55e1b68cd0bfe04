// The interface for control programs: certified grasp forces from contacts, limits and a wrench.
//
//     const auto contacts = grasp::Contacts::from(positions, normals, 0.4);
//     grasp::ForceOptimizer solver({.contacts = contacts}, {.tolerance = 1e-6});
//     const grasp::Record& solution = solver.solve(wrench);
//     if (solution.code() == grasp::CONVERGED) use(solution.force());
//
// The constructor allocates; it throws std::invalid_argument with a message about the wrong
// argument. `solve` never throws or allocates: the code of its record tells how it ended. Use one
// object per thread; several objects may run at once. Python's `ForceOptimizer` wraps this class.
#pragma once
#include <grasp/optimizer/engine.hpp>
#include <grasp/learned/model_file.hpp>

#ifndef GRASP_COMPILED  // the target grasp::compiled defines it and holds the solvers; otherwise
                        // each file compiles them
#include <grasp/optimizer/lane_engine.hpp>
#endif

namespace grasp {

class ForceOptimizer {
 public:
  // Throws std::invalid_argument.
  explicit ForceOptimizer(const Problem& problem, const Options& options = {})
      : engine_(make(problem, options)),
        rows_{std::vector<double>(engine_->size()), std::vector<double>(engine_->size())} {}
  ForceOptimizer(const ForceOptimizer& other)
      : engine_(other.engine_->clone()),
        rows_{other.rows_[0], other.rows_[1]},
        has_previous_(other.has_previous_) {
    for (auto& row : rows_) row.reserve(size());  // a copied vector has no more room than it needs
    record_ = last_record();
  }
  ForceOptimizer(ForceOptimizer&&) = default;

  // Solve for the force that balances a wrench. The next call overwrites the record. now: changes
  // for this call only.
  const Record& solve(Wrench wrench, const Changes& now = {}) {
    return solve(Request{.wrench = wrench.data(), .now = now});
  }
  // The same with a start, a known optimum or a trace. Without `previous` it uses the last
  // solution.
  const Record& solve(Request request) {
    use_previous(request);
    engine_->solve(request, rows_[1].data());
    const Record record(rows_[1].data());
    if (record.has_force()) {  // without a force, the previous solution stays
      std::swap(rows_[0], rows_[1]);
      rows_[1].resize(size());  // after `remember`; there is room
      has_previous_ = true;
      record_ = last_record();
    } else {
      record_ = record;
    }
    return record_;
  }
  // Solve into a caller-owned row of `size()` numbers. This overload neither uses nor updates the
  // stored last solution; to warm-start, set `previous` of the request.
  Code solve(const Request& request, double* row) { return engine_->solve(request, row); }
  // Compute only the start of a call and write it where the force would go. Return STARTED; any
  // other code says why there is no start.
  Code start(Request request, double* row) {
    use_previous(request);
    return engine_->start(request, row);
  }
  // Replace the offline basis of the problem's contacts, (13, 3N) in cone coordinates: the optimal
  // forces for +1 along each of the six wrench axes, for -1 along each, and for zero wrench. Call
  // this to reuse a stored basis, or if only a request asks for a start that needs one; if the
  // options need the basis, the constructor computes it.
  void set_basis(Doubles basis) { engine_->set_basis(basis.data()); }
  // Compute the basis, store it in `basis` and use it. Return the largest relative gap: infinity if
  // the solver did not converge, NaN without force closure. warm: `basis` on entry holds the optima
  // of nearby contacts.
  double make_basis(std::span<double> basis, bool warm = false) {
    return engine_->make_basis(basis.data(), warm);
  }
  // Find the balanced force (N, 3) [N] and torsion (N,) [N m] with the largest margin to cones and
  // limits, or a twist that proves that no force is inside them. With a zero wrench this tests
  // force closure.
  Deepest deepest(Wrench wrench, std::span<double> force, std::span<double> torsion) {
    return engine_->deepest(wrench.data(), force.data(), torsion.data());
  }
  // Find the largest load k along a direction, in addition to a wrench, that forces hold within
  // cones, margin and limits: `wrench + k direction`. Writes the force (N, 3) [N] and torsion (N,)
  // [N m] that hold it, and the multipliers (M,) of the limits, of the bound or the proof.
  Payload payload(Wrench direction, Wrench wrench, std::span<double> force,
                  std::span<double> torsion, std::span<double> multipliers,
                  double tolerance = 1e-6) {
    return engine_->payload(direction.data(), wrench.data(), tolerance, force.data(),
                            torsion.data(), multipliers.data());
  }
  // The wrench without its part that no forces of the touching contacts make, whatever their signs;
  // nothing if it has no such part or if no contact touches. Two hard contacts, for example, make
  // no moment about the line through them.
  std::optional<Vec6> within_reach(Wrench wrench, const Changes& now = {}) {
    return engine_->within_reach(wrench.data(), now);
  }
  // Replace contacts and limits for all later calls. Return false, with nothing changed, if the
  // values are invalid: of wrong size, not finite, or normals not of unit length. Contacts that
  // cannot balance wrenches of every direction are accepted.
  bool update(const Changes& now) { return engine_->update(now); }
  // Solve (M, 6) wrenches into M rows of `size()` numbers, each as `solve` without a previous
  // solution. Allocates.
  void solve_many(Doubles wrenches, std::span<double> rows) {
    engine_->solve_many(std::ptrdiff_t(wrenches.size() / 6), wrenches.data(), rows.data());
  }

  // Return the last solution that holds a force.
  std::optional<Record> previous() {
    return has_previous_ ? std::optional<Record>(last_record()) : std::nullopt;
  }
  // Take a solution of another optimizer as the last one. Return false, with nothing changed, if it
  // has no force or another number of contacts. Allocates.
  bool remember(const Record& solution) {
    if (!solution.has_force() || solution.contacts() != contacts().count) return false;
    const double* row = &solution.summary().code;
    if (row != rows_[0].data()) rows_[0].assign(row, row + solution.size());
    has_previous_ = true;
    record_ = last_record();
    return true;
  }
  // Forget the last solution, so that the next call does not start from it.
  void forget() { has_previous_ = false; }

  const Contacts& contacts() const { return engine_->home(); }
  Margin margin() const { return engine_->margin(); }  // valid until the next update
  int size() const { return engine_->size(); }

 private:
  std::unique_ptr<detail::Engine> engine_;
  std::vector<double> rows_[2];  // last solution with a force, and space for the next
  bool has_previous_ = false;
  Record record_{rows_[0].data(), 0};

  void use_previous(Request& request) const {
    if (has_previous_ && !request.previous) request.previous = rows_[0].data();
  }
  Record last_record() { return Record(rows_[0].data()); }
  static std::unique_ptr<detail::Engine> make(const Problem& problem, const Options& options) {
    return detail::make_engine<REGISTER>(problem, options);
  }
};

}  // namespace grasp
