// Rows a . x <= b in cone coordinates, packed for the registers. A row of one contact stands in
// that contact's lane, with the opposite row beside it. A row of several contacts is joint.
#pragma once
#include <grasp/limits/force_limits.hpp>
#include <grasp/phi/cones.hpp>

namespace grasp {

// Own: a row of one contact in each lane, with the vector `a`. Joint: a row of several contacts.
// Both have `side(false)`, and `side(true)` for the opposite row if they are PAIRED. A side has
// `bound`, `multiplier`, and `present`: 0 where there is none.
template <class V, int B, int D, class Own, class Joint> class PackedRows {
 public:
  static constexpr int W = width<V>;
  using X = Vec<V, D>;
  int sides = 0;  // number of rows
  std::vector<Joint> joints;

  // Make `pack` free of allocations for up to this many rows.
  void reserve(const Cones<V, B, D>& cones, int rows) {
    const int blocks = int(cones.blocks.size());
    own_.reserve(std::size_t(rows) * blocks);
    joints.reserve(rows);
    columns_.reserve(std::size_t(rows) * blocks);
    places_.reserve(rows);
    for (auto* numbers : {&row_, &turned_, &per_divisor_, &lambda_})
      numbers->reserve(4 * W * blocks);
    counts_.reserve(W * blocks);
  }

  // Take over the limits of the contacts in `cones`, with a Jacobian (N, 4, J) in contact frames.
  // lambda: (N,) weights of Phi. Return false if numbers are too large.
  bool pack(const Cones<V, B, D>& cones, const ForceLimits& limits, const Preload& preload,
            std::span<const double> lambda = {}) {
    clear(cones);
    std::ranges::copy(lambda, lambda_.begin());
    bool good = true;
    limits.rows(
        cones.count, 4, row_,
        [&](std::span<const double> row, double bound, double) { good = good && add(row, bound); },
        preload);
    return good;
  }
  // Take over the joint torques: rows a . x - bound, of all joints.
  bool pack_torques(const Cones<V, B, D>& cones, const ForceLimits& limits,
                    const Preload& preload) {
    clear(cones);
    bool good = true;
    limits.torques(
        cones.count, row_,
        [&](std::span<const double> row, double bias) { good = good && add(row, -bias); }, preload);
    return good;
  }
  // Add a row of every contact. f(b): that of block b.
  template <class F> void add_each(int count, F&& f) {
    for (int b = 0; b < blocks_; ++b) own_.push_back(f(b));
    ++per_contact_;
    sides += count;
  }
  int joint_rows() const { return int(joints.size()); }
  // Coefficients of a joint row at block b.
  const X& column(int j, int b) const { return columns_[std::size_t(blocks_) * j + b]; }
  // Joint row times x(b), the vectors of block b.
  template <class F> double along(int j, F&& x) const {
    V total{};
    for (int b = 0; b < blocks_; ++b) total += dot(column(j, b), x(b));
    return sum(total);
  }
  // Call f(row) for the rows of the contacts in block b.
  template <class F> void each_own(int b, F&& f) {
    for (int k = 0; k < per_contact_; ++k) f(own(k, b));
  }
  // the same from the last to the first
  template <class F> void each_own_back(int b, F&& f) {
    for (int k = per_contact_ - 1; k >= 0; --k) f(own(k, b));
  }
  template <class F> void each_own(int b, F&& f) const {
    for (int k = 0; k < per_contact_; ++k) f(own(k, b));
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
  // Call f(row) as `each_own`, without the row that `add_each` added last.
  template <class F> void each_given(int b, F&& f) const {
    for (int k = 0; k + 1 < per_contact_; ++k) f(own(k, b));
  }
  // Row of block b that `add_each` added last.
  const Own& added(int b) const { return own(per_contact_ - 1, b); }
  Own& added(int b) { return own(per_contact_ - 1, b); }
  // Smallest bound.
  double least_bound() const {
    double out = infinity;
    for (const Place& p : places_) out = std::min(out, p.bound);
    return out;
  }
  // A row as it was given: its length, its bound over that [N], lambda of its term of Phi.
  struct Given {
    double size = 1.0, bound = 0.0, weight = 0.0;
  };
  // Call f(side, lane, given) for every row, in the order of the limits.
  template <class F> void each_place(F&& f) {
    for (const Place& p : places_) visit(*this, p, f);
  }
  template <class F> void each_place(F&& f) const {
    for (const Place& p : places_) visit(*this, p, f);
  }
  // Set the bounds for forces in units of `unit`.
  void scale(double unit) {
    const double per = 1.0 / unit;
    each_place([&](auto& side, int n, const Given& row) { set(side.bound, n, per * row.bound); });
  }
  // Write the multipliers of the rows as they were given, each times k.
  void store(double k, double* to) const {
    each_place([&](const auto& side, int n, const Given& row) {
      *to++ = k * get(side.multiplier, n) / row.size;
    });
  }

 private:
  static constexpr double PARALLEL = 1e-12;   // allowed difference of opposite rows
  static constexpr double MOST_FORCE = 1e20;  // [N]
  // Where a row stands: at a contact, or in `joints` (contact -1).
  struct Place : Given {
    int contact = 0, at = 0;
    bool low = false;
  };
  int blocks_ = 0, per_contact_ = 0;
  std::vector<Own> own_;    // (rows of a contact, blocks)
  std::vector<X> columns_;  // (joint rows, blocks)
  std::vector<Place> places_;
  std::vector<double> row_, turned_;          // (N, 4) a row, and the same in cone coordinates
  std::vector<double> per_divisor_, lambda_;  // (N, 4) and (N,) of the contacts
  std::vector<int> counts_;                   // rows of each contact

  template <class Rows, class F> static void sides_of(Rows& rows, F& f) {
    for (auto& row : rows) {
      f(row.side(false));
      if constexpr (std::decay_t<decltype(row)>::PAIRED) f(row.side(true));
    }
  }
  void clear(const Cones<V, B, D>& cones) {
    blocks_ = int(cones.blocks.size());
    counts_.assign(W * blocks_, 0);
    for (auto* numbers : {&row_, &turned_, &per_divisor_}) numbers->assign(4 * cones.count, 0.0);
    lambda_.assign(cones.count, 1.0);
    for (int i = 0; i < cones.count; ++i) {
      const auto& c = cones.blocks[i / W];
      for (int a = 0; a < D; ++a) per_divisor_[4 * i + a] = 1.0 / get(c.divisor[a], i % W);
    }
    places_.clear();
    joints.clear();
    columns_.clear();
    own_.clear();
    sides = per_contact_ = 0;
  }
  // Row k of the contacts in block b.
  Own& own(int k, int b) { return own_[std::size_t(blocks_) * k + b]; }
  const Own& own(int k, int b) const { return own_[std::size_t(blocks_) * k + b]; }
  template <class Self, class F> static void visit(Self& self, const Place& p, F&& f) {
    if (p.contact < 0)
      f(self.joints[p.at].side(p.low), 0, p);
    else
      f(self.own(p.at, p.contact / W).side(p.low), p.contact % W, p);
  }

  // row: (N, 4)
  bool add(std::span<const double> row, double bound) {
    const int count = int(lambda_.size());
    int owner = 0, touched = 0;
    double square = 0.0, weight = 0.0, weights = 0.0;
    for (int i = 0; i < count; ++i) {
      double part = 0.0;
      for (int k = 4 * i; k < 4 * i + D; ++k) {
        turned_[k] = row[k] * per_divisor_[k];
        part += turned_[k] * turned_[k];
      }
      square += part;
      weights += lambda_[i];
      if (!(part > 0.0)) continue;
      owner = i;
      weight += lambda_[i];
      ++touched;
    }
    weight = touched ? weight / touched : weights / count;
    const double size = square > 0.0 ? std::sqrt(square) : 1.0;
    const double per = 1.0 / size;
    bound *= per;
    if (!(size < infinity && std::abs(bound) <= MOST_FORCE)) return false;
    for (double& value : turned_) value *= per;
    ++sides;
    Place& place = places_.emplace_back();
    place.size = size;
    place.bound = bound;
    place.weight = weight;
    place.contact = touched > 1 ? -1 : owner;
    if (touched > 1)
      add_joint(place);
    else
      add_own(place);
    visit(*this, place, [](auto& side, int n, const Given&) { set(side.present, n, 1.0); });
    return true;
  }
  void add_own(Place& place) {
    const int b = place.contact / W;
    const int n = place.contact % W;
    const double* a = &turned_[4 * place.contact];
    double most = 0.0;
    for (int k = 0; k < D; ++k) most = std::max(most, std::abs(a[k]));
    const int many = counts_[place.contact];
    for (place.at = 0; place.at < many && most > 0.0 && Own::PAIRED; ++place.at) {
      Own& other = own(place.at, b);
      double off = 0.0;
      for (int r = 0; r < D; ++r) off = std::max(off, std::abs(get(other.a[r], n) + a[r]));
      place.low = off <= PARALLEL && !(get(other.side(true).present, n) > 0.0);
      if (place.low) return;
    }
    place.at = counts_[place.contact]++;
    if (place.at == per_contact_) {
      ++per_contact_;
      own_.resize(std::size_t(blocks_) * per_contact_, Own{});
    }
    for (int r = 0; r < D; ++r) set(own(place.at, b).a[r], n, a[r]);
  }
  void add_joint(Place& place) {
    const int count = int(lambda_.size());
    const int last = joint_rows() - 1;
    place.at = last + 1;
    place.low = Joint::PAIRED && last >= 0 && !(joints[last].side(true).present > 0.0);
    for (int i = 0; i < count && place.low; ++i)
      for (int a = 0; a < D; ++a) {
        const double off = get(column(last, i / W)[a], i % W) + turned_[4 * i + a];
        place.low = place.low && std::abs(off) <= PARALLEL;
      }
    if (place.low) {
      place.at = last;
      return;
    }
    joints.push_back({});
    columns_.resize(std::size_t(blocks_) * joints.size(), X{});
    for (int i = 0; i < count; ++i)
      for (int a = 0; a < D; ++a)
        set(columns_[std::size_t(blocks_) * place.at + i / W][a], i % W, turned_[4 * i + a]);
  }
};

}  // namespace grasp
