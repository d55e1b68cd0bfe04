// Forces of a call: the caller's, or the previous solution.
#pragma once
#include <grasp/optimizer/call_state.hpp>
#include <grasp/optimizer/solvers.hpp>

namespace grasp::detail {

// The functions load a force of the touching contacts, less the preload, into `given` and
// `newton.x`.
template <class V, int B> class GivenForce {
 public:
  GivenForce(Solvers<V, B>& on, const CallState& call)
      : on_(on), call_(call), request_(call.request) {}

  // Load the caller's force (N, 3), without torsion. False: it has another size.
  bool load_force() {
    if (request_.force.size() != std::size_t(3 * on_.current.home.count)) return false;
    for (int i = 0; i < on_.current.now.count; ++i) {
      std::copy_n(&request_.force[3 * on_.current.chosen[i]], 3, &force()[3 * i]);
      torsion()[i] = 0.0;
    }
    load();
    return true;
  }
  // Load the previous solution in its current frames, or the caller's force if there is none.
  bool load_previous() {
    if (!request_.previous) return load_force() && on_.newton.cones.is_in_range(on_.newton.x);
    const Record before(const_cast<double*>(request_.previous));  // only read
    if (before.contacts() != on_.current.home.count || !before.has_force()) return false;
    for (int i = 0; i < on_.current.now.count; ++i) {
      const int of = on_.current.chosen[i];
      const double* f = before.force() + 3 * of;
      const double* from = before.frames() + 9 * of;
      const double* to = &on_.current.now.frames[9 * i];
      double* out = &force()[3 * i];
      torsion()[i] = before.torsion()[of];
      if (std::equal(from, from + 9, to)) {
        std::copy_n(f, 3, out);
        continue;
      }
      // the component lost to the frames' tilt is dropped, so the force stays inside
      out[0] = f[0];
      for (int a = 1; a < 3; ++a) {
        out[a] = 0.0;
        for (int r = 0; r < 3; ++r)
          out[a] += to[3 * r + a] * (from[3 * r + 1] * f[1] + from[3 * r + 2] * f[2]);
      }
    }
    load();
    return on_.newton.cones.is_in_range(on_.newton.x) &&
           std::all_of(torsion().begin(), torsion().end(),
                       [](double v) { return std::abs(v) < infinity; });
  }
  // Load the caller's force and torsion. Return true if they are balanced and strictly inside the
  // cones, as the general program measures it.
  bool load_inside(General& program) {
    const auto& current = on_.current;
    const std::size_t all = current.home.count;
    if (request_.force.size() != 3 * all ||
        (!request_.torsion.empty() && request_.torsion.size() != all))
      return false;
    double most = 0.0;
    for (int i = 0; i < current.now.count; ++i) {
      const double* f = &request_.force[3 * current.chosen[i]];
      std::copy_n(f, 3, &force()[3 * i]);
      torsion()[i] = request_.torsion.empty() ? 0.0 : request_.torsion[current.chosen[i]];
      for (int a = 0; a < 3; ++a) most = std::max(most, std::abs(f[a]));
    }
    load();
    if (!on_.newton.cones.is_in_range(on_.newton.x) || !is_inside()) return false;
    const double missed = program.missed(call_.wrench.data(), force().data(), torsion().data());
    return missed <= General::BALANCE_TOLERANCE * (most + grasp::size(call_.w));
  }

 private:
  Solvers<V, B>& on_;
  const CallState& call_;
  const Request& request_;

  std::vector<double>& force() { return on_.given.force; }
  std::vector<double>& torsion() { return on_.given.torsion; }
  // True if force and torsion are strictly inside the cones.
  bool is_inside() {
    const Contacts& now = on_.current.now;
    for (int i = 0; i < now.count; ++i) {
      Vec<double, 4> x;
      for (int a = 0; a < 3; ++a) x[a] = now.scale[3 * i + a] * force()[3 * i + a];
      x.v = now.torsion_scale(i) * torsion()[i];
      if (!(slack(x) > 0.0) || (torsion()[i] != 0.0 && x.v == 0.0)) return false;
    }
    return true;
  }
  void load() {
    on_.current.preload.subtract_from(force().data(), on_.current.now.count);
    on_.newton.cones.load_point(force().data(), on_.newton.x);
  }
};

}  // namespace grasp::detail
