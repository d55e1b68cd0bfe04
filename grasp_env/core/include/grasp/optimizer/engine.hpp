// The interface of the solver behind `ForceOptimizer`; `lane_engine.hpp` implements it.
#pragma once
#include <optional>
#include <grasp/general/payload.hpp>
#include <grasp/problem.hpp>
#include <grasp/record.hpp>

namespace grasp::detail {

class alignas(64) Engine {
 public:
  virtual ~Engine() = default;
  virtual std::unique_ptr<Engine> clone() const = 0;
  virtual Code solve(const Request& request, double* row) = 0;
  virtual Code start(const Request& request, double* row) = 0;
  virtual void solve_many(std::ptrdiff_t count, const double* wrenches, double* rows) = 0;
  virtual bool update(const Changes& now) = 0;
  virtual Deepest deepest(const double* wrench, double* force, double* torsion) = 0;
  virtual Payload payload(const double* direction, const double* wrench, double tolerance,
                          double* force, double* torsion, double* multipliers) = 0;
  virtual std::optional<Vec6> within_reach(const double* wrench, const Changes& now) = 0;
  // Set the offline optima of the problem's contacts, (13, 3N) in cone coordinates.
  virtual void set_basis(const double* basis) = 0;
  virtual double make_basis(double* basis, bool warm) = 0;
  virtual const Contacts& home() const = 0;
  virtual Margin margin() const = 0;
  virtual int size() const = 0;  // numbers in a row
};

// Construct the solver of a problem. registers: REGISTER of the caller; files with other registers
// do not link.
template <int registers>
std::unique_ptr<Engine> make_engine(const Problem& problem, const Options& options);

}  // namespace grasp::detail
