// Starts that a network predicts, and Newton from them in the same call. Whatever the weights say, a start is balanced, strictly
// inside the cones, and has no more Phi than the paper's combination, nor than the previous solution where one is given.
#pragma once
#include <grasp/learned/network.hpp>
#include <grasp/phi/newton.hpp>

namespace grasp {

inline constexpr int NETWORK_FEATURES = 8;  // numbers that a network reads: the wrench's direction, its logarithm, the friction

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

// A trained model on contacts as they are now: a network from the wrench to internal forces.
struct Model {
    Network network;
    Normalisation normalisation{};
    double friction = 0.0;  // of the contacts
    double scale = 1.0;  // sqrt(lambda / omega) over that of training: Phi knows forces in that unit only
    std::vector<double> null_space;  // (3N, 3N - 6) the internal forces [N] that the network's outputs stand for
    double largest =
        -1.0;  // size of the training's wrenches [N], moments over the normalisation's length; negative: none is covered

    // Whether the parts belong together, and to so many contacts.
    bool fits(int count) const {
        const std::size_t size = 3 * count, outputs = network.outputs();
        return network.inputs() == NETWORK_FEATURES && size >= 6 && outputs == size - 6 && null_space.size() == size * outputs &&
               scale > 0.0;
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
        }
    }

    // Whether a wrench is no larger than those of training, and contacts and friction are like them.
    bool covers(const double* wrench) const {
        double square = 0.0;
        for (int r = 0; r < 6; ++r) {
            const double part = r < 3 ? wrench[r] : wrench[r] / model_.normalisation.length;
            square += part * part;
        }
        return square <= model_.largest * std::abs(model_.largest);
    }

    // x += the internal force that the network predicts
    void add(const double* wrench, Field& x) {
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
            Vec3<V> even = x[b], odd{V{}, V{}, V{}};
            int k = 0;
            for (; k + 1 < int(space_.size()); k += 2)
                even += all<V>(weights_[k]) * space_[k][b], odd += all<V>(weights_[k + 1]) * space_[k + 1][b];
            if (k < int(space_.size())) even += all<V>(weights_[k]) * space_[k][b];
            x[b] = even + odd;
        }
    }
    // x = the whole force: the least that balances the wrench (w: unit frame) and what `add` adds; perhaps outside the cones
    void force(const Cones<V, B>& cones, const double* wrench, const Vec6& w, Field& x) {
        for (int b = 0; b < int(x.size()); ++b) x[b] = -cones.blocks[b].least(w);
        add(wrench, x);
    }

private:
    Model model_;
    std::vector<Field> space_;  // columns of the null space, cone coordinates
    std::vector<double> weights_;
};

template <class V, int B> class LearnedOn {
public:
    using Field = typename Cones<V, B>::Field;
    NewtonOn<V, B> newton;
    bool outside = false;  // whether the last wrench was not covered
    bool replaced = false;  // whether nothing of what the network said of it was kept: the combination was taken

    // basis: (13, 3N) the offline optima of the contacts
    LearnedOn(const Contacts& contacts, const Stop& options, const double* basis, const Model& model)
        : newton(contacts.count, options), predicted_(packed(contacts), model), safe_(newton.cones.field()),
          guess_(newton.cones.field()), begun_(newton.cones.field()) {
        newton.starter.set_basis(newton.cones, basis);
    }

    // The start into a record: LIMIT, for a descent has to go on from it; REFUSED: numbers that are not finite.
    // previous: (3N,) an optimum of another wrench [N], or null.
    Code start(const double* wrench, const double* previous, const Record& record) {
        Vec6 w;
        if (!begun(wrench, previous, w, record)) return REFUSED;
        Summary& s = record.summary();
        s.code = LIMIT, s.iterations = s.trials = 0.0, s.objective = newton.cones.phi(newton.x), s.lower_bound = -infinity;
        s.limit_excess = 0.0, s.multipliers.fill(0.0);
        std::copy(wrench, wrench + 6, s.wrench.begin());
        std::fill(record.torsion(), record.torsion() + newton.cones.count, 0.0);
        newton.cones.certify(newton.x, w, record);
        std::copy(record.force(), record.initial_force(), record.initial_force());
        return LIMIT;
    }

    // The start, and Newton from it.
    Code solve(const double* wrench, const double* previous, const Record& record) {
        Vec6 w;
        if (!begun(wrench, previous, w, record)) return REFUSED;
        const Call call{.wrench = wrench, .start = From::given};
        begun_ = newton.x;
        const Code code = newton.descend_from(begun_, call, w, record);
        if (code != STALLED) return code;
        replaced = true;
        newton.x = safe_;  // the paper's way, once more
        return newton.descend_from(safe_, call, w, record);
    }

    // The best of the combination, the network's force and the previous optimum, in newton.x; false: numbers out of range.
    // w: the wrench in the unit frame.
    bool begin(const double* wrench, const double* previous, const Vec6& w) {
        auto& cones = newton.cones;
        auto& starter = newton.starter;
        outside = !covers(wrench);
        starter.combine(wrench, safe_);
        double value = cones.phi(safe_);
        Field& x = newton.x;
        predicted_.force(cones, wrench, w, x);
        const double said = cones.phi(x);
        // not only where it is outside: a start is never worse than the combination
        const double share = said <= value ? 1.0 : starter.segment(cones, safe_, x);
        const bool kept = share > 0.0;
        replaced = !kept && dot(w, w) > 0.0;  // without a wrench the combination is the optimum
        if (kept) value = said <= value ? said : cones.phi(x);
        if (previous) {
            guess_ = x;
            cones.load_force(previous, x);
            bool better = cones.phi(x) < infinity;
            if (better) {
                starter.carry(cones, newton.system, safe_, w, From::tangent, x);
                better = cones.phi(x) < value;
            }
            if (better) replaced = false;
            else x = guess_;
        }
        return value < infinity;
    }

    bool covers(const double* wrench) const { return predicted_.covers(wrench); }

    // The network's own force (3N,) [N]: balanced, perhaps outside the cones.
    bool predict(const double* wrench, double* force) {
        if (!sane_wrench(wrench)) return false;
        predicted_.force(newton.cones, wrench, newton.cones.unit.of(wrench), guess_);
        newton.cones.store_force(guess_, force);
        return true;
    }

private:
    // `begin` and the wrench in the unit frame; false, and REFUSED in the record: numbers out of range.
    bool begun(const double* wrench, const double* previous, Vec6& w, const Record& record) {
        record.summary().code = REFUSED;
        if (!sane_wrench(wrench)) return false;
        w = newton.cones.unit.of(wrench);
        return begin(wrench, previous, w);
    }

    Prediction<V, B> predicted_;
    Field safe_, guess_, begun_;  // the combination; what the network says; where a descent begins

    const Cones<V, B>& packed(const Contacts& contacts) {
        newton.cones.pack(contacts);
        return newton.cones;
    }
};

}  // namespace grasp
