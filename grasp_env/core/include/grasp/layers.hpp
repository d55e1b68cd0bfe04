// Learned Newton layers: each moves a balanced force inside the cones towards the optimum of Phi by the Newton step, shortened
// where it is long, plus what a perceptron on every contact adds. Where that does not lower Phi it is a plain Newton step.
//
// What a layer reads and says has no units and no frame: per contact p = u - s and q = u + s, s = |(o, t)|, the eigenvalues of P,
// change by p a and q b, and the tangential force across itself by c sqrt(p q). Weights are shared by the contacts, each of which
// also hears the mean of all. The torch twin, which trains them, is policies/newton_layers.py.
#pragma once
#include "network.hpp"
#include "system.hpp"

namespace grasp {

inline constexpr int LAYER_FEATURES = 11;  // numbers that a layer reads of each contact
inline constexpr double LAYER_REACH = 0.9;  // part of the way to the nearest cone that a layer goes at most
inline constexpr int MOST_LAYERS = 64;

// The weights of a few layers.
class Layers {
public:
    struct Layer { Dense first, own, mean, last; };  // the second stage reads a contact's hidden numbers, and their mean

    Layers() = default;  // none
    // flat: of each layer `numbers(width)`: stages FEATURES x width, 2 width x width, width x 3 (inputs x outputs), each with its
    // bias after it
    Layers(int count, int width, const float* flat) : width_(width) {
        for (int k = 0; k < count; ++k) {
            const float* second = flat + (LAYER_FEATURES + 1) * width;
            const float* last = second + (2 * width + 1) * width;
            layers_.push_back({{LAYER_FEATURES, width, flat, second - width},
                               {width, width, second, last - width},
                               {width, width, second + width * width, last - width},
                               {width, 3, last, last + 3 * width}});
            flat += numbers(width);
        }
    }

    // Weights and biases of one layer; 0: wider than the bound.
    static int numbers(int width) {
        return width < 1 || width > WIDEST ? 0 : (LAYER_FEATURES + 1) * width + (2 * width + 1) * width + 3 * width + 3;
    }

    void write(std::vector<float>& flat) const {
        for (const auto& [first, own, mean, last] : layers_) {
            first.write_weights(flat), first.write_bias(flat);
            own.write_weights(flat), mean.write_weights(flat), own.write_bias(flat);
            last.write_weights(flat), last.write_bias(flat);
        }
    }
    int count() const { return int(layers_.size()); }
    int width() const { return width_; }
    const Layer& operator[](int k) const { return layers_[k]; }

private:
    int width_ = 0;
    std::vector<Layer> layers_;
};

// Layers on the contacts of one grasp.
template <class V, int B> class LayersOn {
public:
    using Field = typename Cones<V, B>::Field;
    Layers layers;

    LayersOn(const Cones<V, B>& cones, const Layers& given)
        : layers(given), rows_((cones.count + ROWS - 1) / ROWS * ROWS), step_(cones.field()), said_(cones.field()) {
        resize(own_, cones.blocks.size());
        if (!layers.count()) return;
        const int wide = layers[0].first.padded();
        features_.assign(rows_ * LAYER_FEATURES, 0.0f), hidden_.resize(rows_ * wide), again_.resize(rows_ * wide);
        mean_.resize(wide), common_.resize(wide / FLOATS), outputs_.resize(rows_ * layers[0].last.padded());
    }

    // Moves x, balanced and strictly inside, by layers begin .. end - 1, each of which lowers Phi or is the last; returns Phi.
    // rest: the optimum without a wrench. settled: stop where the Newton decrement promises less than this relative gap.
    // nu: the multipliers of the last Newton step looked at, unit frame; second order in how far x was from the optimum before
    // it, they certify what it made; nan: none. Balance is lost to rounding alone: the caller's to take off.
    double refine(const Cones<V, B>& cones, System<V, B>& system, const Field& rest, double settled, int begin, int end, Field& x,
                  Vec6& nu) {
        double value = cones.phi(x);
        nu.fill(std::numeric_limits<double>::quiet_NaN());
        for (int k = begin; k < end && system.assemble(cones, x); ++k) {
            nu = system.multipliers(Vec6{});
            system.direction(cones, nu, step_);
            const auto [decrement, size] = look(cones, system, x);
            if (!(decrement > 2.0 * settled * value)) break;
            read(cones, rest, x, decrement / value, size);
            say(layers[k], cones.count);
            turn(cones, size / (1.0 + size));
            system.restore(cones, cones.wrench(said_), said_);
            const double share = 1.0 / std::sqrt(1.0 + size);
            for (int b = 0; b < int(x.size()); ++b) said_[b] += all<V>(share) * step_[b];
            if (!move(cones, said_, HALVINGS, x, value) && !move(cones, step_, 4 * HALVINGS, x, value)) break;
        }
        return value;
    }

    // What layer k says (N, 3) of the features (N, LAYER_FEATURES): for tests.
    void perceptron(int k, int count, const float* features, float* out) {
        std::copy(features, features + count * LAYER_FEATURES, features_.data());
        say(layers[k], count);
        for (int i = 0; i < 3 * count; ++i) out[i] = outputs_[layers[k].last.padded() * (i / 3) + i % 3];
    }

private:
    static constexpr int ROWS = 4;  // contacts per pass over the weights
    static constexpr int HALVINGS = 3;  // of a learned step that does not lower Phi, before a plain one is tried
    static constexpr double SMALLEST = 1e-24;  // of s^2, below which a force has no direction of its own
    static constexpr double SHORTEST = 1e-12;  // added to what a logarithm is taken of

    // A contact's coordinates at x: p, q, sqrt(p q) and the direction of the tangential force.
    struct Own {
        V p, q, root, cos, sin;

        explicit Own(const Vec3<V>& x) {
            const V square = x.o * x.o + x.t * x.t, s = sqrt(square + SMALLEST);
            q = x.u + s, p = lorentz(x, x) / q, root = sqrt(p * q);
            cos = square > SMALLEST ? x.o / s : all<V>(1.0), sin = square > SMALLEST ? x.t / s : V{};
        }
        Own() = default;
        // a move as (a, b, c), and back
        Vec3<V> relative(const Vec3<V>& move) const {
            const V along = cos * move.o + sin * move.t, across = cos * move.t - sin * move.o;
            return {(move.u - along) / p, (move.u + along) / q, across / root};
        }
        Vec3<V> absolute(const Vec3<V>& part) const {
            const V dp = p * part.u, dq = q * part.o, across = root * part.t, along = 0.5 * (dq - dp);
            return {0.5 * (dp + dq), along * cos - across * sin, along * sin + across * cos};
        }
    };

    int rows_;
    Blocks<Own, B> own_;
    Field step_, said_;  // the Newton step; what the perceptron adds, then the layer's step
    std::vector<float> features_, hidden_, again_, mean_, outputs_;
    std::vector<Floats> common_;

    struct Seen { double decrement, size; };  // squared Newton decrement; sum of squares of the relative step

    Seen look(const Cones<V, B>& cones, const System<V, B>& system, const Field& x) {
        V decrement{}, size{};
        for (int b = 0; b < int(x.size()); ++b) {
            own_[b] = Own(x[b]);
            const Vec3<V> part = own_[b].relative(step_[b]);
            decrement -= dot(step_[b], system.gradient[b]), size += cones.blocks[b].mask * dot(part, part);
        }
        return {sum(decrement), sum(size)};
    }

    static V squash(const V& v) { return v / sqrt(1.0 + abs(v)); }

    void read(const Cones<V, B>& cones, const Field& rest, const Field& x, double relative, double size) {
        const float one = 0.2f * std::log(float(relative + SHORTEST)), two = 0.2f * std::log(float(size + SHORTEST));
        for (int b = 0; b < int(x.size()); ++b) {
            const Own& own = own_[b];
            const auto& weights = cones.blocks[b].weights;
            const V unit = sqrt(weights.lambda / weights.omega);
            const Vec3<V> step = own.relative(step_[b]), there = own.relative(rest[b]);
            const V told[] = {own.p / unit,   own.q / unit,    squash(step.u),  squash(step.o),
                              squash(step.t), squash(there.u), squash(there.o), squash(there.t)};
            for (int n = 0; n < width<V> && width<V> * b + n < cones.count; ++n) {
                float* to = &features_[(width<V> * b + n) * LAYER_FEATURES];
                for (int i = 0; i < 8; ++i) to[i] = float(get(told[i], n));
                to[0] = 0.5f * std::log(to[0]), to[1] = 0.5f * std::log(to[1]);
                to[8] = one, to[9] = two, to[10] = float(cones.count - 4);
            }
        }
    }

    // The perceptron, from features_ to outputs_.
    void say(const Layers::Layer& layer, int count) {
        const int wide = layer.first.padded();
        for (int k = 0; k < rows_; k += ROWS)
            layer.first.template operator()<ROWS, true>(&features_[k * LAYER_FEATURES], LAYER_FEATURES, layer.first.bias(),
                                                        &hidden_[k * wide]);
        const float share = 1.0f / float(count);
        for (int j = 0; j < wide; j += FLOATS) {
            Floats total{};
            for (int k = 0; k < count; ++k) total += load_floats(&hidden_[k * wide + j]);
            total *= share;
            __builtin_memcpy(&mean_[j], &total, sizeof total);
        }
        layer.mean.template operator()<1, false>(mean_.data(), 0, layer.mean.bias(), reinterpret_cast<float*>(common_.data()));
        for (int k = 0; k < rows_; k += ROWS) {
            layer.own.template operator()<ROWS, true>(&hidden_[k * wide], wide, common_.data(), &again_[k * wide]);
            layer.last.template operator()<ROWS, false>(&again_[k * wide], wide, layer.last.bias(),
                                                        &outputs_[k * layer.last.padded()]);
        }
    }

    // said_ = the outputs as a change of x, as far as they are trusted.
    void turn(const Cones<V, B>& cones, double trust) {
        const int wide = layers[0].last.padded();
        for (int b = 0; b < int(said_.size()); ++b) {
            Vec3<V> part{V{}, V{}, V{}};
            for (int n = 0; n < width<V> && width<V> * b + n < cones.count; ++n)
                for (int a = 0; a < 3; ++a) set(part[a], n, trust * outputs_[wide * (width<V> * b + n) + a]);
            said_[b] = own_[b].absolute(part);
        }
    }

    // x moves along a step, LAYER_REACH of the way to the nearest cone at most, halved until Phi falls; false where it does not.
    static bool move(const Cones<V, B>& cones, const Field& step, int halvings, Field& x, double& value) {
        const double reach = cones.reach(x, step);
        double theta = reach > 0.0 ? std::min(1.0, LAYER_REACH / reach) : 1.0;
        for (int halving = 0; halving <= halvings; ++halving, theta *= 0.5) {
            const double found = cones.phi_along(x, step, theta);
            if (!(found < value)) continue;
            for (int b = 0; b < int(x.size()); ++b) x[b] += all<V>(theta) * step[b];
            value = found;
            return true;
        }
        return false;
    }
};

}  // namespace grasp
