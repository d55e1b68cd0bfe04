// The control loop of a hand: what it sees, the wrench to balance, forces that follow contacts and wrench between two optimisations,
// and the joint torques that make them.
#pragma once
#include <map>
#include <grasp/math/cholesky.hpp>
#include <grasp/hand/sensing.hpp>
#include <grasp/hand/torque_limits.hpp>

namespace grasp {

// Of a tip that is drawn to its place.
struct Spring { double gain = 0.0, damping = 0.0, limit = infinity; };  // [N/m], [N s/m], the most force [N]

struct ControlSettings {
    Body body;
    double friction = 0.5;  // that the solver believes in
    std::vector<Spring> reach;  // (N,) of each finger without contact, on its way
    Spring spring;  // of all fingers where nothing is optimised
    double reach_depth = 0.0;  // [m] inside the surface to which a finger reaches
    std::vector<Spring> posture;  // (M,) [N m/rad], [N m s/rad]: joints that the tips leave free
    Stop limited{};  // of Newton within the torque limits
    double most_change = infinity;  // [N] by which a force may change in one tick beyond what balance asks
    int release = 2;  // ticks without force after which a finger no longer counts as in contact
};

// What the motors were asked since `begin_step`.
struct Effort {
    int limited = 0;  // iterations of Newton within the torque limits
    bool saturated = false;  // torques had to be cut: no force within the limits balances the wrench, or none was found
    double margin = infinity;  // least distance of a torque from its limit [N m]
};

// What the fingers in contact do.
enum class Hold {
    optimised,  // carry the last optimum along
    squeeze,  // a constant internal force, and what balances
    place,  // no force: every finger holds its place
    direct,  // given forces
    lost,  // no force closure: given forces, balanced as far as the cones let them
};

class Controller {
public:
    const std::shared_ptr<const Scene> scene;
    const std::shared_ptr<const Tree> tree;
    const ControlSettings settings;
    Sensors sensors;
    Vec6 wrench{};  // that is balanced [N, N m], object frame
    std::vector<double> torques;  // (M,) [N m]
    std::vector<double> force;  // (N, 3) commanded [N], contact frames
    std::vector<double> frames;  // (N, 3, 3) these, columns (n, o, t), object frame
    std::vector<double> depths;  // (N,) [m] inside the surface of the places that fingers hold where nothing is optimised
    std::vector<double> home;  // (M,) rest posture [rad]
    std::vector<Point> goals, inwards;  // (N,) the grasp's contact points [m] and inward normals, object frame
    double peak = 0.0;  // largest |torque| since `reset` [N m]
    int repaired = 0;  // ticks in which forces had to be brought back into the cones
    std::uint64_t mask = 0;  // the fingers that count as in contact
    int changes = 0;  // how often they changed
    bool changed = false;  // since forces were last given
    bool unkept = false;  // the last forces exceed the limit of a joint that fingers share, which is left to the caller
    Effort effort;

    Controller(std::shared_ptr<const Scene> given, const ControlSettings& settings, const SensorSettings& sensing)
        : scene(std::move(given)), tree(scene->tree), settings(settings), sensors(scene, sensing), torques(tree->joints()),
          force(3 * tree->fingers()), frames(9 * tree->fingers()), depths(tree->fingers()), home(torques), goals(tree->fingers()),
          inwards(goals), apart_(tree->fingers()), before_(force), frames_before_(frames), points_(force), normals_(force),
          given_(force), solved_(force), kept_(force), then_(frames), pull_(torques), extra_(torques), trial_(torques),
          torsion_(tree->fingers()), push_(force), jacobian_(force.size() * torques.size()), normal_(int(force.size())),
          columns_(force.size()), redundant_(is_redundant(*tree)) {}

    // Forgets the episode; before it the scene stood still.
    void reset() {
        std::fill(torques.begin(), torques.end(), 0.0);
        std::fill(force.begin(), force.end(), 0.0);
        std::fill(frames.begin(), frames.end(), 0.0);
        wrench = {}, peak = 0.0, repaired = 0, mask = 0, changes = 0;
        begin_step();
        changed = unkept = missing_ = false, fresh_ = true, hold_ = Hold::optimised, set_ = nullptr;
        std::fill(apart_.begin(), apart_.end(), 0);
        sensors.reset();
    }

    struct Known {
        Point gravity;  // [m/s^2], world
        Target target;
    };
    // What is known at this control tick, and the wrench to balance; call before `give` and `command`. See `Sensors::see`.
    void see(const double* external, const double* noise, const Known& known) {
        sensors.see(external, noise, settings.body, known.gravity);
        target_ = known.target;
        wrench = sensors.external + settings.body.wrench(seen(), target_, known.gravity);
        count_contacts();
    }
    const Snapshot& seen() const { return sensors.seen(); }

    // An agent's step begins.
    void begin_step() { effort = {}; }

    // What fingers in contact carry: those of a set, with the pipeline, on its nominal contacts, that has their last optimum, or none.
    void add_set(std::uint64_t which, Pipeline* pipeline) {
        Set made{fingers_of(which), pipeline, {}};
        if (pipeline) made.limits.emplace(tree, made.fingers, *pipeline, settings.limited);
        sets_.insert_or_assign(which, std::move(made));
    }
    bool has_set(std::uint64_t which) const { return sets_.contains(which); }
    std::size_t set_size(std::uint64_t which) const { return sets_.at(which).fingers.size(); }
    // What the fingers of a set do from now on. given: (3n,) forces [N], contact frames, of those that need them; torsion: (n,) moments
    // about the normals with them [N m], or none.
    void give(Hold hold, std::uint64_t which, const double* given, const double* torsion = nullptr) {
        hold_ = hold, set_ = &sets_.at(which);
        if (given) std::copy(given, given + 3 * set_->fingers.size(), given_.begin());
        std::fill(torsion_.begin(), torsion_.end(), 0.0);
        if (torsion) std::copy(torsion, torsion + set_->fingers.size(), torsion_.begin());
        changed = unkept = false;
    }

    // Frames, and measured forces as the commanded ones: what the hand does at rest, before the first command.
    void rest() {
        write_frames();
        for (int i = 0; i < tree->fingers(); ++i)
            for (int a = 0; a < 3; ++a) force[3 * i + a] = dot(axis(i, a), seen().forces[i]);
    }

    // How the object is held, by the truth: its error against the wanted pose, and what the fingers do.
    struct Outcome {
        PoseError error;
        double drift, tilt;  // [m], [rad]: lengths of the errors of position and orientation
        double force_error = 0.0;  // largest component of measured - commanded force [N]
        double slip = 0.0;  // fastest touching tip on the object [m/s]
        double stray = 0.0;  // force of links on the object [N]
        double total_normal = 0.0;  // sum of the commanded normal forces [N]
    };
    // measured: (N, 3) receives the measured forces in the commanded contact frames [N]
    Outcome outcome(const Target& target, double* measured) const {
        const Snapshot& now = scene->now;
        const PoseError error(now, target);
        Outcome out{.error = error, .drift = length(error.position), .tilt = length(error.orientation), .stray = now.stray};
        for (int i = 0; i < tree->fingers(); ++i) {
            for (int a = 0; a < 3; ++a) {
                const int j = 3 * i + a;
                measured[j] = dot(axis(i, a), now.forces[i]);
                out.force_error = std::max(out.force_error, std::abs(measured[j] - force[j]));
            }
            out.total_normal += force[3 * i];
            if (now.touching[i] > 0.0) out.slip = std::max(out.slip, now.slip[i]);
        }
        return out;
    }

    // The torques of this tick, within the motors' limits: first what the forces need, of the rest what reaches and keeps posture.
    void command() {
        const Snapshot& s = seen();
        std::copy(s.gravity_torques.begin(), s.gravity_torques.end(), torques.begin());
        before_ = force, frames_before_ = frames;  // not swapped: Python looks at them
        std::fill(force.begin(), force.end(), 0.0);
        write_frames();
        std::uint64_t acting = 0;
        if (hold_ != Hold::place && set_ && !set_->fingers.empty()) {
            write_forces();
            push(solved_.data(), torques);
            for (std::size_t a = 0; a < set_->fingers.size(); ++a) {
                const int i = set_->fingers[a];
                acting |= std::uint64_t(1) << i;
                std::copy_n(&solved_[3 * a], 3, &force[3 * i]);
            }
        }
        for (int i = 0; i < tree->fingers(); ++i) {
            if (acting >> i & 1) continue;
            std::fill(extra_.begin(), extra_.end(), 0.0);
            s.posture.push(tree->tips[i].link, s.tips[i], reach(i), extra_.data());
            add_within();
        }
        if (redundant_) keep_posture();
        for (int j = 0; j < tree->joints(); ++j) {
            const double limit = tree->links[j].torque_limit, asked = std::abs(torques[j]);
            if (tree->links[j].coupled()) continue;
            effort.saturated = effort.saturated || (asked > limit * (1.0 + ROUNDED) && !unkept);
            torques[j] = std::min(std::max(torques[j], -limit), limit);
            peak = std::max(peak, std::abs(torques[j])), effort.margin = std::min(effort.margin, limit - std::abs(torques[j]));
        }
        fresh_ = false;
    }

private:
    static constexpr double LEAST_NORMAL = 0.1;  // [N] of a finger without force closure
    static constexpr double ROUNDED = 1e-9;  // of a torque limit: rounding by which it may be passed

    struct Set {
        std::vector<int> fingers;
        Pipeline* pipeline = nullptr;
        std::optional<TorqueLimits> limits;
        bool limited = false;  // whether its forces of the last tick are those of `limits`
    };
    std::map<std::uint64_t, Set> sets_;
    Set* set_ = nullptr;
    Hold hold_ = Hold::optimised;
    bool missing_ = false, fresh_ = true;  // a finger that counts has no force; nothing was commanded before
    std::vector<int> apart_;  // (N,) ticks since a finger had force
    Target target_{};
    std::vector<double> before_, frames_before_;  // commanded at the last tick
    std::vector<double> points_, normals_;  // (n, 3) of the set's contacts
    std::vector<double> given_, solved_, kept_;  // (3n,) forces [N], contact frames
    std::vector<double> then_;  // (n, 3, 3) frames of the last tick
    std::vector<double> pull_, extra_, trial_;  // (M,) of `keep_posture`, `add_within`, `fits`
    std::vector<double> torsion_;  // (n,) given [N m]
    std::vector<double> push_, jacobian_;  // of `keep_posture`
    Cholesky normal_;
    std::vector<Vec6> columns_;  // of G
    bool redundant_;

    // Whether the tips leave joints free: more than three of a finger, or some that move none.
    static bool is_redundant(const Tree& tree) {
        const std::vector<int> users = tree.users(tree.all_fingers());
        bool free = false;
        for (int i = 0; i < tree.fingers(); ++i) free = free || tree.movers(i).size() > 3;
        for (int j = 0; j < tree.joints(); ++j) free = free || !(users[j] || tree.links[j].coupled());
        return free;
    }

    // out (M,) += the torques with which the set's fingers push with forces (3n,) [N], contact frames.
    void push(const double* forces, std::vector<double>& out) const {
        const Snapshot& s = seen();
        for (std::size_t a = 0; a < set_->fingers.size(); ++a) {
            const int i = set_->fingers[a];
            Point push{0.0, 0.0, 0.0};
            for (int k = 0; k < 3; ++k) push += forces[3 * a + k] * axis(i, k);
            s.posture.push(tree->tips[i].link, s.touch[i], s.rotation * push, out.data());
            if (torsion_[a] != 0.0) s.posture.twist(tree->tips[i].link, torsion_[a] * (s.rotation * axis(i, 0)), out.data());
        }
    }
    // Whether the motors can push with forces (3n,) besides carrying the hand.
    bool fits(const double* forces) {
        std::copy(seen().gravity_torques.begin(), seen().gravity_torques.end(), trial_.begin());
        push(forces, trial_);
        return TorqueLimits::within(*tree, trial_);
    }
    // Adds as much of `extra_` to the torques as their limits leave room for.
    void add_within() {
        double share = 1.0;
        for (int j = 0; j < tree->joints(); ++j) {
            if (extra_[j] == 0.0) continue;
            const double room = tree->links[j].torque_limit - std::copysign(torques[j], torques[j] * extra_[j]);
            share = std::min(share, std::max(room, 0.0) / std::abs(extra_[j]));
        }
        for (int j = 0; j < tree->joints(); ++j) torques[j] += share * extra_[j];
    }

    Point axis(int i, int a) const { return {frames[9 * i + a], frames[9 * i + 3 + a], frames[9 * i + 6 + a]}; }
    std::vector<int> fingers_of(std::uint64_t which) const {
        std::vector<int> out;
        for (int i = 0; i < tree->fingers(); ++i)
            if (which >> i & 1) out.push_back(i);
        return out;
    }

    // Which fingers count as in contact: those that touch, and those that did a moment ago.
    void count_contacts() {
        const std::uint64_t touch = seen().mask();
        if (touch == mask && !missing_) return;
        std::uint64_t held = 0;
        for (int i = 0; i < tree->fingers(); ++i) {
            const std::uint64_t bit = std::uint64_t(1) << i;
            apart_[i] = touch & bit ? 0 : apart_[i] + 1;
            if (touch & bit || (mask & bit && apart_[i] <= settings.release)) held |= bit;
        }
        missing_ = held != touch;
        if (held == mask) return;
        changes += mask != 0;
        mask = held, changed = true;
    }

    void write_frames() {
        for (int i = 0; i < tree->fingers(); ++i) {
            const Frame frame(seen().normals[i], nullptr);
            for (int a = 0; a < 3; ++a)
                for (int k = 0; k < 3; ++k) frames[9 * i + 3 * k + a] = frame[a][k];
        }
    }

    // Forces (3n,) of the set's fingers into `solved_`.
    void write_forces() {
        if (hold_ != Hold::optimised) {
            solved_ = given_;
            if (hold_ != Hold::direct) restore_balance();
            if (hold_ == Hold::lost) clip();
            return;
        }
        const std::size_t count = set_->fingers.size();
        for (std::size_t a = 0; a < count; ++a)
            for (int k = 0; k < 3; ++k) {
                points_[3 * a + k] = seen().points[set_->fingers[a]][k];
                normals_[3 * a + k] = seen().normals[set_->fingers[a]][k];
            }
        const Load load{points_.data(), normals_.data(), wrench.data()};
        repaired += set_->pipeline->carry(load, solved_.data()) != CARRIED;
        const bool exceeds = !fits(solved_.data());
        set_->limited = exceeds && keep_limits(load);
        unkept = exceeds && set_->limits->shares && !fits(solved_.data());
        if (!fresh_) bound_change(load);
    }

    // The forces within the torque limits that are left; false where none were found.
    bool keep_limits(const Load& load) {
        const Snapshot& s = seen();
        TorqueLimits& limits = *set_->limits;
        const int before = limits.iterations;
        const bool found =
            limits.solve(load, {s.posture, s.touch, s.rotation, frames, s.gravity_torques}, set_->limited, solved_.data());
        effort.limited += limits.iterations - before;
        return found;
    }

    // Moves the forces towards what was commanded before, so that no component changes by more than `most_change` beyond balance.
    void bound_change(const Load& load) {
        const auto change = [&](const auto& then) {
            double most = 0.0;
            for (std::size_t a = 0; a < set_->fingers.size(); ++a)
                for (int k = 0; k < 3; ++k) most = std::max(most, std::abs(solved_[3 * a + k] - then(a, k)));
            return most;
        };
        if (change([&](std::size_t a, int k) { return before_[3 * set_->fingers[a] + k]; }) <= settings.most_change) return;
        for (std::size_t a = 0; a < set_->fingers.size(); ++a) {
            const int i = set_->fingers[a];
            const double *f = &before_[3 * i], least = 1.05 * std::sqrt(f[1] * f[1] + f[2] * f[2]);
            // a finger that has just landed carries nothing yet: barely inside its cone
            kept_[3 * a] = std::max(settings.friction * f[0], std::max(least, 1e-2)) / settings.friction;
            kept_[3 * a + 1] = f[1], kept_[3 * a + 2] = f[2];
            std::copy(&frames_before_[9 * i], &frames_before_[9 * i] + 9, &then_[9 * a]);
        }
        set_->pipeline->carry_from(load, kept_.data(), then_.data(), kept_.data());
        const double moved = change([&](std::size_t a, int k) { return kept_[3 * a + k]; });
        if (moved <= settings.most_change) return;
        const double share = within_limits(settings.most_change / moved);
        for (std::size_t j = 0; j < 3 * set_->fingers.size(); ++j) solved_[j] = kept_[j] + share * (solved_[j] - kept_[j]);
    }

    // The least share, from one on, of the way from `kept_` to `solved_` that is within the torque limits if `solved_` is.
    double within_limits(double share) {
        if (!set_->limited) return share;
        const auto torques_of = [&](const std::vector<double>& forces, std::vector<double>& out) {
            std::copy(seen().gravity_torques.begin(), seen().gravity_torques.end(), out.begin());
            push(forces.data(), out);
        };
        torques_of(kept_, trial_), torques_of(solved_, extra_);
        for (int j = 0; j < tree->joints(); ++j) {
            const double limit = tree->links[j].torque_limit, from = trial_[j], way = extra_[j] - from;
            if (std::abs(extra_[j]) <= limit && std::abs(from + share * way) > limit)
                share = std::min(1.0, (std::copysign(limit, from) - from) / way);
        }
        return share;
    }

    // The least change of the forces that restores balance, as far as these contacts can.
    void restore_balance() {
        constexpr double SHIFT = 1e-9;  // of the largest entry: two contacts cannot turn the object about the line between them
        const std::size_t size = 3 * set_->fingers.size();
        Packed6 gram{};
        Vec6 missed = wrench;
        for (std::size_t j = 0; j < size; ++j) {
            const int i = set_->fingers[j / 3];
            columns_[j] = unit_wrench(seen().points[i], axis(i, int(j % 3)));
            missed = missed + solved_[j] * columns_[j];
            for (int r = 0; r < 6; ++r)
                for (int q = 0; q <= r; ++q) gram[packed(r, q)] += columns_[j][r] * columns_[j][q];
        }
        double largest = 0.0;
        for (int r = 0; r < 6; ++r) largest = std::max(largest, gram[packed(r, r)]);
        for (int r = 0; r < 6; ++r) gram[packed(r, r)] += SHIFT * largest;
        Ldl6 factor;
        if (!(factor.factor(gram) > 0.0)) return;
        const Vec6 pull = factor.solve(missed);
        for (std::size_t j = 0; j < size; ++j) solved_[j] -= dot(columns_[j], pull);
    }

    // Into the cones, with at least `LEAST_NORMAL`; tangential forces give way.
    void clip() {
        for (std::size_t a = 0; a < set_->fingers.size(); ++a) {
            double* f = &solved_[3 * a];
            f[0] = std::max(f[0], LEAST_NORMAL);
            const double share = settings.friction * f[0] / std::max(std::sqrt(f[1] * f[1] + f[2] * f[2]), 1e-12);
            if (share < 1.0) f[1] *= share, f[2] *= share;
        }
    }

    // Spring and damper that bring tip i to its place inside the surface at its goal: the target's where nothing is optimised,
    // else carried by the object. World frame [N].
    Point reach(int i) const {
        const Snapshot& s = seen();
        const bool anchored = hold_ == Hold::place;
        const Rotation turned = anchored ? Rotation::of_quaternion(target_.quaternion) : s.rotation;
        const Spring& spring = anchored ? settings.spring : settings.reach[i];
        const double depth = anchored ? depths[i] : settings.reach_depth;
        const Point place = turned * (goals[i] - (tree->tips[i].radius - depth) * inwards[i]);
        const Point wanted = (anchored ? target_.position : s.position) + place;
        Point speed = s.posture.velocity(tree->tips[i].link, s.tips[i], s.rates.data());
        if (!anchored) speed -= s.object_velocity(s.tips[i]);
        const Point pull = spring.gain * (wanted - s.tips[i]) - spring.damping * speed;
        const double size = length(pull);
        return size > spring.limit ? (spring.limit / size) * pull : pull;
    }

    // Adds what keeps a redundant hand near its rest posture without moving the tips: the null space of all tip Jacobians.
    void keep_posture() {
        const Snapshot& s = seen();
        const int m = tree->joints(), rows = 3 * tree->fingers();
        for (int j = 0; j < m; ++j) {
            const Spring& spring = settings.posture[j];
            pull_[j] = tree->links[j].coupled() ? 0.0 : -spring.gain * (s.angles[j] - home[j]) - spring.damping * s.rates[j];
        }
        for (int i = 0; i < tree->fingers(); ++i) s.posture.jacobian(tree->tips[i].link, s.tips[i], &jacobian_[3 * m * i]);
        for (int a = 0; a < rows; ++a) {
            push_[a] = 0.0;
            for (int j = 0; j < m; ++j) push_[a] += jacobian_[m * a + j] * pull_[j];
            for (int b = 0; b <= a; ++b) {
                normal_(a, b) = a == b ? 1e-10 : 0.0;
                for (int j = 0; j < m; ++j) normal_(a, b) += jacobian_[m * a + j] * jacobian_[m * b + j];
            }
        }
        if (!normal_.factor()) return;
        normal_.solve(push_.data());
        for (int j = 0; j < m; ++j) {
            extra_[j] = pull_[j];
            for (int a = 0; a < rows; ++a) extra_[j] -= jacobian_[m * a + j] * push_[a];
        }
        add_within();
    }
};

}  // namespace grasp
