// Starts that a network predicts. Whatever the weights say, the engine balances them and brings them inside the cones, with no more Phi than
// the method's own start has.
#pragma once
#include <grasp/learned/network.hpp>
#include <grasp/contacts/cones.hpp>

namespace grasp {

// Numbers that a network reads besides lengths: the wrench's direction, its logarithm, the friction.
inline constexpr int PLAIN_FEATURES = 8;

// How a network's features are made, as policies/features.py says.
struct Normalisation {
    double floor, smoothing, log_mean, log_scale, friction_mean, friction_scale;

    // Whether what is divided by may be.
    bool good() const {
        for (const double positive : {floor, log_scale, friction_scale})
            if (!(positive > 0.0 && positive < infinity)) return false;
        return smoothing >= 0.0 && smoothing < infinity && std::abs(log_mean) < infinity && std::abs(friction_mean) < infinity;
    }
};

// A trained model on contacts as they are now: a network from the wrench to internal forces.
struct Model {
    Network network;
    Network
        pairs;  // one stage, 6 to 2 M numbers: of the wrench's direction M vectors along the surfaces, whose lengths are features
    Normalisation normalisation{};
    double friction = 0.0;  // of the contacts
    double scale = 1.0;  // sqrt(lambda / omega) over that of training: Phi knows forces in that unit only
    std::vector<double> null_space;  // (3N, 3N - 6) the internal forces [N] that the network's outputs stand for
    double largest = -1.0;  // size of the training's wrenches [N], unit frame; negative: none is covered

    // Whether the parts belong together, and to so many contacts.
    bool fits(int count) const {
        const std::size_t size = 3 * count, outputs = network.outputs();
        return whole() && size >= 6 && outputs == size - 6 && null_space.size() == size * outputs && scale > 0.0;
    }
    bool whole() const {
        return pairs.sizes().size() == 2 && pairs.inputs() == 6 && 2 * (network.inputs() - PLAIN_FEATURES) == pairs.outputs();
    }
    // Whether a wrench (unit frame) is no larger than those of training, and contacts and friction are like them.
    bool covers(const Vec6& w) const { return dot(w, w) <= largest * std::abs(largest); }
    // The internal force that the network predicts for a wrench (unit frame), as coordinates (3N - 6,) [N] of `null_space`.
    template <class Out> void predict(const Vec6& w, Out&& coordinates) {
        const Normalisation& by = normalisation;
        const double unit = 1.0 / scale, square = unit * unit * dot(w, w) + by.floor * by.floor, size = std::sqrt(square);
        const int lengths = pairs.outputs() / 2;
        const float smooth = float(by.smoothing * by.smoothing);
        float features[WIDEST];
        for (int r = 0; r < 6; ++r) features[r] = float(w[r] * (unit / size));
        features[6] = float((0.5 * std::log(square) - by.log_mean) / by.log_scale);
        const float *o = pairs(features), *t = o + lengths;
        for (int k = 0; k < lengths; ++k) features[7 + k] = __builtin_sqrtf(o[k] * o[k] + t[k] * t[k] + smooth);
        features[7 + lengths] = float((friction - by.friction_mean) / by.friction_scale);
        const float* said = network(features);
        for (std::size_t k = 0; k < std::size(coordinates); ++k) coordinates[k] = size * scale * said[k];
    }
};

// What a model says of wrenches on contacts in one place.
template <class V, int B> class Prediction {
public:
    using Field = typename Cones<V, B>::Field;

    Prediction(const Cones<V, B>& cones, const Model& model)
        : model_(model), space_(3 * cones.count - 6), weights_(space_.size()) {
        const int size = 3 * cones.count, columns = int(space_.size());
        std::vector<double> column(size);
        for (int k = 0; k < columns; ++k) {
            for (int j = 0; j < size; ++j) column[j] = model.null_space[columns * j + k];
            for (auto& v : space_[k] = cones.field()) v = {V{}, V{}, V{}};
            cones.load_force(column.data(), space_[k]);
            cones.balance(space_[k], Vec6{});  // nothing at all where the model's are internal forces
        }
    }

    bool covers(const Vec6& w) const { return model_.covers(w); }

    // x += the internal force that the network predicts for w (unit frame)
    void add(const Vec6& w, Field& x) {
        model_.predict(w, weights_);
        for (int b = 0; b < int(x.size()); ++b) {
            Vec3<V> even = x[b], odd{V{}, V{}, V{}};
            int k = 0;
            for (; k + 1 < int(space_.size()); k += 2)
                even += all<V>(weights_[k]) * space_[k][b], odd += all<V>(weights_[k + 1]) * space_[k + 1][b];
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
