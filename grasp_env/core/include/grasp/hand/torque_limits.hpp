// The motors' limits on the forces of some fingers: what is left of them beside other torques, and Newton within that.
#pragma once
#include <grasp/hand/pipeline.hpp>
#include <grasp/hand/tree.hpp>
#include <grasp/terms/force_limits.hpp>
#include <grasp/terms/limited.hpp>

namespace grasp {

// Newton on Phi within limits on each contact's force, of contacts that move; see `LimitedOn`.
class alignas(64) LimitedNewton {
public:
    Contacts contacts;  // the current ones

    // basis: (13, 3N) the offline optima, cone coordinates
    static std::unique_ptr<LimitedNewton> make(const Contacts& contacts, const Stop& options, const double* basis);
    virtual ~LimitedNewton() = default;
    // The contacts and their limits are now these, a little away from those of the basis. Allocates nothing where each contact had
    // as many rows before. Unless `good`, nothing may be solved before it is called again.
    virtual Placing move(const double* positions, const double* normals, const LimitRows& rows) = 0;
    virtual Code solve(const Call& call, double* row) = 0;

protected:
    explicit LimitedNewton(const Contacts& contacts) : contacts(contacts) {}
};

namespace detail {

template <class V, int B> class LimitedAny final : public LimitedNewton {
public:
    LimitedAny(const Contacts& contacts, const Stop& options, const double* basis)
        : LimitedNewton(contacts), on_(contacts.count, options) {
        on_.newton.cones.pack(contacts);
        on_.newton.starter.set_basis(on_.newton.cones, basis, contacts.frames.data());
        on_.elastic = true;
    }
    Placing move(const double* positions, const double* normals, const LimitRows& rows) override {
        auto& newton = on_.newton;
        const Placing placed = contacts.place(positions, normals);
        if (placed != Placing::good) return placed;
        newton.cones.pack(contacts);
        newton.rows.pack(newton.cones, rows);
        newton.starter.tangents.load(contacts.frames.data(), contacts.count);
        newton.starter.moved = true;
        return placed;
    }
    Code solve(const Call& call, double* row) override {
        const auto begin = [&](const Vec6& w, bool previous) {
            Call own = call;
            if (!previous && call.start != From::given) own.start = From::combination;
            return on_.newton.begin(own, w);
        };
        return on_.solve(call, Record(row, contacts.count), begin);
    }

private:
    LimitedOn<V, B> on_;
};

}  // namespace detail

inline std::unique_ptr<LimitedNewton> LimitedNewton::make(const Contacts& contacts, const Stop& options, const double* basis) {
    return instance<LimitedNewton, detail::LimitedAny>(contacts.count, contacts, options, basis);
}

// The fingers of one set and their joints, M of the hand.
class TorqueLimits {
public:
    int iterations = 0;      // of all solves
    bool shares = false;     // a joint moves several of the fingers: `solve` keeps the limits of the others only

    // pipeline: on the nominal contacts of the fingers; tolerance and limit as of `Stop`
    TorqueLimits(std::shared_ptr<const Tree> tree, const std::vector<int>& fingers, Pipeline& pipeline, const Stop& options)
        : tree_(std::move(tree)), fingers_(fingers),
          newton_(LimitedNewton::make(pipeline.contacts(), options, pipeline.held().basis.data())),
          row_(record_size(int(fingers.size()))), last_(3 * fingers.size()), own_(tree_->joints(), -1) {
        const std::vector<int> users = tree_->users(fingers_);
        for (int j = 0; j < tree_->joints(); ++j) {
            shares = shares || users[j] > 1;
            if (users[j] != 1) continue;
            own_[j] = int(limit_.size());
            limit_.push_back(tree_->links[j].torque_limit);
        }
        bias_.resize(limit_.size()), jacobian_.resize(3 * fingers_.size() * limit_.size());
    }

    // Whether torques (M,) [N m] are within the limits of all joints.
    static bool within(const Tree& tree, const std::vector<double>& torques) {
        for (int j = 0; j < tree.joints(); ++j)
            if (!(std::abs(torques[j]) <= tree.links[j].torque_limit)) return false;
        return true;
    }

    // What the forces are made with: touch (N,) [m], world, of all fingers; rotation: object frame to world frame; frames: (N, 3, 3)
    // columns (n, o, t), object frame; bias: (M,) torques besides [N m].
    struct Reached {
        const Posture& posture;
        const std::vector<Point>& touch;
        const Rotation& rotation;
        const std::vector<double>& frames;
        const std::vector<double>& bias;
    };

    // From forces (3n,) [N], contact frames, that exceed limits: the optimum within them, or where no force keeps them the one that
    // exceeds them least. False: neither was found, and the forces stay. again: `solve` made the forces of the last tick.
    bool solve(const Load& load, const Reached& at, bool again, double* force) {
        fill(at);
        const ForceLimits limits{.jacobian = jacobian_, .torque_limit = limit_, .torque_bias = bias_};
        auto& newton = *newton_;
        if (!table_.fill(newton.contacts, limits) || newton.move(load.points, load.normals, table_.rows()) != Placing::good)
            return false;
        const Record record(row_.data(), int(fingers_.size()));
        const auto run = [&](const Call& call) {
            const Code code = newton.solve(call, row_.data());
            iterations += int(record.summary().iterations);
            exceeding_ = code == LIMITS_EXCEEDED;
            return code == CONVERGED || code == LIMIT || code == LIMITS_EXCEEDED;
        };
        const bool found =
            (again && run({.wrench = load.wrench, .start = From::tangent, .force = last_.data(), .exceeding = exceeding_})) ||
            (!again && run({.wrench = load.wrench, .start = From::given, .force = force})) || run({.wrench = load.wrench});
        if (!found) return false;
        std::copy_n(record.force(), last_.size(), force);
        std::copy_n(record.force(), last_.size(), last_.data());
        return true;
    }

private:
    std::shared_ptr<const Tree> tree_;
    std::vector<int> fingers_;
    std::unique_ptr<LimitedNewton> newton_;
    LimitTable table_;
    std::vector<double> row_, last_;  // a record; the last forces (3n,)
    bool exceeding_ = false;  // whether those exceed limits
    std::vector<int> own_;  // (M,) which of `limit_` a joint has, -1: none
    std::vector<double> limit_, bias_, jacobian_;  // (J,), (J,), (n, 3, J): joints that move one finger alone

    void fill(const Reached& at) {
        const std::size_t joints = limit_.size();
        std::fill(jacobian_.begin(), jacobian_.end(), 0.0);
        for (std::size_t a = 0; a < fingers_.size(); ++a) {
            const int i = fingers_[a];
            at.posture.carriers(tree_->tips[i].link, at.touch[i], [&](int j, const Point& moves) {
                if (own_[j] < 0) return;
                const Point there = at.rotation.transposed(moves);
                for (int k = 0; k < 3; ++k) {
                    const double* f = &at.frames[9 * i + k];
                    jacobian_[joints * (3 * a + k) + own_[j]] += f[0] * there.u + f[3] * there.o + f[6] * there.t;
                }
            });
        }
        for (int j = 0; j < tree_->joints(); ++j)
            if (own_[j] >= 0) bias_[own_[j]] = at.bias[j];
    }
};

}  // namespace grasp
