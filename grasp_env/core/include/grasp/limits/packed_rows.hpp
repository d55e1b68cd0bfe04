// Rows a . x <= b in cone coordinates, packed for the registers. A row of one contact stands in
// that contact's lane, with the opposite row beside it. A row of several contacts is joint.
#pragma once
#include <grasp/limits/force_limits.hpp>
#include <grasp/phi/cones.hpp>

namespace grasp {

// Own: a row of one contact in each lane, with the vector `a` and the sides `high` and `low`.
// Joint: a row of several contacts, with the two sides. A side has `bound`, `multiplier`, and
// `present`: 0 where there is none.
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
  // Joint row times x(b), the vectors of block b.
  template <class F> double along(int j, F&& x) const {
    V total{};
    for (int b = 0; b < blocks_; ++b) total += dot(column(j, b), x(b));
    return sum(total);
  }
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
  // Set the weight of each row's term of Phi.
  void weigh() {
    for (const Place& p : places_) at(p, [&](auto& side, int n) { set(side.weight, n, p.weight); });
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
    double size, bound, weight;  // divisor of the row, its bound [N], lambda of its term of Phi
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
    double square = 0.0, weight = 0.0, weights = 0.0;
    for (int i = 0; i < cones.count; ++i) {
      const double lambda = get(cones.blocks[i / W].weights.lambda, i % W);
      weights += lambda;
      double part = 0.0;
      for (int a = 0; a < D; ++a) {
        const double value = row[4 * i + a] / get(cones.blocks[i / W].divisor[a], i % W);
        part += value * value;
      }
      square += part;
      if (!(part > 0.0)) continue;
      owner = i;
      weight += lambda;
      ++touched;
    }
    weight = touched ? weight / touched : weights / cones.count;
    const double size = square > 0.0 ? std::sqrt(square) : 1.0;
    bound /= size;
    if (!(size < infinity && std::abs(bound) <= MOST_FORCE)) return false;
    ++sides;
    if (touched > 1)
      add_joint(cones, row, {-1, joint_rows(), false, size, bound, weight});
    else
      add_own(cones, row, {std::max(owner, 0), 0, false, size, bound, weight});
    return true;
  }
  void add_own(const Cones<V, B, D>& cones, std::span<const double> row, Place place) {
    const int b = place.contact / W;
    const int n = place.contact % W;
    Vec<double, D> a;
    double most = 0.0;
    for (int k = 0; k < D; ++k) {
      a[k] = row[4 * place.contact + k] / (place.size * get(cones.blocks[b].divisor[k], n));
      most = std::max(most, std::abs(a[k]));
    }
    const int many = counts_[place.contact];
    for (place.at = 0; place.at < many && most > 0.0; ++place.at) {
      const Own& other = own_[std::size_t(blocks_) * place.at + b];
      double off = 0.0;
      for (int r = 0; r < D; ++r) off = std::max(off, std::abs(get(other.a[r], n) + a[r]));
      place.low = off <= PARALLEL && !(get(other.low.present, n) > 0.0);
      if (place.low) return enter(place);
    }
    place.at = counts_[place.contact]++;
    if (place.at == per_contact_) {
      ++per_contact_;
      own_.resize(std::size_t(blocks_) * per_contact_, Own{});
    }
    Own& own = own_[std::size_t(blocks_) * place.at + b];
    for (int r = 0; r < D; ++r) set(own.a[r], n, a[r]);
    enter(place);
  }
  void add_joint(const Cones<V, B, D>& cones, std::span<const double> row, Place place) {
    const auto entry = [&](int i, int a) {
      return row[4 * i + a] / (place.size * get(cones.blocks[i / W].divisor[a], i % W));
    };
    const int last = place.at - 1;
    place.low = last >= 0 && !(joints[last].low.present > 0.0);
    for (int i = 0; i < cones.count && place.low; ++i)
      for (int a = 0; a < D; ++a)
        place.low =
            place.low && std::abs(get(column(last, i / W)[a], i % W) + entry(i, a)) <= PARALLEL;
    if (place.low) {
      place.at = last;
      return enter(place);
    }
    joints.push_back({});
    columns_.resize(std::size_t(blocks_) * joints.size(), X{});
    for (int i = 0; i < cones.count; ++i)
      for (int a = 0; a < D; ++a)
        set(columns_[std::size_t(blocks_) * place.at + i / W][a], i % W, entry(i, a));
    enter(place);
  }
  void enter(const Place& place) {
    at(place, [](auto& side, int n) { set(side.present, n, 1.0); });
    places_.push_back(place);
  }
};

}  // namespace grasp
