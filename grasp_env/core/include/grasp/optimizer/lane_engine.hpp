// The solver behind `ForceOptimizer`, for a number of contacts that fills B registers V; B = 0: any
// number.
#pragma once
#include <grasp/many/problems.hpp>
#include <grasp/math/dispatch.hpp>
#include <grasp/optimizer/algorithms.hpp>
#include <grasp/optimizer/engine.hpp>

namespace grasp::detail {

template <class V, int B> class LaneEngine final : public Engine {
 public:
  LaneEngine(const Problem& problem, const Options& options) : on_(problem, options) {}
  std::unique_ptr<Engine> clone() const override {
    auto copy = std::make_unique<LaneEngine>(*this);
    copy->on_.place_home();  // space for all contacts, and no numbers of this object's last call
    return copy;
  }
  const Contacts& home() const override { return on_.current.home; }
  Margin margin() const override { return on_.current.home_margin(); }
  int size() const override {
    return record_size(home().count, on_.current.joints, on_.current.limits.rows);
  }

  Code solve(const Request& request, double* row) override {
    return answer<&Algorithms<V, B>::solve, &AnswerWriter<V, B>::write>(request, row);
  }
  Code start(const Request& request, double* row) override {
    return answer<&Algorithms<V, B>::start, &AnswerWriter<V, B>::write_start>(request, row);
  }

  void solve_many(std::ptrdiff_t count, const double* wrenches, double* rows) override {
    const Start start = common_start(count);
    const auto solve_one = [&](std::ptrdiff_t k) {
      solve({.wrench = wrenches + 6 * k}, rows + size() * k);
    };
    if (start == Start::standard) {
      for (std::ptrdiff_t k = 0; k < count; ++k) solve_one(k);
      return;
    }
    std::vector<double> space(record_size(home().count) * count);
    const CurrentContacts& current = on_.current;
    std::vector<double> shifted(current.preload.any ? 6 * count : 0);
    for (std::size_t j = 0; j < shifted.size(); j += 6)
      std::ranges::copy(current.preload.added_to(wrenches + j, current.now), &shifted[j]);
    const SolveBatch many{count, shifted.empty() ? wrenches : shifted.data(), space.data()};
    if (start == Start::internal_force)
      newton_many(on_.newton, on_.internal_force(), stop(), many);
    else
      conic_many(on_.conic(), many);
    for (std::ptrdiff_t k = 0; k < count; ++k) {
      const Record record = many.record(k, home().count);
      if (record.code() != CONVERGED) {
        solve_one(k);
        continue;
      }
      const Request request{.wrench = wrenches + 6 * k};
      CallState call = begin(request);
      load_wrench(call);
      call.used.start = start;
      std::copy_n(&record.summary().code, record_size(home().count), on_.answer.row.data());
      AnswerWriter(on_, call).write(CONVERGED, open_row(on_, request, rows + size() * k));
    }
  }

  bool update(const Changes& now) override {
    if (now.contacts != Changes{}.contacts)
      return false;  // a call says which contacts touch, an update cannot
    return on_.replace_home(now);
  }
  Deepest deepest(const double* wrench, double* force, double* torsion) override {
    const bool usable = on_.place({}) == CONVERGED && is_valid_wrench(wrench);
    General* program = usable ? on_.general() : nullptr;
    if (!program) return {};
    const Preload& preload = on_.current.preload;
    const Vec6 load = preload.added_to(wrench, on_.current.now);
    const Deepest deepest = program->deepest(load.data(), 1e-7, force, torsion);
    preload.add_to(force, home().count);
    return deepest;
  }
  Payload payload(const double* direction, const double* wrench, double tolerance, double* force,
                  double* torsion, double* multipliers) override {
    const bool usable = on_.place({}) == CONVERGED && is_valid_wrench(wrench);
    General* program = usable ? on_.general() : nullptr;
    if (!program) return {};
    const Preload& preload = on_.current.preload;
    const Vec6 load = preload.added_to(wrench, on_.current.now);
    const Payload payload = program->payload(direction, load.data(), tolerance, force, torsion);
    preload.add_to(force, home().count);
    std::ranges::copy(program->multipliers(), multipliers);
    return payload;
  }
  std::optional<Vec6> within_reach(const double* wrench, const Changes& now) override {
    if (on_.place(now) != CONVERGED || !is_valid_wrench(wrench) || on_.current.now.reach.full())
      return {};
    return on_.current.now.within_reach(wrench);
  }

  void set_basis(const double* basis) override {
    on_.place({});  // the last call may have used fewer contacts
    on_.starter.set_basis(on_.newton.cones, basis, home().frames.data());
  }
  double make_basis(double* basis, bool warm) override {
    on_.place({});
    if (warm) on_.starter.set_basis(on_.newton.cones, basis);
    const double gap = on_.fill_basis(warm);
    if (gap < infinity)
      for (int k = 0; k < 13; ++k)
        on_.newton.cones.store(on_.starter.basis[k], basis + 3 * home().count * k);
    return gap;
  }

 private:
  Solvers<V, B> on_;

  StopRule stop() const { return {on_.options.gap(), on_.options.limit}; }
  CallState begin(const Request& request) const { return {.request = request, .stop = stop()}; }
  template <auto run, auto write> Code answer(const Request& request, double* row) {
    CallState call = begin(request);
    const Record out = open_row(on_, request, row);
    Code code = place(call);
    if (code == CONVERGED) code = (Algorithms<V, B>(on_, call).*run)();
    return (AnswerWriter<V, B>(on_, call).*write)(code, out);
  }
  // Take over the contacts, limits and wrench of a call. Return CONVERGED if it can be solved.
  Code place(CallState& call) {
    const Code code = on_.place(call.request.now);
    if (code != CONVERGED) return code;
    if (!is_valid_wrench(call.request.wrench)) return REFUSED;
    load_wrench(call);
    const bool shifted = on_.current.preload.any;
    return !shifted || is_valid_wrench(call.wrench.data()) ? CONVERGED : REFUSED;
  }
  // Take over the wrench of a call for the current contacts.
  void load_wrench(CallState& call) const {
    const CurrentContacts& current = on_.current;
    const Contacts& now = current.now;
    call.wrench = current.preload.added_to(call.request.wrench, now);
    call.w = on_.newton.cones.unit.of(call.wrench.data());
    if (on_.options.criterion != Criterion::sum) return;  // the others count preloads themselves
    call.offset = current.preload.cost(now.count, [&](int i) {
      return cost_of_normal_force(on_.options.method, now.omega[i], now.scale[3 * i]);
    });
  }
  // The start of problems solved side by side, in the lanes of registers; Start::standard if they
  // cannot be.
  Start common_start(std::ptrdiff_t count) {
    const bool usable =
        on_.place({}) == CONVERGED && count >= FEW_PROBLEMS && on_.options.start == Start::standard;
    const auto algorithm = algorithm_for(on_.options, on_.placement.kind);
    const bool conic = algorithm == Algorithm::conic;
    if (!usable || !(conic || algorithm == Algorithm::newton) || !on_.has_internal_force())
      return Start::standard;
    return conic ? Start::central : Start::internal_force;
  }
};

template <class V, int B>
std::unique_ptr<Engine> make_lane_engine(const Problem& problem, const Options& options) {
  return std::make_unique<LaneEngine<V, B>>(problem, options);
}
template <int registers>
std::unique_ptr<Engine> make_engine(const Problem& problem, const Options& options) {
  return dispatch(problem.contacts.count,
                  [&]<class V, int B>() { return make_lane_engine<V, B>(problem, options); });
}

}  // namespace grasp::detail
