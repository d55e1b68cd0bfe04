// The directions of the flows: the projection of a drive onto balance in the metric of P, |P|^2 =
// sum 3 u^2 + 2 o^2 + 2 t^2.
#pragma once
#include <grasp/phi/cones.hpp>

namespace grasp {

// Ways to compute the same product, for N contacts. All give the same steps up to rounding.
enum class Form {
  full,    // Q, (9 N^2)^2 numbers, times vec(P^-1 W_i P^-1 - W_p) (Eqs. 9-12)
  paper,   // Q_bar, 27 N^2 numbers, times VWP (Eqs. 18-26)
  reduced  // Pi = D^-1 - R^T R, D = diag(3, 2, 2), R the six orthonormal rows of G in D: the 9 N^2
           // numbers of -Pi up to four contacts, 39 N beyond, times the gradient of Phi
};
inline constexpr int FULL_CONTACTS = 8;  // largest number of contacts of the dense Q: 2.7 MB

template <class T> inline T squared(const Vec3<T>& x) {
  return 3.0 * x.u * x.u + 2.0 * (x.o * x.o + x.t * x.t);
}
template <class T> inline T inner(const Vec3<T>& x, const Vec3<T>& y) {
  return 3.0 * x.u * y.u + 2.0 * (x.o * y.o + x.t * y.t);
}

// P^-1 W_i P^-1 - W_p of one contact (Eqs. 22-25), P = [[u, 0, o], [0, u, t], [o, t, u]], entry (r,
// c) at 3 c + r.
template <class T> inline std::array<T, 9> drive(const Vec3<T>& x, const Weights<T, 3>& w) {
  const auto [u, o, t] = x;
  const T i = 1.0 / (u * lorentz(x, x));
  const T a = (u * u - t * t) * i;
  const T b = o * t * i;
  const T c = -u * o * i;
  const T d = (u * u - o * o) * i;
  const T e = -u * t * i;
  const T f = u * u * i;
  const T one = w.lambda * (a * b + b * d + c * e);
  const T two = w.lambda * (a * c + b * e + c * f);
  const T five = w.lambda * (b * c + d * e + e * f);
  return {w.lambda * (a * a + b * b + c * c) - w.omega, one,  two, one,
          w.lambda * (b * b + d * d + e * e) - w.omega, five, two, five,
          w.lambda * (c * c + e * e + f * f) - w.omega};
}

template <class V, int B> class Projection {
 public:
  using Field = typename Cones<V, B>::Field;
  static constexpr int W = width<V>;
  // the product with -Pi is faster than the two with R
  static constexpr bool DENSE = B > 0 && W* B <= 4;

  Projection(const Cones<V, B>& cones, Form form)
      : form_(form), count_(cones.count), spare_(cones.field()) {
    for (auto& row : rows_) row = cones.field();
    if (form == Form::full) {
      const int size = 9 * count_ * count_;
      dense_.resize(std::size_t(size) * size);
      into_.resize(size);
      out_.resize(size);
    } else if (form == Form::paper) {
      columns_.assign(9 * count_, cones.field());
      into_.resize(9 * count_);
    } else if (DENSE) {
      columns_.assign(3 * W * B, cones.field());
    }
  }

  // Compute the matrices for the current contacts. Return false if G has lost rank.
  bool place(const Cones<V, B>& cones) {
    if (!orthonormalise(cones)) return false;
    if (form_ == Form::full)
      fill_full();
    else if (form_ == Form::paper)
      fill_paper();
    else if constexpr (DENSE)
      for (int i = 0; i < W * B; ++i)
        for (int a = 0; a < 3; ++a) minus_pi(i, a, columns_[3 * i + a]);
    return true;
  }

  // step = the projected drive at x, where Phi has this gradient
  [[gnu::always_inline]] void apply(const Cones<V, B>& cones, const Field& x, const Field& gradient,
                                    Field& step) {
    if (form_ != Form::reduced) [[unlikely]] {
      spare_ = x;
      printed(cones);
      step = spare_;
    } else if constexpr (DENSE) {
      multiply(gradient, step);
    } else {
      reject(gradient, step);
    }
  }

 private:
  static constexpr double PER[3] = {1.0 / 3.0, 0.5, 0.5};  // D^-1
  // The entries (row, column) of the block P of one contact that hold u, o and t; the first one of
  // each is used in Eq. 18.
  struct Place {
    int coordinate, row, column;
  };
  static constexpr Place PLACES[] = {{0, 0, 0}, {0, 1, 1}, {0, 2, 2}, {1, 2, 0},
                                     {1, 0, 2}, {2, 2, 1}, {2, 1, 2}};
  static constexpr int PICKED[3] = {0, 3, 5};  // indices into PLACES

  Form form_;
  int count_;
  Field rows_[6];                           // R
  std::vector<Field> columns_;              // columns of -Pi or Q_bar
  std::vector<double> dense_, into_, out_;  // Q, vec(P^-1 W_i P^-1 - W_p), their product
  Field spare_;

  static constexpr int PASSES = 6;

  // R: the rows of G D^-1/2, orthonormalised by Cholesky factors, times D^-1/2. Two passes are
  // exact to rounding for condition numbers up to 1e7. Beyond, a shift keeps the first factors
  // positive (Fukaya et al. 2020, "Shifted Cholesky QR") at the cost of more passes.
  bool orthonormalise(const Cones<V, B>& cones) {
    const double root[3] = {std::sqrt(PER[0]), std::sqrt(PER[1]), std::sqrt(PER[2])};
    const int blocks = int(cones.blocks.size());
    for (int r = 0; r < 6; ++r)
      for (int b = 0; b < blocks; ++b)
        for (int a = 0; a < 3; ++a) rows_[r][b][a] = root[a] * cones.blocks[b].g[r][a];
    bool done = false;
    for (int pass = 0; !done; ++pass) {
      if (pass == PASSES) return false;
      V products[21] = {};
      for (int b = 0; b < blocks; ++b)
#pragma GCC unroll 8
        for (int r = 0; r < 6; ++r)
#pragma GCC unroll 8
          for (int k = 0; k <= r; ++k) products[packed(r, k)] += dot(rows_[r][b], rows_[k][b]);
      Packed6 gram;
      double trace = 0.0, off = 0.0;
      for (int k = 0; k < 21; ++k) gram[k] = sum(products[k]);
      for (int r = 0; r < 6; ++r) {
        trace += gram[packed(r, r)];
        for (int k = 0; k <= r; ++k) off = std::max(off, std::abs(gram[packed(r, k)] - (r == k)));
      }
      if (!(trace < infinity)) return false;
      Ldl6 factor;
      if (!(factor.factor(gram) > SHIFT * trace)) {
        for (int r = 0; r < 6; ++r) gram[packed(r, r)] += SHIFT * trace;
        if (!(factor.factor(gram) > 0.0)) return false;
      }
      done = off < CLOSE;  // one more pass from here reaches full accuracy
      for (int b = 0; b < blocks; ++b) {
        for (int r = 1; r < 6; ++r)
          for (int k = 0; k < r; ++k) rows_[r][b] -= all<V>(factor.l[packed(r, k)]) * rows_[k][b];
        for (int r = 0; r < 6; ++r)
          rows_[r][b] = all<V>(std::sqrt(factor.l[packed(r, r)])) * rows_[r][b];
      }
    }
    for (auto& row : rows_)
      for (auto& v : row)
        for (int a = 0; a < 3; ++a) v[a] = root[a] * v[a];
    return true;
  }
  static constexpr double
      SHIFT = 1e-14,
      CLOSE = 1e-4;  // of the trace; the error of the next pass is the square of this one

  // column of -Pi for coordinate a of contact i
  void minus_pi(int i, int a, Field& column) const {
    const int from = i / W;
    const int lane = i % W;
    for (int b = 0; b < int(column.size()); ++b) {
      column[b] = {V{}, V{}, V{}};
      for (int r = 0; r < 6; ++r) column[b] += all<V>(get(rows_[r][from][a], lane)) * rows_[r][b];
    }
    V& entry = column[from][a];
    set(entry, lane, get(entry, lane) - PER[a]);
  }

  // Q_bar = Pi S^T and Q = S Pi S^T, S: (u, o, t) -> vec(P)
  void fill_paper() {
    for (auto& column : columns_)
      for (auto& v : column) v = {V{}, V{}, V{}};
    for (int i = 0; i < count_; ++i)
      for (const Place& p : PLACES) {
        minus_pi(i, p.coordinate, spare_);
        auto& column = columns_[9 * i + 3 * p.column + p.row];
        for (int b = 0; b < int(column.size()); ++b) column[b] -= spare_[b];
      }
  }
  void fill_full() {
    const int size = 3 * count_;
    const int square = size * size;
    std::fill(dense_.begin(), dense_.end(), 0.0);
    for (int j = 0; j < count_; ++j)
      for (const Place& q : PLACES) {
        minus_pi(j, q.coordinate, spare_);
        double* column = dense_.data() + std::size_t(square) * entry(j, q);
        for (int i = 0; i < count_; ++i)
          for (const Place& p : PLACES)
            column[entry(i, p)] = -get(spare_[i / W][p.coordinate], i % W);
      }
  }
  // Index in vec(P), which stacks columns (Eqs. 19, 21), of an entry of the block of contact i.
  int entry(int i, const Place& p) const { return (3 * i + p.column) * 3 * count_ + 3 * i + p.row; }

  void multiply(const Field& gradient, Field& step) const {
    for (int b = 0; b < int(step.size()); ++b) {
      Vec3<V> part[4];
#pragma GCC unroll 4
      for (int n = 0; n < 4; ++n) {
        const Field* column = &columns_[3 * n];
        const Vec3<V>& g = gradient[n / W];
        part[n] = all<V>(get(g.u, n % W)) * column[0][b] + all<V>(get(g.o, n % W)) * column[1][b] +
                  all<V>(get(g.t, n % W)) * column[2][b];
      }
      step[b] = (part[0] + part[1]) + (part[2] + part[3]);
    }
  }

  void reject(const Field& gradient, Field& step) const {
    V along[6] = {};
    for (int b = 0; b < int(step.size()); ++b)
#pragma GCC unroll 8
      for (int r = 0; r < 6; ++r) along[r] += dot(rows_[r][b], gradient[b]);
    const Vec6 y = sums(along);
    for (int b = 0; b < int(step.size()); ++b) {
      const auto pair = [&](int r) {
        return all<V>(y[r]) * rows_[r][b] + all<V>(y[r + 1]) * rows_[r + 1][b];
      };
      const Vec3<V>& g = gradient[b];
      step[b] = (pair(0) + pair(2)) + (pair(4) - Vec3<V>{PER[0] * g.u, PER[1] * g.o, PER[2] * g.t});
    }
  }

  // Replace the x in `spare_` by Q or Q_bar times the drive at x.
  [[gnu::noinline]] void printed(const Cones<V, B>& cones) {
    const int inputs = int(into_.size());
    for (int b = 0; b < int(spare_.size()); ++b) {
      const std::array<V, 9> entries = drive(spare_[b], cones.blocks[b].weights);
      for (int n = 0; n < W && W * b + n < count_; ++n)
        for (int k = 0; k < 9; ++k) {
          const int i = W * b + n;
          into_[form_ == Form::full ? entry(i, {0, k % 3, k / 3}) : 9 * i + k] = get(entries[k], n);
        }
    }
    if (form_ == Form::paper) {
      for (int b = 0; b < int(spare_.size()); ++b) {
        Vec3<V> part[3] = {};
        for (int k = 0; k < inputs; k += 3)
          for (int n = 0; n < 3; ++n) part[n] += all<V>(into_[k + n]) * columns_[k + n][b];
        spare_[b] = part[0] + part[1] + part[2];
      }
      return;
    }
    std::fill(out_.begin(), out_.end(), 0.0);
    for (int j = 0; j < inputs; j += 3) {  // inputs is a multiple of 9
      const double* one = &dense_[std::size_t(j) * inputs];
      const double* two = one + inputs;
      const double* three = two + inputs;
      const double a = into_[j];
      const double b = into_[j + 1];
      const double c = into_[j + 2];
      for (int i = 0; i < inputs; ++i) out_[i] += a * one[i] + b * two[i] + c * three[i];
    }
    for (auto& v : spare_) v = {V{}, V{}, V{}};
    for (int i = 0; i < count_; ++i)
      for (int a = 0; a < 3; ++a) set(spare_[i / W][a], i % W, out_[entry(i, PLACES[PICKED[a]])]);
  }
};

}  // namespace grasp
