// Small perceptrons in float32; the activation v/2 (1 + v / sqrt(1 + v^2)) costs no exponential.
#pragma once
#include <algorithm>
#include <span>
#include <vector>
#include <grasp/math/lanes.hpp>

namespace grasp {

inline constexpr int FLOATS = 2 * REGISTER;  // floats in a register
typedef float Floats __attribute__((vector_size(4 * FLOATS)));

// Largest accepted sizes of a network from a file.
inline constexpr int MOST_STAGES = 8, WIDEST = 1024;

inline Floats activation(Floats v) {
  const Floats square = 1.0f + v * v;
  Floats root{};
  for (int n = 0; n < FLOATS; ++n) root[n] = __builtin_sqrtf(square[n]);
  return 0.5f * v * (1.0f + v / root);
}

// to = f(from W + bias); the rows of W (inputs x outputs) are padded to whole registers.
class Dense {
 public:
  Dense() = default;
  // flat: (inputs x outputs)
  Dense(int inputs, int outputs, const float* flat, const float* bias)
      : inputs_(inputs),
        outputs_(outputs),
        row_(registers(outputs)),
        weights_(std::size_t(inputs) * row_),
        bias_(row_) {
    for (int i = 0; i < inputs; ++i)
      spread(flat + std::size_t(i) * outputs, outputs, &weights_[std::size_t(i) * row_]);
    spread(bias, outputs, bias_.data());
  }

  void write(std::vector<float>& flat) const {
    for (int i = 0; i < inputs_; ++i) write(&weights_[std::size_t(i) * row_], flat);
    write(bias_.data(), flat);
  }

  int padded() const { return FLOATS * row_; }  // outputs rounded up to whole registers

  // hidden: true if the activation follows.
  template <bool hidden> void operator()(const float* from, float* to) const {
    int b = 0;
    for (; b + 8 <= row_; b += 8) tile<8, hidden>(from, b, to);
    for (; b + 4 <= row_; b += 4) tile<4, hidden>(from, b, to);
    for (; b < row_; ++b) tile<1, hidden>(from, b, to);
  }

 private:
  int inputs_ = 0, outputs_ = 0, row_ = 0;
  std::vector<Floats> weights_, bias_;

  void write(const Floats* from, std::vector<float>& flat) const {
    for (int k = 0; k < outputs_; ++k) flat.push_back(from[k / FLOATS][k % FLOATS]);
  }

  static int registers(int outputs) { return (outputs + FLOATS - 1) / FLOATS; }
  static void spread(const float* from, int count, Floats* to) {
    std::fill(to, to + registers(count), Floats{});
    __builtin_memcpy(to, from, sizeof(float) * count);
  }

  // K registers of outputs, kept in registers throughout. Few outputs use several partial sums,
  // since each addition waits for the one before.
  template <int K, bool hidden> void tile(const float* from, int first, float* to) const {
    constexpr int TURNS = 8 / K;
    Floats sums[TURNS][K] = {};
    for (int k = 0; k < K; ++k) sums[0][k] = bias_[first + k];
    const Floats* w = weights_.data() + first;
    int i = 0;
    for (; i + TURNS <= inputs_; i += TURNS)
#pragma GCC unroll 8
      for (int turn = 0; turn < TURNS; ++turn, w += row_)
#pragma GCC unroll 8
        for (int k = 0; k < K; ++k) sums[turn][k] += from[i + turn] * w[k];
    for (; i < inputs_; ++i, w += row_)
      for (int k = 0; k < K; ++k) sums[0][k] += from[i] * w[k];
    for (int k = 0; k < K; ++k) {
      Floats v = sums[0][k];
      for (int turn = 1; turn < TURNS; ++turn) v += sums[turn][k];
      if (hidden) v = activation(v);
      __builtin_memcpy(to + FLOATS * (first + k), &v, sizeof v);
    }
  }
};

class Network {
 public:
  Network() = default;
  // sizes: inputs, hidden ..., outputs, accepted by `numbers`. flat: for each stage the weights
  // (inputs x outputs), then the bias.
  Network(std::span<const int> sizes, const float* flat) {
    for (std::size_t stage = 0; stage + 1 < sizes.size(); ++stage) {
      const int inputs = sizes[stage];
      const int outputs = sizes[stage + 1];
      const float* bias = flat + std::size_t(inputs) * outputs;
      stages_.emplace_back(inputs, outputs, flat, bias);
      flat = bias + outputs;
    }
    sizes_.assign(sizes.begin(), sizes.end());
    std::size_t widest = 0;
    for (const Dense& stage : stages_) widest = std::max(widest, std::size_t(stage.padded()));
    one_.resize(widest);
    other_.resize(widest);
  }

  // Number of weights and biases of a network of these sizes; 0 if the sizes are empty or out of
  // range.
  static std::size_t numbers(std::span<const int> sizes) {
    if (sizes.size() < 2 || sizes.size() > MOST_STAGES + 1) return 0;
    std::size_t total = 0;
    for (const int size : sizes)
      if (size < 1 || size > WIDEST) return 0;
    for (std::size_t stage = 0; stage + 1 < sizes.size(); ++stage)
      total += std::size_t(sizes[stage] + 1) * sizes[stage + 1];
    return total;
  }

  int inputs() const { return sizes_.empty() ? 0 : sizes_.front(); }
  int outputs() const { return sizes_.empty() ? 0 : sizes_.back(); }
  std::span<const int> sizes() const { return sizes_; }
  void write(std::vector<float>& flat) const {
    for (const Dense& stage : stages_) stage.write(flat);
  }

  // features: (inputs,); the outputs stay valid until the next call.
  const float* operator()(const float* features) {
    const float* from = features;
    for (std::size_t stage = 0; stage < stages_.size(); ++stage) {
      const Dense& dense = stages_[stage];
      float* to = (stage % 2 ? other_ : one_).data();
      if (stage + 1 < stages_.size())
        dense.template operator()<true>(from, to);
      else
        dense.template operator()<false>(from, to);
      from = to;
    }
    return from;
  }

 private:
  std::vector<int> sizes_;
  std::vector<Dense> stages_;
  std::vector<float> one_, other_;
};

}  // namespace grasp
