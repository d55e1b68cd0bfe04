// Limits of the exact problem, packed for the registers: rows a . x <= b in cone coordinates. A row
// of one contact stands in that contact's lane, with the opposite row beside it. A row of several
// contacts is joint.
#pragma once
#include <grasp/limits/force_limits.hpp>
#include <grasp/math/row_block.hpp>
#include <grasp/phi/cones.hpp>

namespace grasp {

// One side of a row, a . x + slack = bound, or of its opposite. A missing side has present = 0.
template <class V> struct Bound {
  V present{}, bound{};
  V slack = all<V>(1.0), multiplier = all<V>(1.0);
  // `missed` = a . x + slack - bound; 1 / slack, 1 / multiplier, multiplier / slack
  V missed{}, per_slack{}, per_multiplier{}, bend{};
  V rate{}, dslack{}, dmultiplier{};  // the multiplier's change at an unchanged slack; the step

  V counted() const { return present * multiplier; }
  // Begin at a . x with a slack of at least `floor` and a multiplier of at most `most`, where
  // multiplier * slack = `product` if possible.
  void begin(const V& along, const V& floor, const V& product, const V& most) {
    slack = select(present > 0.0, max(bound - along, floor), all<V>(1.0));
    multiplier = select(present > 0.0, min(product / slack, most), all<V>(1.0));
  }
  // Take over a . x.
  void at(const V& along) {
    const V both = 1.0 / (slack * multiplier);
    per_slack = both * multiplier;
    per_multiplier = both * slack;
    bend = present * multiplier * per_slack;
    missed = present * (along + slack - bound);
  }
  // Aim at multiplier * slack = target, with the second-order term of the last step.
  void aim(double target) {
    rate = present * ((target - dslack * dmultiplier) * per_slack - multiplier);
  }
  // Leave the residual as it is in the next step.
  void forgive() { missed = V{}; }
  // Forget the last step.
  void stay() {
    dslack = V{};
    dmultiplier = V{};
  }
  // The change of the slack that fits the multiplier's.
  V slack_step() const { return present * (rate - dmultiplier) * slack * per_multiplier; }
};
// A row's two sides.
template <class V> struct Bounds {
  Bound<V> high, low;
  V bend{}, right{};  // of both sides: bend (a . dx - right) is the change of the multiplier

  V multiplier() const { return high.counted() - low.counted(); }
  V change() const { return high.dmultiplier - low.dmultiplier; }
  void begin(const V& along, const V& floor, const V& product, const V& most) {
    high.begin(along, floor, product, most);
    low.begin(-along, floor, product, most);
  }
  void at(const V& along) {
    high.at(along);
    low.at(-along);
    bend = high.bend + low.bend + NO_BEND;
  }
  // How far a . x exceeds a bound; <= 0 within them.
  V outside(const V& along) const {
    return max(high.present * (along - high.bound), -low.present * (along + low.bound));
  }
  // Take over the sides' rates.
  void take_rates() {
    right = ((low.rate + low.bend * low.missed) - (high.rate + high.bend * high.missed)) / bend;
  }
  // Set the step from left = a . dx - right. The nearer side has its multiplier from the other one,
  // and its slack from its multiplier, so that nothing cancels.
  void step(const V& left) {
    const V along = left + right;
    const V net = bend * left;
    const V high_slack = -high.present * (high.missed + along);
    const V low_slack = -low.present * (low.missed - along);
    const V high_multiplier = high.rate - high.bend * high_slack;
    const V low_multiplier = low.rate - low.bend * low_slack;
    const auto near = high.bend >= low.bend;
    high.dmultiplier = select(near, net + low_multiplier, high_multiplier);
    low.dmultiplier = select(near, low_multiplier, high_multiplier - net);
    high.dslack = select(near, high.slack_step(), high_slack);
    low.dslack = select(near, low_slack, low.slack_step());
  }

 private:
  static constexpr double NO_BEND = 1e-300;  // where both sides are missing
};

template <class V, int B, int D = 3> class ConicLimits {
 public:
  static constexpr int W = width<V>;
  using X = Vec<V, D>;
  struct Own : Bounds<V> {
    X a;
    RowUpdate<V, D> update;
    V left;
  };
  using Joint = Bounds<double>;
  int sides = 0;  // number of rows
  std::vector<Joint> joints;

  // Make `pack` free of allocations for up to this many rows.
  void reserve(const Cones<V, B, D>& cones, int rows) {
    const int blocks = int(cones.blocks.size());
    own_.reserve(std::size_t(rows) * blocks);
    joints.reserve(rows);
    columns_.reserve(std::size_t(rows) * blocks);
    places_.reserve(rows);
    row_.reserve(4 * W * blocks);
    counts_.reserve(W * blocks);
  }

  // Take over the limits of the contacts in `cones`, with a Jacobian (N, 4, J) in contact frames.
  // Return false if numbers are too large.
  bool pack(const Cones<V, B, D>& cones, const ForceLimits& limits, const Preload& preload) {
    const int count = cones.count;
    blocks_ = int(cones.blocks.size());
    counts_.assign(W * blocks_, 0);
    row_.resize(4 * count);
    places_.clear();
    joints.clear();
    columns_.clear();
    own_.clear();
    sides = per_contact_ = 0;
    bool good = true;
    limits.rows(
        count, 4, row_,
        [&](std::span<const double> row, double bound, double) {
          good = good && add(cones, row, bound);
        },
        preload);
    return good;
  }
  int joint_rows() const { return int(joints.size()); }
  // Coefficients of a joint row at block b.
  const X& column(int j, int b) const { return columns_[std::size_t(blocks_) * j + b]; }
  // Call f(row) for the rows of the contacts in block b.
  template <class F> void each_own(int b, F&& f) {
    for (int k = 0; k < per_contact_; ++k) f(own_[std::size_t(blocks_) * k + b]);
  }
  // the same from the last to the first
  template <class F> void each_own_back(int b, F&& f) {
    for (int k = per_contact_ - 1; k >= 0; --k) f(own_[std::size_t(blocks_) * k + b]);
  }
  template <class F> void each_own(int b, F&& f) const {
    for (int k = 0; k < per_contact_; ++k) f(own_[std::size_t(blocks_) * k + b]);
  }
  // Call f(side) for both sides of all rows: registers for those of one contact, numbers for
  // others.
  template <class F> void each_side(F&& f) {
    sides_of(own_, f);
    sides_of(joints, f);
  }
  template <class F> void each_side(F&& f) const {
    sides_of(own_, f);
    sides_of(joints, f);
  }
  // Smallest bound.
  double least_bound() const {
    double out = infinity;
    for (const Place& p : places_) out = std::min(out, p.bound);
    return out;
  }
  // Set the bounds for forces in units of `unit`.
  void scale(double unit) {
    const double per = 1.0 / unit;
    for (const Place& p : places_)
      at(p, [&](auto& side, int n) { set(side.bound, n, per * p.bound); });
  }
  // Write the multipliers of the rows as they were given, each times k.
  void store(double k, double* to) const {
    for (const Place& p : places_)
      at(p, [&](const auto& side, int n) { *to++ = k * get(side.multiplier, n) / p.size; });
  }

 private:
  static constexpr double PARALLEL = 1e-12;   // allowed difference of opposite rows
  static constexpr double MOST_FORCE = 1e20;  // [N]
  // Where a row stands: at a contact, or in `joints` (contact -1).
  struct Place {
    int contact, at;
    bool low;
    double size, bound;  // divisor of the row, and its bound [N]
  };
  int blocks_ = 0, per_contact_ = 0;
  std::vector<Own> own_;    // (rows of a contact, blocks)
  std::vector<X> columns_;  // (joint rows, blocks)
  std::vector<Place> places_;
  std::vector<double> row_;
  std::vector<int> counts_;  // rows of each contact

  template <class Rows, class F> static void sides_of(Rows& rows, F& f) {
    for (auto& row : rows) {
      f(row.high);
      f(row.low);
    }
  }
  template <class F> void at(const Place& p, F&& f) { find(*this, p, f); }
  template <class F> void at(const Place& p, F&& f) const { find(*this, p, f); }
  template <class Self, class F> static void find(Self& self, const Place& p, F& f) {
    if (p.contact < 0) {
      auto& row = self.joints[p.at];
      f(p.low ? row.low : row.high, 0);
    } else {
      auto& row = self.own_[std::size_t(self.blocks_) * p.at + p.contact / W];
      f(p.low ? row.low : row.high, p.contact % W);
    }
  }

  bool add(const Cones<V, B, D>& cones, std::span<const double> row, double bound) {
    int owner = -1, touched = 0;
    double square = 0.0;
    for (int i = 0; i < cones.count; ++i) {
      double part = 0.0;
      for (int a = 0; a < D; ++a) {
        const double value = row[4 * i + a] / get(cones.blocks[i / W].divisor[a], i % W);
        part += value * value;
      }
      square += part;
      if (!(part > 0.0)) continue;
      owner = i;
      ++touched;
    }
    const double size = square > 0.0 ? std::sqrt(square) : 1.0;
    bound /= size;
    if (!(size < infinity && std::abs(bound) <= MOST_FORCE)) return false;
    ++sides;
    if (touched > 1)
      add_joint(cones, row, size, bound);
    else
      add_own(cones, row, std::max(owner, 0), size, bound);
    return true;
  }
  void add_own(const Cones<V, B, D>& cones, std::span<const double> row, int contact, double size,
               double bound) {
    const int b = contact / W;
    const int n = contact % W;
    Vec<double, D> a;
    for (int k = 0; k < D; ++k)
      a[k] = row[4 * contact + k] / (size * get(cones.blocks[b].divisor[k], n));
    for (int k = 0; k < counts_[contact]; ++k) {
      Own& other = own_[std::size_t(blocks_) * k + b];
      double off = 0.0, most = 0.0;
      for (int r = 0; r < D; ++r) {
        off = std::max(off, std::abs(get(other.a[r], n) + a[r]));
        most = std::max(most, std::abs(a[r]));
      }
      if (get(other.low.present, n) > 0.0 || !(off <= PARALLEL) || !(most > 0.0)) continue;
      set(other.low.present, n, 1.0);
      places_.push_back({contact, k, true, size, bound});
      return;
    }
    const int k = counts_[contact]++;
    if (k == per_contact_) {
      ++per_contact_;
      own_.resize(std::size_t(blocks_) * per_contact_, Own{});
    }
    Own& own = own_[std::size_t(blocks_) * k + b];
    for (int r = 0; r < D; ++r) set(own.a[r], n, a[r]);
    set(own.high.present, n, 1.0);
    places_.push_back({contact, k, false, size, bound});
  }
  void add_joint(const Cones<V, B, D>& cones, std::span<const double> row, double size,
                 double bound) {
    const auto entry = [&](int i, int a) {
      return row[4 * i + a] / (size * get(cones.blocks[i / W].divisor[a], i % W));
    };
    const int last = joint_rows() - 1;
    bool opposite = last >= 0 && !(joints[last].low.present > 0.0);
    for (int i = 0; i < cones.count && opposite; ++i)
      for (int a = 0; a < D; ++a)
        opposite =
            opposite && std::abs(get(column(last, i / W)[a], i % W) + entry(i, a)) <= PARALLEL;
    if (opposite) {
      joints[last].low.present = 1.0;
      places_.push_back({-1, last, true, size, bound});
      return;
    }
    joints.push_back({});
    joints.back().high.present = 1.0;
    columns_.resize(std::size_t(blocks_) * joints.size(), X{});
    for (int i = 0; i < cones.count; ++i)
      for (int a = 0; a < D; ++a)
        set(columns_[std::size_t(blocks_) * (last + 1) + i / W][a], i % W, entry(i, a));
    places_.push_back({-1, last + 1, false, size, bound});
  }
};

}  // namespace grasp
