// Contacts packed for the registers, W to a block, and the functions of a force x on them (cone
// coordinates) that every solver uses. D = 3: (u, o, t); 4: (u, o, t, v) with the torsion of soft
// contacts, which stays zero in the others.
#pragma once
#include <grasp/contacts/contacts.hpp>
#include <grasp/phi/phi.hpp>
#include <grasp/phi/rows.hpp>
#include <grasp/record.hpp>

namespace grasp {

// Weights of a contact in Phi.
inline Weights<double, 4> weights_of(const Contacts& c, int i) {
  return {c.omega[i], c.lambda[i], c.tangential(i) - 1.0};
}

// Constants of W contacts. Unused lanes hold a contact without effect: G = 0, weights 1, mask 0,
// force (1, 0, 0).
template <class V, int D = 3> struct Block {
  using S = Reduced<V>;
  using X = Vec<V, D>;
  X g[6], inverse[6];  // row r of G, and of (G^+)^T, unit frame
  V gjg[21];           // G J G^T, J = diag(1, -1, ..)
  X scale, divisor;
  Weights<V, D> weights;
  V cost, mask;  // weight of u in the sum of normal forces, omega / mu; 1 for a contact, 0
                 // for an unused lane

  X transposed(const Six<S>& n) const { return combined(g, n); }   // G^T n
  X least(const Six<S>& n) const { return combined(inverse, n); }  // G^+ n
  void bind_gjg() {
    for (int r = 0; r < 6; ++r)
      for (int s = 0; s <= r; ++s) gjg[packed(r, s)] = lorentz(g[r], g[s]);
  }
  // out += G x, lane by lane
  void add_wrench(const X& x, V (&out)[6]) const { add(g, x, out); }

  // the same for other rows
  [[gnu::always_inline]] static void add(const X* rows, const X& x, V (&out)[6]) {
#pragma GCC unroll 8
    for (int r = 0; r < 6; ++r) out[r] += dot(rows[r], x);
  }
  [[gnu::always_inline]] static X combined(const X* rows, const Six<S>& n) {
    const auto pair = [&](int r) {
      return all<V>(n[r]) * rows[r] + all<V>(n[r + 1]) * rows[r + 1];
    };
    return pair(0) + pair(2) + pair(4);
  }
};

template <class V> inline Six<Reduced<V>> sums(const V (&a)[6]) {
  Six<Reduced<V>> out;
#pragma GCC unroll 8
  for (int r = 0; r < 6; ++r) out[r] = sum(a[r]);
  return out;
}

template <class V, int B, int D = 3> class Cones {
 public:
  static constexpr int W = width<V>;
  using X = Vec<V, D>;
  using Field = Blocks<X, B>;  // a vector per contact
  using S = Reduced<V>;
  int count;
  UnitFrameOf<S> unit;
  Blocks<Block<V, D>, B> blocks;

  explicit Cones(int count) : count(count) { resize(blocks, needed()); }

  Field field() const {
    Field out;
    resize(out, needed());
    for (auto& x : out) x = axis<D>(all<V>(1.0));
    return out;
  }

  // Reset lanes without a contact to the force (1, 0, 0), where their gradient vanishes: they stay
  // and move nothing. Without friction, the tangential forces are zero.
  void reset_unused_lanes(Field& x) const {
    for (int b = 0; b < int(blocks.size()); ++b) {
      const V& used = blocks[b].mask;
      const V grips = select(blocks[b].scale.o > 0.0, used, V{});
      const V along = used * x[b].u + (1.0 - used);
      if constexpr (D == 3)
        x[b] = {along, grips * x[b].o, grips * x[b].t};
      else
        x[b] = {along, grips * x[b].o, grips * x[b].t,
                blocks[b].scale.v > 0.0 ? used * x[b].v : V{}};
    }
  }

  void pack(const Contacts& c) {
    const int size = 3 * count;
    unit = c.unit;
    for (int b = 0; b < int(blocks.size()); ++b) {
      auto& block = blocks[b];
      // one number of each contact, or `none` in unused lanes
      const auto lanes = [&](double none, auto&& of) {
        V out{};
#pragma GCC unroll 8
        for (int n = 0; n < W; ++n) set(out, n, W * b + n < count ? of(W * b + n) : none);
        return out;
      };
      block.mask = lanes(0.0, [](int) { return 1.0; });
      block.cost = lanes(1.0, [&](int i) { return c.omega[i] / c.divisor[3 * i]; });
      const auto weights = [&](int i) { return fitted<D>(weights_of(c, i)); };
      block.weights.omega = lanes(1.0, [&](int i) { return weights(i).omega; });
      block.weights.lambda = lanes(1.0, [&](int i) { return weights(i).lambda; });
      if constexpr (D == 4)
        block.weights.axial = lanes(1.0, [&](int i) { return weights(i).axial; });
      for (int a = 0; a < 3; ++a) {
        block.scale[a] = lanes(1.0, [&](int i) { return c.scale[3 * i + a]; });
        block.divisor[a] = lanes(1.0, [&](int i) { return c.divisor[3 * i + a]; });
        for (int r = 0; r < 6; ++r) {
          block.g[r][a] = lanes(0.0, [&](int i) { return c.rows[r * size + 3 * i + a]; });
          block.inverse[r][a] = lanes(0.0, [&](int i) { return c.inverse[6 * (3 * i + a) + r]; });
        }
      }
      if constexpr (D == 4) {  // forces alone balance, by `inverse`
        block.scale.v = lanes(1.0, [&](int i) { return c.torsion_scale(i); });
        block.divisor.v = lanes(1.0, [&](int i) { return divisor_of(c.torsion_scale(i)); });
        for (int r = 0; r < 6; ++r) {
          block.g[r].v = lanes(
              0.0, [&](int i) { return c.torsion_wrench(i)[r] / divisor_of(c.torsion_scale(i)); });
          block.inverse[r].v = V{};
        }
      }
    }
    for (auto& block : blocks) block.bind_gjg();
  }

  // Load a register of problems that all have the contacts of one.
  template <class C, int A> void spread(const Cones<C, A>& one)
    requires(many<V> && D == 3)
  {
    unit = UnitFrameOf<S>(one.unit);
    for (int i = 0; i < count; ++i) {
      const auto& from = one.blocks[i / width<C>];
      auto& to = blocks[i];
      const auto copy = [&](const C& a, V& b) { b = V(get(a, i % width<C>)); };
      const auto copy3 = [&](const Vec3<C>& a, Vec3<V>& b) {
        copy(a.u, b.u);
        copy(a.o, b.o);
        copy(a.t, b.t);
      };
      for (int r = 0; r < 6; ++r) {
        copy3(from.g[r], to.g[r]);
        copy3(from.inverse[r], to.inverse[r]);
      }
      for (int k = 0; k < 21; ++k) copy(from.gjg[k], to.gjg[k]);
      copy3(from.scale, to.scale);
      copy3(from.divisor, to.divisor);
      copy(from.weights.omega, to.weights.omega);
      copy(from.weights.lambda, to.weights.lambda);
      copy(from.cost, to.cost);
      copy(from.mask, to.mask);
    }
  }

  // (3N,) numbers (u, o, t) into the lanes, and back; for a register of problems, those of one lane
  void load(const double* from, Field& x, int lane = 0) const {
    for_each(lane, [&](int b, int n, int at) {
      for (int a = 0; a < 3; ++a) set(x[b][a], n, from[at + a]);
    });
  }
  void store(const Field& x, double* to, int lane = 0) const {
    for_each(lane, [&](int b, int n, int at) {
      for (int a = 0; a < 3; ++a) to[at + a] = get(x[b][a], n);
    });
  }
  // the same for forces (normal, o, t) [N]; torsion: (N,) [N m], null: zero
  void load_force(const double* from, Field& x, int lane = 0,
                  [[maybe_unused]] const double* torsion = nullptr) const {
    for_each(lane, [&](int b, int n, int at) {
      for (int a = 0; a < 3; ++a) set(x[b][a], n, from[at + a] * get(blocks[b].scale[a], n));
      if constexpr (D == 4)
        set(x[b].v, n, torsion ? torsion[at / 3] * get(blocks[b].scale.v, n) : 0.0);
    });
  }
  // the same for a point at which Phi is evaluated; a direction keeps zeros in unused lanes
  void load_point(const double* from, Field& x) const {
    load_force(from, x);
    reset_unused_lanes(x);
  }
  void to_force(Field& x) const {
    for (int b = 0; b < int(blocks.size()); ++b)
      for (int a = 0; a < D; ++a) x[b][a] = x[b][a] / blocks[b].divisor[a];
  }
  void store_force(const Field& x, double* to) const {
    for (int b = 0; b < int(blocks.size()); ++b)
      for (int a = 0; a < 3; ++a) {
        const V force = x[b][a] / blocks[b].divisor[a];
        for (int n = 0; n < W && W * b + n < count; ++n) to[3 * (W * b + n) + a] = get(force, n);
      }
  }
  void store_torsion(const Field& x, double* to) const {  // (N,) [N m]
    for (int i = 0; i < count; ++i)
      if constexpr (D == 4)
        to[i] = get(x[i / W].v, i % W) / get(blocks[i / W].divisor.v, i % W);
      else
        to[i] = 0.0;
  }

  // +inf unless strictly inside every cone
  template <class R = NoRows> S phi(const Field& x, const R& rows = {}) const {
    return phi_of(rows, [&](int b) { return x[b]; });
  }
  template <class R = NoRows>
  S phi_along(const Field& x, const Field& step, const S& alpha, const R& rows = {}) const {
    return phi_of(rows, [&](int b) { return x[b] + all<V>(alpha) * step[b]; });
  }
  // the same with `part` of the squeezing cost
  double phi_along(const Field& x, const Field& step, double alpha, double part) const {
    return phi_of(NoRows{}, [&](int b) { return x[b] + all<V>(alpha) * step[b]; }, all<V>(part));
  }
  // d Phi(x + alpha step) / d alpha
  double slope_along(const Field& x, const Field& step, double alpha) const {
    V total{};
    for (int b = 0; b < int(blocks.size()); ++b)
      total += blocks[b].mask *
               dot(gradient(x[b] + all<V>(alpha) * step[b], blocks[b].weights), step[b]);
    return sum(total);
  }

  [[gnu::always_inline]] Six<S> wrench(const Field& x) const {  // G x
    V out[6] = {};
    for (int b = 0; b < int(blocks.size()); ++b) blocks[b].add_wrench(x[b], out);
    return sums(out);
  }
  // x -= G^+ (G x + w), w in the unit frame: balance by the least-norm change of force
  void balance(Field& x, const Six<S>& w) const { subtract(x, wrench(x) + w); }
  // x -= G^+ missed
  void subtract(Field& x, const Six<S>& missed) const {
    for (int b = 0; b < int(blocks.size()); ++b) x[b] -= blocks[b].least(missed);
  }

  // 1 / (largest step inside the cones); <= 0: the whole ray is inside
  S reach(const Field& x, const Field& step) const {
    V most{};
    for (int b = 0; b < int(blocks.size()); ++b) most = max(most, Boundary(x[b]).per(step[b]));
    return largest(most);
  }
  // Smallest distance to a cone's surface.
  S margin(const Field& x) const {
    V room = all<V>(infinity);
    for (int b = 0; b < int(blocks.size()); ++b)
      room = min(room, select(blocks[b].mask > 0.5, slack(x[b]), all<V>(infinity)));
    return least(room);
  }
  // Smallest distance to a cone's surface as a fraction of the contact's u.
  S depth(const Field& x) const {
    V room = all<V>(1.0);
    for (int b = 0; b < int(blocks.size()); ++b)
      room = min(room, select(blocks[b].mask > 0.5, slack(x[b]) / x[b].u, all<V>(1.0)));
    return least(room);
  }
  // True if all numbers are finite and below LARGEST.
  auto is_in_range(const Field& x) const {
    V total{};
    for (int b = 0; b < int(blocks.size()); ++b)
      for (int a = 0; a < D; ++a) total += abs(x[b][a]);
    return sum(total) < LARGEST;
  }
  S largest_normal(const Field& x) const {  // |u|
    V most{};
    for (int b = 0; b < int(blocks.size()); ++b) most = max(most, blocks[b].mask * abs(x[b].u));
    return largest(most);
  }

  // Dual value at nu (unit frame): a lower bound of min Phi that holds for any nu; -inf: no bound.
  template <class R = NoRows>
  S lower_bound(const Six<S>& nu, const Six<S>& w, const R& rows = {}) const {
    return bound(nu, w, rows,
                 [&](const X& y, int b, V& room) { return dual(y, blocks[b].weights, room); });
  }
  // The same in half the time, if x is close to the optimum.
  template <class R = NoRows> S lower_bound(const Six<S>& nu, const Six<S>& w, const Field& x,
                                            double tight, const R& rows = {}) const {
    return bound(nu, w, rows, [&](const X& y, int b, V& room) {
      return dual_near(y, blocks[b].weights, x[b], tight, room);
    });
  }

  // Scale multipliers outside the dual cones into them; nu = 0 is inside.
  void scale_inside(Vec6& nu) const {
    V most{};
    for (int b = 0; b < int(blocks.size()); ++b) {
      const X y = blocks[b].transposed(nu);
      most = max(most, blocks[b].mask * (y.u + tangent_length(y)) /
                           squeezing_cost(blocks[b].weights.omega));
    }
    const double outside = largest(most);
    if (outside > INSIDE) nu = (INSIDE / outside) * nu;
  }

  auto balanced(const Field& x, const Six<S>& w, const S& residual) const {
    return residual <= balance_tolerance(size(w), largest_normal(x));
  }
  S residual(const Field& x, const Six<S>& w) const { return size(wrench(x) + w); }
  // Write force, torsion, residual and margin of x, which certify a solution.
  void certify(const Field& x, const Vec6& w, const Record& record) const {
    record.summary().residual = residual(x, w);
    record.summary().margin = margin(x);
    store_force(x, record.force());
    store_torsion(x, record.torsion());
  }

 private:
  // fraction of the way to the surface of the dual cones, kept clear of rounding
  static constexpr double INSIDE = 1.0 - 1e-13;
  int needed() const { return (count + W - 1) / W; }

  // f(block, lane, first number) for every contact
  template <class F> void for_each(int lane, F&& f) const {
    for (int b = 0; b < int(blocks.size()); ++b)
      for (int n = 0; n < W && W * b + n < count; ++n) f(b, many<V> ? lane : n, 3 * (W * b + n));
  }
  template <class R, class F, class... Part>
  S phi_of([[maybe_unused]] const R& rows, F&& at, Part... part) const {
    V total{};
    V room = all<V>(infinity);
    for (int b = 0; b < int(blocks.size()); ++b) {
      const X x = at(b);
      Weights<V, D> w = blocks[b].weights;
      w.omega = (w.omega * ... * part);
      V term = grasp::phi(x, w);
      if constexpr (R::has_terms) term += rows.value(b, x);
      total += blocks[b].mask * term;
      room = min(room, min(x.u, lorentz(x, x)));
    }
    S value = sum(total);
    if constexpr (R::has_terms) value += rows.joint_value(at);
    return select((least(room) > 0.0) & (value == value), value, S(infinity));
  }
  template <class R, class F>
  S bound(const Six<S>& nu, const Six<S>& w, [[maybe_unused]] const R& rows, F&& least_of) const {
    V total{};
    V smallest = all<V>(infinity);
    for (int b = 0; b < int(blocks.size()); ++b) {
      V room;
      X y = blocks[b].transposed(nu);
      [[maybe_unused]] V more;
      if constexpr (R::has_terms) more = rows.dual(b, y);
      V term = least_of(y, b, room);
      if constexpr (R::has_terms) term += more;
      total += blocks[b].mask * term;
      smallest = min(smallest, room);
    }
    S value = sum(total) - dot(nu, w);
    if constexpr (R::has_terms) value += rows.joint_dual();
    return select((least(smallest) > 0.0) & (value == value), value, S(-infinity));
  }
};

}  // namespace grasp
