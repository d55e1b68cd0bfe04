// Soft contacts: torsions as variables of Phi, eliminated contact by contact.
//
// v is the torsion in units of its limit, abs(v) <= u; with p = u - v and q = u + v, Phi gains
// lambda (1/p + 1/q). For any step du the best dv is k du + delta. So a contact keeps its 3 x 3
// block: e_u gains curvature and slope, its column of G gains k times that of v, and delta adds a
// rank-one term to S. In p and q nothing cancels.
#pragma once
#include <grasp/phi/cones.hpp>
#include <grasp/phi/rows.hpp>

namespace grasp {

template <class V, int B> class SoftTerms {
 public:
  static constexpr bool has_terms = true, has_torsion = true;
  static constexpr int W = width<V>;
  using Field = typename Cones<V, B>::Field;

  explicit SoftTerms(int count = 0) {
    const int blocks = (count + W - 1) / W;
    resize(contacts_, blocks);
    resize(states_, blocks);
  }

  // divisor: (N,) v = divisor * torsion [N / N m]; inf: no torsion is transmitted
  void pack(const Cones<V, B>& cones, const Contacts& c, const double* divisor) {
    for (int b = 0; b < int(contacts_.size()); ++b) {
      contacts_[b] = Contact{};
      states_[b] = State{};
      for (int r = 0; r < 6; ++r) {
        states_[b].columns[r] = cones.blocks[b].g[r];
        contacts_[b].hard[r] = cones.blocks[b].g[r].u;
      }
    }
    for (int i = 0; i < c.count; ++i) {
      if (!(divisor[i] > 0.0 && divisor[i] < infinity)) continue;
      auto& contact = contacts_[i / W];
      const int n = i % W;
      const double axis[6] = {
          0.0, 0.0, 0.0, c.frames[9 * i], c.frames[9 * i + 3], c.frames[9 * i + 6]};
      const Vec6 wrench = c.unit.of(axis);
      for (int r = 0; r < 6; ++r) set(contact.g[r], n, wrench[r] / divisor[i]);
      set(contact.lambda, n, c.lambda[i]);
      set(contact.flat, n, 0.25 / c.lambda[i]);
      set(contact.divisor, n, divisor[i]);
    }
    for (int b = 0; b < int(contacts_.size()); ++b)
      contacts_[b].root = sqrt(2.0 * contacts_[b].lambda);
  }

  // (N,) torsions [N m], null: zero; and back
  void load(const Cones<V, B>& cones, const double* torsion) {
    for (auto& now : states_) now.v = now.step = V{};
    for (int i = 0; torsion && i < cones.count; ++i) {
      const double per = get(contacts_[i / W].divisor, i % W);
      if (per > 0.0) set(states_[i / W].v, i % W, per * torsion[i]);
    }
  }
  void store(const Cones<V, B>& cones, double* torsion) const {
    for (int i = 0; i < cones.count; ++i) {
      const double per = get(contacts_[i / W].divisor, i % W);
      torsion[i] = per > 0.0 ? get(states_[i / W].v, i % W) / per : 0.0;
    }
  }

  // --- as terms of Phi, block by block

  // Terms at x and at the torsion after alpha steps; +inf unless inside.
  V value(int b, const Vec3<V>& x, double alpha) const {
    const V v = states_[b].v + all<V>(alpha) * states_[b].step;
    const V p = x.u - v;
    const V q = x.u + v;
    return min(p, q) > 0.0 ? contacts_[b].lambda * (p + q) / (p * q) : all<V>(infinity);
  }
  // Add to the gradient and inverse Hessian at x, with v eliminated.
  void add_to_gradient_and_hessian(int b, const Vec3<V>& x, Vec3<V>& gradient, Sym3<V>& inverse) {
    const Contact& c = contacts_[b];
    State& n = states_[b];
    const V u2 = x.u * x.u;
    const V v2 = n.v * n.v;
    const V p = x.u - n.v;
    const V q = x.u + n.v;
    const V d = p * q;
    // m = 1 / (u^2 + 3 v^2), per = 1 / (p q)
    const V i = 1.0 / (x.u * (u2 + 3.0 * v2) * d);
    const V m = i * x.u * d;
    const V per = i * x.u * (u2 + 3.0 * v2);
    n.lever = n.v * (3.0 * u2 + v2) * i * d;
    n.free = c.flat * d * d * d * i * d;
    n.pull = d * n.v * m;
    n.slope = 4.0 * c.lambda * x.u * n.v * per * per;
    n.p = per * q;
    n.q = per * p;  // 1 / p and 1 / q
    gradient.u -= 2.0 * c.lambda * m;
    const V bend = 4.0 * c.lambda * i * d;
    const Vec3<V> h{inverse.uu, inverse.uo, inverse.ut};
    const Vec3<V> f = (bend / (1.0 + bend * h.u)) * h;
    inverse.uu -= f.u * h.u;
    inverse.uo -= f.u * h.o;
    inverse.ut -= f.u * h.t;
    inverse.oo -= f.o * h.o;
    inverse.ot -= f.o * h.t;
    inverse.tt -= f.t * h.t;
#pragma GCC unroll 8
    for (int r = 0; r < 6; ++r) n.columns[r].u = c.hard[r] + n.lever * c.g[r];
  }

  // --- for `System`

  const Vec3<V>* columns(int b) const { return states_[b].columns; }
  // add to S, G H^-1 grad and G x
  void add(int b, V (&s)[21], V (&q)[6], V (&l)[6]) const {
    const Contact& c = contacts_[b];
#pragma GCC unroll 8
    for (int r = 0; r < 6; ++r) {
      q[r] += states_[b].pull * c.g[r];
      l[r] += states_[b].v * c.g[r];
      const V scaled = states_[b].free * c.g[r];
#pragma GCC unroll 8
      for (int k = 0; k <= r; ++k) s[packed(r, k)] += scaled * c.g[k];
    }
  }
  // The torsion's part of the step with multipliers nu.
  void turn(int b, const Vec6& nu, const V& du, V (&moved)[6]) {
    states_[b].step = states_[b].free * along(b, nu) - states_[b].pull + states_[b].lever * du;
    push(b, moved);
  }
  // Subtract what `System::restore` takes off the torsion's step.
  void restore(int b, const Vec6& n, const V& du, V (&moved)[6]) {
    states_[b].step -= states_[b].free * along(b, n) + states_[b].lever * du;
    push(b, moved);
  }

  // --- the step

  // d Phi beyond the gradient of the force
  V slope(int b, const Vec3<V>& step) const {
    return states_[b].slope * (states_[b].step - states_[b].lever * step.u);
  }
  // 1 / (largest step inside)
  V reach(int b, const Vec3<V>& step) const {
    const State& n = states_[b];
    return max((n.step - step.u) * n.p, -(n.step + step.u) * n.q);
  }
  // The multiplier of u after the step, in Newton's model: -d (lambda/p + lambda/q) / du.
  void predict_multipliers(int b, const Vec3<V>& step) {
    State& n = states_[b];
    const V dp = (step.u - n.step) * n.p;
    const V dq = (step.u + n.step) * n.q;
    n.multiplier = contacts_[b].lambda * (max(V{}, n.p * n.p * (1.0 - 2.0 * dp)) +
                                          max(V{}, n.q * n.q * (1.0 - 2.0 * dq)));
  }
  void move(double alpha) {
    for (auto& now : states_) now.v += all<V>(alpha) * now.step;
  }

  // Subtract the torsion from y = G^T nu. Return its part of the dual value, the minimum of
  // lambda/p + lambda/q + multiplier u - y_v v over p and q. Any multiplier >= abs(y_v) gives a
  // bound, that of the optimum the largest.
  V dual(int b, const Vec6& nu, Vec3<V>& y) const {
    const V turn = along(b, nu);
    const V multiplier = max(states_[b].multiplier, abs(turn));
    y.u += multiplier;
    return contacts_[b].root * (sqrt(multiplier + turn) + sqrt(multiplier - turn));
  }

  Vec6 wrench(const Cones<V, B>& cones) const {
    V out[6] = {};
    for (int b = 0; b < int(cones.blocks.size()); ++b)
      for (int r = 0; r < 6; ++r) out[r] += states_[b].v * contacts_[b].g[r];
    return sums(out);
  }
  bool within(const Field&) const { return true; }
  Verdict judge(const Cones<V, B>&, const Vec6&, const Vec6&, double, int) const {
    return Verdict::proceed;
  }

 private:
  // hard: the column of u. g (the column of v), lambda, flat = 1 / (4 lambda) and root = sqrt(2
  // lambda) are zero for contacts that are not soft.
  struct Contact {
    V hard[6], g[6], lambda, flat, root, divisor;
  };
  struct State {
    V v, step;
    // k, 1 / psi_vv, psi_v / psi_vv, psi_v, with psi the terms of torsion
    V lever, free, pull, slope;
    V p, q;  // 1 / (u - v), 1 / (u + v)
    V multiplier;
    Vec3<V> columns[6];  // G of the force together with the torsion that follows it
  };
  Blocks<Contact, B> contacts_{};
  Blocks<State, B> states_{};

  [[gnu::always_inline]] V along(int b, const Vec6& nu) const {
    const V* g = contacts_[b].g;
    return (all<V>(nu[0]) * g[0] + all<V>(nu[1]) * g[1]) +
           (all<V>(nu[2]) * g[2] + all<V>(nu[3]) * g[3]) +
           (all<V>(nu[4]) * g[4] + all<V>(nu[5]) * g[5]);
  }
  void push(int b, V (&moved)[6]) const {
#pragma GCC unroll 8
    for (int r = 0; r < 6; ++r) moved[r] += states_[b].step * contacts_[b].g[r];
  }
};

}  // namespace grasp
