// Limits that are linear in one contact's force, a . x <= b, such as the joint torques of one
// finger, raised by a share t of each: the rows of `LeastExcess`, and what their multipliers prove.
#pragma once
#include <grasp/phi/cones.hpp>
#include <grasp/limits/normal_bound.hpp>

namespace grasp {

// a . x <= bound + t share, or -a . x for the other side. A missing side has present = share = 0.
template <class V> struct Side {
  V bound, share, present;
  // bend: growth of the multiplier, >= 0, as the slack shrinks
  V slack, multiplier, bend;
  V dslack, dmultiplier;  // change by a step

  void at(const V& along, double t) { slack = bound + all<V>(t) * share - along; }
};

// Opposite rows of one contact in each lane.
template <class V> struct Pair {
  Vec3<V> a;
  Side<V> high, low;

  V multiplier() const { return high.multiplier - low.multiplier; }
  template <class F> void sides(F&& f) {
    f(high, 1.0);
    f(low, -1.0);
  }
  template <class F> void sides(F&& f) const {
    f(high, 1.0);
    f(low, -1.0);
  }
  // inverse = (inverse^-1 + (bends) a a^T)^-1
  void update_inverse(Sym3<V>& inverse) const {
    const V c = high.bend + low.bend;
    const Vec3<V> h = inverse * a;
    inverse.subtract(c / (1.0 + c * dot(a, h)), h);
  }
};

// All rows. Every contact gets as many pairs as the contact with most rows needs.
template <class V, int B> class RaisedLimits {
 public:
  static constexpr int W = width<V>;
  using Field = typename Cones<V, B>::Field;
  int sides = 0;  // number of rows

  // Make `pack` free of allocations for up to this many rows.
  void reserve(const Cones<V, B>& cones, int rows) {
    const int blocks = int(cones.blocks.size());
    pairs_of_.resize(W * blocks);
    for (auto& own_pairs : pairs_of_) own_pairs.reserve(rows);
    pairs_.reserve(size_t(rows) * blocks);
    resize_blocks(blocks);
  }
  void pack(const Cones<V, B>& cones, const LimitRows& rows) {
    const int blocks = int(cones.blocks.size());
    pairs_of_.resize(W * blocks);
    for (auto& own_pairs : pairs_of_) own_pairs.clear();
    sides = rows.count;
    pairs_per_contact_ = 1;
    for (int m = 0; m < rows.count; ++m) {
      auto& own_pairs = pairs_of_[rows.contact[m]];
      auto at = own_pairs.begin();
      while (at != own_pairs.end() &&
             !(at->low < 0 && opposite(rows.normal + 3 * at->high, rows.normal + 3 * m)))
        ++at;
      if (at != own_pairs.end())
        at->low = m;
      else
        own_pairs.push_back({m, -1});
      pairs_per_contact_ = std::max(pairs_per_contact_, int(own_pairs.size()));
    }
    pairs_.assign(size_t(pairs_per_contact_) * blocks, no_pair());
    resize_blocks(blocks);
    for (int b = 0; b < blocks; ++b) {
      for (int n = 0; n < W; ++n) {
        const auto& own_pairs = pairs_of_[W * b + n];
        for (int k = 0; k < int(own_pairs.size()); ++k) {
          auto& pair = pairs_[pairs_per_contact_ * b + k];
          for (int a = 0; a < 3; ++a) set(pair.a[a], n, rows.normal[3 * own_pairs[k].high + a]);
          pair.sides([&](Side<V>& side, double sign) {
            const int m = sign > 0.0 ? own_pairs[k].high : own_pairs[k].low;
            if (m < 0) return;
            set(side.bound, n, rows.bound[m]);
            set(side.share, n, rows.share[m]);
            set(side.present, n, 1.0);
          });
        }
        const NormalBound room(rows, own_pairs);
        set(u_bound_[b], n, room.most);
        set(u_growth_[b], n, room.more);
      }
    }
    find_shift(cones);
  }

  // Largest excess of a limit at x, as a fraction of the limit. A limit with share 0 is never
  // exceeded.
  double excess(const Field& x) const {
    V most{};
    for (int b = 0; b < int(x.size()); ++b)
      for_each(b, [&](const Pair<V>& p) {
        const V along = dot(p.a, x[b]);
        most = max(most, max(part(along - p.high.bound, p.high.share),
                             part(-along - p.low.bound, p.low.share)));
      });
    return largest(most);
  }

  // With multipliers y >= 0 and q = sum y a - G^T nu, a balanced force has sum q . x = sum y a . x
  // + nu . w. In the cones and within limits raised by t this is at least -sum delta u_max, where
  // delta is the distance of q from the dual cone, and at most sum y (b + t share) + nu . w. So
  // value + t share >= 0: value < 0 proves that no force keeps the limits, and -value / share is a
  // lower bound on t. Contacts whose u_max no row bounds have nu changed (see `find_shift`) until
  // their delta is zero.
  struct Farkas {
    double value, share;
    Vec6 nu;
  };
  Farkas farkas(const Cones<V, B>& cones, const Vec6& multipliers, const Vec6& w,
                double t = 0.0) const {
    const Vec6 nu = shifted(cones, multipliers);
    V total{}, share{};
    const V pushed = all<V>(-dot(shift_, w));
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      Vec3<V> q = -cones.blocks[b].transposed(nu);
      for_each(b, [&](const Pair<V>& p) {
        q += p.multiplier() * p.a;
        p.sides([&](const Side<V>& side, double) {
          total += side.multiplier * side.bound;
          share += side.multiplier * side.share;
        });
      });
      const V room = max(V{}, u_bound_[b] + all<V>(t) * u_growth_[b] + unbounded_[b] * pushed);
      total += cones.blocks[b].mask * max(V{}, -slack(q)) * room;
    }
    double value = sum(total);
    for (int r = 0; r < 6; ++r) value += nu[r] * w[r];
    return {value, sum(share), nu};
  }

  template <class F> void for_each(int b, F&& f) {
    for (int k = 0; k < pairs_per_contact_; ++k) f(pairs_[pairs_per_contact_ * b + k]);
  }
  template <class F> void for_each(int b, F&& f) const {
    for (int k = 0; k < pairs_per_contact_; ++k) f(pairs_[pairs_per_contact_ * b + k]);
  }

 private:
  // fraction of the terms of a proof, far above rounding
  static constexpr double PROOF_MARGIN = BOUNDARY;
  // fraction of the trace: regularises contacts that least squares leave undetermined
  static constexpr double REGULARISATION = 1e-12;
  static constexpr double INSIDE = 0.1;  // of e_u: required depth of the answer in the dual cones
  static constexpr double PARALLEL = 1e-12;  // allowed difference of opposite rows
  int pairs_per_contact_ = 1;
  std::vector<std::vector<RowPair>> pairs_of_;  // pairs of each contact
  std::vector<Pair<V>> pairs_;                  // (blocks, each)
  // u is at most u_bound + t u_growth within limits raised by t
  Blocks<V, B> u_bound_, u_growth_;
  // 1 for a contact that no row bounds, with u at most u_bound + t u_growth - shift . w
  Blocks<V, B> unbounded_;
  Vec6 shift_{};
  bool has_shift_ = false;

  // For contacts that no row bounds: find by least squares a twist nu with G_i^T nu - e_u in the
  // dual cone of each. Adding it takes multipliers into their dual cones. It bounds the rounding
  // left there: the u add up to at most nu . sum G_i x_i = -nu . w - sum (G_j^T nu) . x_j over the
  // other contacts. Contacts that can squeeze the object by themselves have no such twist.
  void find_shift(const Cones<V, B>& cones) {
    const int blocks = int(cones.blocks.size());
    Packed6 square{};
    Vec6 side{};
    for (int b = 0; b < blocks; ++b) {
      const auto& c = cones.blocks[b];
      unbounded_[b] = u_bound_[b] < UNBOUNDED ? V{} : c.mask;
      for (int r = 0; r < 6; ++r) {
        side[r] += sum(unbounded_[b] * c.g[r].u);
        for (int s = 0; s <= r; ++s)
          square[packed(r, s)] += sum(unbounded_[b] * dot(c.g[r], c.g[s]));
      }
    }
    double trace = 0.0;
    for (int r = 0; r < 6; ++r) trace += square[packed(r, r)];
    for (int r = 0; r < 6; ++r) square[packed(r, r)] += REGULARISATION * trace;
    Ldl6 factor;
    const Vec6 nu = factor.factor(square) > 0.0 ? factor.solve(side) : Vec6{};
    V nearest = all<V>(infinity);
    V most{};
    V more{};
    for (int b = 0; b < blocks; ++b)
      nearest = min(nearest,
                    unbounded_[b] > 0.0 ? slack(cones.blocks[b].transposed(nu)) : all<V>(infinity));
    const double inside = least(nearest);
    has_shift_ = inside > INSIDE && inside < infinity;
    if (!has_shift_) {
      shift_ = {};
      for (auto& block : unbounded_) block = V{};
      return;
    }
    shift_ = (1.0 / inside) * nu;
    for (int b = 0; b < blocks; ++b) {
      const auto& c = cones.blocks[b];
      const V borne = (c.mask - unbounded_[b]) * max(V{}, -slack(c.transposed(shift_)));
      most += borne * u_bound_[b];
      more += borne * u_growth_[b];
    }
    for (int b = 0; b < blocks; ++b) {
      u_bound_[b] = unbounded_[b] > 0.0 ? all<V>(sum(most)) : u_bound_[b];
      u_growth_[b] = unbounded_[b] > 0.0 ? all<V>(sum(more)) : u_growth_[b];
    }
  }

  Vec6 shifted(const Cones<V, B>& cones, const Vec6& nu) const {
    if (!has_shift_) return nu;
    V lacking{};
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      Vec3<V> q = -cones.blocks[b].transposed(nu);
      for_each(b, [&](const Pair<V>& p) { q += p.multiplier() * p.a; });
      lacking = max(lacking, unbounded_[b] * -slack(q));
    }
    return nu - (1.0 + PROOF_MARGIN) * largest(lacking) * shift_;
  }

  void resize_blocks(int blocks) {
    resize(u_bound_, blocks);
    resize(u_growth_, blocks);
    resize(unbounded_, blocks);
  }
  static Pair<V> no_pair() {
    Pair<V> out{};
    out.high.bound = out.low.bound = all<V>(UNBOUNDED);
    return out;
  }
  static bool opposite(const double* a, const double* b) {
    double off = 0.0, any_of = 0.0;
    for (int r = 0; r < 3; ++r) {
      off = std::max(off, std::abs(a[r] + b[r]));
      any_of = std::max(any_of, std::abs(a[r]));
    }
    return any_of > 0.0 && off < PARALLEL;
  }
  static V part(const V& excess, const V& share) { return share > 0.0 ? excess / share : V{}; }
};

}  // namespace grasp
