// Initial forces: balanced, strictly inside the cones, and never worse in Phi than the paper's
// combination.
#pragma once
#include <grasp/phi/system.hpp>

namespace grasp {

// If Phi grows by this factor when the combination moves to new contacts, the basis is outdated.
inline constexpr double MAX_GROWTH = 2.0;

enum class From {
  combination,  // of the 12 offline optima (the paper, Sec. III)
  given,        // a force, used unchanged
  tangent,  // a previous optimum, balanced by the smallest change in the metric of the Hessian of
            // Phi; exact to first order
};

// sum E_k f_k + max(0, 1 - sum E_k) f_rest, E_k = max(0, +-w_k) (Eqs. 33, 34): indices and weights
// of the 13 offline optima (+e_1..+e_6, -e_1..-e_6, rest). printed: without f_rest, which avoids P
// = 0 at small wrenches.
struct Combination {
  int rows[7];
  double weights[7];

  Combination(const double* wrench, bool printed) {
    double total = 0.0;
    for (int k = 0; k < 6; ++k) {
      weights[k] = std::abs(wrench[k]);
      total += weights[k];
      rows[k] = wrench[k] > 0.0 ? k : k + 6;
    }
    rows[6] = 12;
    weights[6] = printed ? 0.0 : std::max(0.0, 1.0 - total);
  }
};

// Tangent vectors of the contact frames in which a force is written.
template <class V, int B> struct Tangents {
  using Field = typename Cones<V, B>::Field;
  Field o, t;

  explicit Tangents(const Cones<V, B>& cones) : o(cones.field()), t(cones.field()) {}
  // frames: (N, 3, 3) columns (n, o, t)
  void load(const double* frames, int count) {
    for (int i = 0; i < count; ++i)
      for (int r = 0; r < 3; ++r) {
        set(o[i / width<V>][r], i % width<V>, frames[9 * i + 3 * r + 1]);
        set(t[i / width<V>][r], i % width<V>, frames[9 * i + 3 * r + 2]);
      }
  }
};

template <class V, int B> class Starter {
 public:
  using Field = typename Cones<V, B>::Field;
  // argmin Phi for +e_1..+e_6, -e_1..-e_6 and the zero wrench, cone coordinates
  std::array<Field, 13> basis;
  Tangents<V, B> basis_tangents, tangents;  // tangents of the basis, and the current ones
  bool has_basis = false;

  explicit Starter(const Cones<V, B>& cones)
      : basis_tangents(cones),
        tangents(cones),
        there_(cones.field()),
        safe_(cones.field()),
        step_(cones.field()) {
    for (auto& row : basis) row = cones.field();
  }

  // rows: (13, 3N) cone coordinates. frames: (N, 3, 3) contact frames of the basis, needed if the
  // contacts may move.
  void set_basis(const Cones<V, B>& cones, const double* rows, const double* frames = nullptr) {
    for (int k = 0; k < 13; ++k) cones.load(rows + 3 * cones.count * k, basis[k]);
    if (frames) basis_tangents.load(frames, cones.count);
    has_basis = true;
  }

  void combine(const double* wrench, Field& out, bool printed = false) const {
    const Combination terms(wrench, printed);
    for (int b = 0; b < int(out.size()); ++b) {
      Vec3<V> x = all<V>(terms.weights[6]) * basis[12][b];
      for (int k = 0; k < 6; ++k) x += all<V>(terms.weights[k]) * basis[terms.rows[k]][b];
      out[b] = x;
    }
  }

  // The combination on contacts that have moved since the basis was computed; w is the wrench in
  // their unit frame. Return false if it lies outside the cones or its Phi is too large.
  bool moved_combination(const Cones<V, B>& cones, System<V, B>& system, const double* wrench,
                         const Vec6& w, Field& out) {
    combine(wrench, there_);
    turn(cones, there_, basis_tangents, out);
    if (!tangent(cones, system, w, out)) return false;
    const double value = cones.phi(out);
    return value < infinity && value <= MAX_GROWTH * cones.phi(there_);
  }

  // Set x to the force of least Phi on the segment from `safe` (strictly inside) to x. Return the
  // fraction of the way. Phi is convex there: bisection drives its slope to zero, to a thousandth.
  // Never worse than either end.
  double segment(const Cones<V, B>& cones, const Field& safe, Field& x) {
    if (!cones.is_in_range(x)) {
      x = safe;
      return 0.0;
    }
    for (int b = 0; b < int(x.size()); ++b) step_[b] = x[b] - safe[b];
    const double value_safe = cones.phi(safe);
    const double value_x = cones.phi(x);
    double low = 0.0, high = 1.0, best = 0.0, best_value = value_safe;
    if (value_x == infinity) {
      const double reach = cones.reach(safe, step_);
      high = reach > 0.0 ? std::min(1.0, 0.999 / reach) : 1.0;
    } else if (value_x < best_value) {
      best = 1.0;
      best_value = value_x;
    }
    double theta = high;
    for (int round = 0; round < 40; ++round) {
      const double value = cones.phi_along(safe, step_, theta);
      if (value < best_value) {
        best = theta;
        best_value = value;
      }
      if (value == infinity) {
        high = theta;
      } else if (cones.slope_along(safe, step_, theta) <= 0.0) {
        if (theta == 1.0) break;
        low = theta;
      } else {
        high = theta;
      }
      if (high - low < 1e-3 * high) break;
      theta = 0.5 * (low + high);
    }
    if (best != 1.0)
      for (int b = 0; b < int(x.size()); ++b) x[b] = safe[b] + all<V>(best) * step_[b];
    return best;
  }

  // x += the tangent correction to G x + w = 0; the least-norm change then removes the rounding
  // error of balance.
  bool tangent(const Cones<V, B>& cones, System<V, B>& system, const Vec6& w, Field& x) {
    if (!system.assemble(cones, x)) return false;
    cones.subtract(x, system.restore(cones, {}, system.applied + w, x) + w);
    return true;
  }

  // out = x with its tangential parts turned from the tangents `from` to the current ones. The
  // component lost to the frames' tilt is dropped, so out is inside the round cones if x is.
  void turn(const Cones<V, B>& cones, const Field& x, const Tangents<V, B>& from,
            Field& out) const {
    for (int b = 0; b < int(out.size()); ++b) {
      const auto& c = cones.blocks[b];
      const Vec3<V> along = (x[b].o / c.divisor.o) * from.o[b] + (x[b].t / c.divisor.t) * from.t[b];
      out[b] = {x[b].u, dot(tangents.o[b], along) * c.scale.o,
                dot(tangents.t[b], along) * c.scale.t};
    }
  }

  Field& safe() { return safe_; }

 private:
  Field there_, safe_, step_;
};

}  // namespace grasp
