// Starts predicted by a network. For any weights, the solver balances them and brings them inside
// the cones, with Phi no larger than at the method's default start.
#pragma once
#include <grasp/learned/network.hpp>
#include <grasp/phi/cones.hpp>

namespace grasp {

// Number of a network's inputs besides lengths: direction and logarithm of the wrench, friction.
inline constexpr int PLAIN_FEATURES = 8;

// Scaling of a network's features, as in policies/features.py.
struct Normalisation {
  double floor, smoothing, log_mean, log_scale, friction_mean, friction_scale;

  // True if all divisors are positive and all numbers finite.
  bool good() const {
    for (const double positive : {floor, log_scale, friction_scale})
      if (!(positive > 0.0 && positive < infinity)) return false;
    return smoothing >= 0.0 && smoothing < infinity && std::abs(log_mean) < infinity &&
           std::abs(friction_mean) < infinity;
  }
};

// A trained model for given contacts: a network from the wrench to internal forces.
struct Model {
  Network network;
  // One stage, 6 to 2 M numbers: M vectors along the surfaces from the wrench's direction; their
  // lengths are features.
  Network pairs;
  Normalisation normalisation{};
  double friction = 0.0;  // of the contacts
  // sqrt(lambda / omega) relative to that of training: the only unit of force in Phi
  double scale = 1.0;
  // (3N, 3N - 6) internal forces [N], the basis of the network's outputs
  std::vector<double> null_space;
  // size of the largest training wrench [N], unit frame; negative: none is covered
  double largest = -1.0;

  // True if the parts fit together and to this number of contacts.
  bool fits(int count) const {
    const std::size_t size = 3 * count;
    const std::size_t outputs = network.outputs();
    return whole() && size >= 6 && outputs == size - 6 && null_space.size() == size * outputs &&
           scale > 0.0;
  }
  bool whole() const {
    return pairs.sizes().size() == 2 && pairs.inputs() == 6 &&
           2 * (network.inputs() - PLAIN_FEATURES) == pairs.outputs();
  }
  // True if training covered a wrench (unit frame) of this size, and contacts and friction like
  // these.
  bool covers(const Vec6& w) const { return dot(w, w) <= largest * std::abs(largest); }
  // Predict the internal force for a wrench (unit frame), as coordinates (3N - 6,) [N] in
  // `null_space`.
  template <class Out> void predict(const Vec6& w, Out&& coordinates) {
    const Normalisation& by = normalisation;
    const double unit = 1.0 / scale;
    const double square = unit * unit * dot(w, w) + by.floor * by.floor;
    const double size = std::sqrt(square);
    const int lengths = pairs.outputs() / 2;
    const float smooth = float(by.smoothing * by.smoothing);
    float features[WIDEST];
    for (int r = 0; r < 6; ++r) features[r] = float(w[r] * (unit / size));
    features[6] = float((0.5 * std::log(square) - by.log_mean) / by.log_scale);
    const float* o = pairs(features);
    const float* t = o + lengths;
    for (int k = 0; k < lengths; ++k)
      features[7 + k] = __builtin_sqrtf(o[k] * o[k] + t[k] * t[k] + smooth);
    features[7 + lengths] = float((friction - by.friction_mean) / by.friction_scale);
    const float* outputs = network(features);
    for (std::size_t k = 0; k < std::size(coordinates); ++k)
      coordinates[k] = size * scale * outputs[k];
  }
};

// The predictions of a model for wrenches on fixed contacts.
template <class V, int B> class Prediction {
 public:
  using Field = typename Cones<V, B>::Field;

  Prediction(const Cones<V, B>& cones, const Model& model)
      : model_(model), space_(3 * cones.count - 6), weights_(space_.size()) {
    const int size = 3 * cones.count;
    const int columns = int(space_.size());
    std::vector<double> column(size);
    for (int k = 0; k < columns; ++k) {
      for (int j = 0; j < size; ++j) column[j] = model.null_space[columns * j + k];
      for (auto& v : space_[k] = cones.field()) v = {V{}, V{}, V{}};
      cones.load_force(column.data(), space_[k]);
      cones.balance(space_[k], Vec6{});  // no change if the model's columns are internal forces
    }
  }

  bool covers(const Vec6& w) const { return model_.covers(w); }

  // x += the internal force predicted for w (unit frame).
  void add(const Vec6& w, Field& x) {
    model_.predict(w, weights_);
    for (int b = 0; b < int(x.size()); ++b) {
      Vec3<V> even = x[b];
      Vec3<V> odd{V{}, V{}, V{}};
      int k = 0;
      for (; k + 1 < int(space_.size()); k += 2) {
        even += all<V>(weights_[k]) * space_[k][b];
        odd += all<V>(weights_[k + 1]) * space_[k + 1][b];
      }
      if (k < int(space_.size())) even += all<V>(weights_[k]) * space_[k][b];
      x[b] = even + odd;
    }
  }

 private:
  Model model_;
  std::vector<Field> space_;  // columns of the null space, cone coordinates
  std::vector<double> weights_;
};

}  // namespace grasp
