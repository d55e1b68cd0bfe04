// Learned starts, and Newton from them in the same call. Whatever the weights say, a start is balanced, strictly inside the
// cones, and has no more Phi than the paper's combination, nor than the previous solution where one is given.
#pragma once
#include "layers.hpp"
#include "newton.hpp"

namespace grasp {

inline constexpr int NETWORK_FEATURES = 8;  // numbers that a network reads: the wrench's direction, its logarithm, the friction
// Further layers are left out where the Newton decrement promises this part of the tolerance; without one, this relative gap.
inline constexpr double EASE = 0.1, SETTLED = 1e-7;

// How a network's features are made, as policies/features.py says.
struct Normalisation {
    double length, floor, log_mean, log_scale, friction_mean, friction_scale;

    // Whether what is divided by may be.
    bool good() const {
        for (const double positive : {length, floor, log_scale, friction_scale})
            if (!(positive > 0.0 && positive < infinity)) return false;
        return std::abs(log_mean) < infinity && std::abs(friction_mean) < infinity;
    }
};

// A trained model on contacts as they are now: a network from the wrench to internal forces, layers, or both.
struct Model {
    Network network;  // or none: the combination
    Normalisation normalisation{};
    double friction = 0.0;  // of the contacts
    double scale = 1.0;  // sqrt(lambda / omega) over that of training: Phi knows forces in that unit only
    std::vector<double> null_space;  // (3N, 3N - 6) the internal forces [N] that the network's outputs stand for
    Layers layers;  // or none
    UnitFrame trained;  // in which training measured wrenches,
    double largest = -1.0;  // and their largest size there [N]; negative: nothing is inside

    // Whether the parts belong together, and to so many contacts.
    bool fits(int count) const {
        const std::size_t size = 3 * count, outputs = network.outputs();
        return network.empty() || (network.inputs() == NETWORK_FEATURES && size >= 6 && outputs == size - 6 &&
                                   null_space.size() == size * outputs && scale > 0.0);
    }
};

// How Newton layers refine a start until it is certified: what fixed contacts and moving ones share.
template <class V, int B> class Refiner {
public:
    using Field = typename Cones<V, B>::Field;
    LayersOn<V, B> layers;

    Refiner(const Cones<V, B>& cones, const Layers& given) : layers(cones, given), other_(cones.field()) {}

    struct Outcome {
        double value = infinity, bound = -infinity;  // Phi, and a lower bound of its minimum
        Vec6 nu{};  // multipliers of the bound, unit frame
        bool within(double tolerance) const { return bound > 0.0 && value - bound <= tolerance * bound; }
    };

    // x, balanced and strictly inside, becomes what the layers make of it. Where that is not certified and `other` is given, they
    // begin from there too, and the better is kept: close to a cone they may get less far from a force with less Phi.
    // each: a certificate after every layer, not after the last.
    Outcome operator()(const Cones<V, B>& cones, System<V, B>& system, const Field& rest, const Vec6& w, double tolerance,
                       bool each, const Field* other, Field& x) {
        Outcome found = refined(cones, system, rest, w, tolerance, each, x);
        if (!other || found.within(tolerance)) return found;
        other_ = *other;
        const Outcome second = refined(cones, system, rest, w, tolerance, each, other_);
        const double value = std::min(found.value, second.value);
        if (second.value < found.value) x = other_;
        if (second.bound > found.bound) found = second;
        found.value = value;
        return found;
    }

private:
    Field other_;

    Outcome refined(const Cones<V, B>& cones, System<V, B>& system, const Field& rest, const Vec6& w, double tolerance, bool each,
                    Field& x) {
        const double settled = tolerance > 0.0 ? EASE * tolerance : SETTLED;
        const int count = layers.layers.count(), together = each ? 1 : count;
        Outcome out;
        for (int begin = 0; begin < count && !out.within(tolerance); begin += together) {
            layers.refine(cones, system, rest, settled, begin, std::min(begin + together, count), x, out.nu);
            cones.balance(x, w);  // what rounding left
            out.value = cones.phi(x), out.bound = cones.lower_bound(out.nu, w);
            if (!(out.bound > -infinity)) out.nu.fill(0.0);
        }
        return out;
    }
};

template <class V, int B> class LearnedOn {
public:
    using Field = typename Cones<V, B>::Field;
    NewtonOn<V, B> newton;
    bool outside = false;  // whether the last wrench was not covered

    // basis: (13, 3N) the offline optima of the contacts
    LearnedOn(const Contacts& contacts, const Options& options, const double* basis, const Model& model)
        : newton(contacts.count, options), model_(model), refiner_(newton.cones, model.layers),
          space_(std::max(0, 3 * contacts.count - 6)), safe_(newton.cones.field()), guess_(newton.cones.field()),
          begun_(newton.cones.field()), weights_(space_.size()) {
        auto& cones = newton.cones;
        cones.pack(contacts);
        const int size = 3 * contacts.count, columns = int(space_.size());
        for (int k = 0; k < 13; ++k) cones.load(basis + size * k, newton.starter.basis[k]);
        newton.starter.has_basis = true;
        std::vector<double> column(size);
        for (int k = 0; k < columns && !model.network.empty(); ++k) {
            for (int j = 0; j < size; ++j) column[j] = model.null_space[columns * j + k];
            for (auto& v : space_[k] = cones.field()) v = {V{}, V{}, V{}};
            cones.load_force(column.data(), space_[k]);
        }
    }

    // The start into a record: CONVERGED where it is certified within the tolerance; LIMIT: a descent has to go on from the
    // initial force in it; REFUSED: numbers that are not finite. previous: (3N,) an optimum of another wrench [N], or null.
    Code start(const double* wrench, const double* previous, const Record& record) {
        Vec6 w;
        if (!begin(wrench, previous, w, record)) return REFUSED;
        return write(wrench, w, polish(w), record);
    }

    // The start, and Newton from it unless it is certified already.
    Code solve(const double* wrench, const double* previous, const Record& record) {
        Vec6 w;
        if (!begin_descent(wrench, previous, w, record)) return Code(int(record.summary().code));
        const Call call{.wrench = wrench, .start = Start::given};
        begun_ = newton.x;
        const Code code = newton.descend_from(begun_, call, w, record);
        if (code != STALLED) return code;
        newton.x = safe_;  // the paper's way, once more
        return newton.descend_from(safe_, call, w, record);
    }

    // The start that Newton goes on from, in newton.x, and the wrench in the unit frame; false where the record says it all.
    bool begin_descent(const double* wrench, const double* previous, Vec6& w, const Record& record) {
        if (!begin(wrench, previous, w, record)) return false;
        if (!model_.layers.count()) return true;
        const Outcome found = polish(w);
        if (!found.within(newton.options.tolerance)) return true;
        write(wrench, w, found, record);
        return false;
    }

    // Whether a wrench is no larger than those of training, and contacts and friction are like them.
    bool covers(const double* wrench) const {
        const Vec6 seen = model_.trained.of(wrench);
        return dot(seen, seen) <= model_.largest * std::abs(model_.largest);
    }

    // The network's own force (3N,) [N]: balanced, perhaps outside the cones; the combination where there is no network.
    bool predict(const double* wrench, double* force) {
        if (!sane_wrench(wrench)) return false;
        if (model_.network.empty()) newton.starter.combine(wrench, guess_);
        else guess(wrench, newton.cones.unit.of(wrench), guess_);
        newton.cones.store_force(guess_, force);
        return true;
    }

private:
    using Outcome = typename Refiner<V, B>::Outcome;
    Model model_;
    Refiner<V, B> refiner_;
    std::vector<Field> space_;  // columns of the null space, cone coordinates
    Field safe_, guess_, begun_;  // the combination; what the network says; where a descent begins
    std::vector<double> weights_;
    bool second_ = false;  // whether guess_ is another start, where newton.x is the previous optimum

    // The best of the combination, the network's force and the previous optimum, in newton.x.
    bool begin(const double* wrench, const double* previous, Vec6& w, const Record& record) {
        record.summary().code = REFUSED;
        if (!sane_wrench(wrench)) return false;
        auto& cones = newton.cones;
        auto& starter = newton.starter;
        w = cones.unit.of(wrench);
        outside = !covers(wrench);
        starter.combine(wrench, safe_);
        double value = cones.phi(safe_);
        Field& x = newton.x;
        if (model_.network.empty()) {
            x = safe_;
        } else {
            guess(wrench, w, x);
            const double said = cones.phi(x);
            // not only where it is outside: a start is never worse than the combination
            if (said <= value) value = said;
            else if (starter.segment(cones, safe_, x) > 0.0) value = cones.phi(x);
        }
        second_ = false;
        if (previous) {
            guess_ = x;
            cones.load_force(previous, x);
            if (cones.phi(x) < infinity) {
                starter.carry(cones, newton.system, safe_, w, Start::tangent, x);
                second_ = cones.phi(x) < value;
            }
            if (!second_) x = guess_;
        }
        return value < infinity;
    }

    Outcome polish(const Vec6& w) {
        if (!model_.layers.count()) return {.value = newton.cones.phi(newton.x)};
        const bool each = !model_.network.empty();  // a prediction is close: one layer is enough more often than not
        Outcome found = refiner_(newton.cones, newton.system, newton.starter.basis[12], w, newton.options.tolerance, each,
                                 second_ ? &guess_ : nullptr, newton.x);
        const double most = newton.cones.phi(safe_);
        if (!(found.value <= most)) newton.x = safe_, found.value = most;  // rounding only
        return found;
    }

    void guess(const double* wrench, const Vec6& w, Field& x) {
        const Normalisation& by = model_.normalisation;
        double parts[6], square = by.floor * by.floor;
        for (int r = 0; r < 6; ++r) {
            parts[r] = (r < 3 ? wrench[r] : wrench[r] / by.length) / model_.scale;
            square += parts[r] * parts[r];
        }
        const double size = std::sqrt(square);
        float features[NETWORK_FEATURES];
        for (int r = 0; r < 6; ++r) features[r] = float(parts[r] / size);
        features[6] = float((std::log(size) - by.log_mean) / by.log_scale);
        features[7] = float((model_.friction - by.friction_mean) / by.friction_scale);
        const float* said = model_.network(features);
        for (int k = 0; k < int(space_.size()); ++k) weights_[k] = size * model_.scale * said[k];
        for (int b = 0; b < int(x.size()); ++b) {
            Vec3<V> even = -newton.cones.blocks[b].least(w), odd{V{}, V{}, V{}};
            int k = 0;
            for (; k + 1 < int(space_.size()); k += 2)
                even += all<V>(weights_[k]) * space_[k][b], odd += all<V>(weights_[k + 1]) * space_[k + 1][b];
            if (k < int(space_.size())) even += all<V>(weights_[k]) * space_[k][b];
            x[b] = even + odd;
        }
    }

    Code write(const double* wrench, const Vec6& w, const Outcome& found, const Record& record) {
        const Code code = found.within(newton.options.tolerance) ? CONVERGED : LIMIT;
        Summary& s = record.summary();
        s.code = code, s.iterations = s.trials = 0.0, s.objective = found.value, s.lower_bound = found.bound,
        s.limit_excess = 0.0;
        s.multipliers = newton.cones.unit.pull_back(found.nu);
        std::copy(wrench, wrench + 6, s.wrench.begin());
        std::fill(record.torsion(), record.torsion() + newton.cones.count, 0.0);
        newton.cones.certify(newton.x, w, record);
        std::copy(record.force(), record.initial_force(), record.initial_force());
        return code;
    }
};

}  // namespace grasp
