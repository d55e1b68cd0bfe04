// The control loop of a hand: from what is seen to joint torques in one call. It allocates when it is made, and never in a tick.
#pragma once
#include <grasp/hand/sensing.hpp>
#include <grasp/math/cholesky.hpp>
#include <grasp/optimizer.hpp>
#include <grasp/phi/elastic.hpp>

namespace grasp {

// A spring and damper that draws a tip to its place.
struct Spring { double gain = 0.0, damping = 0.0, limit = infinity; };  // [N/m], [N s/m], the most force [N]

struct ControlSettings {
    Body body;
    std::vector<Spring> reach;  // (N,) of each finger without contact, on its way
    Spring spring;  // of all fingers where nothing is optimized
    double reach_depth = 0.0;  // [m] inside the surface to which a finger reaches
    std::vector<Spring> posture;  // (M,) [N m/rad], [N m s/rad]: joints that the tips leave free
    Options follow{.tolerance = 1e-4,
                   .limit = 200};  // what solves after the method, from the last command, and within the torque limits
    bool remembers = true;  // whether the method receives the last command, for starts that use it
    std::vector<double> directions;  // (N, 3, K) [1], object frame: the internal forces of an adjustment
    double squeeze = 0.0;  // [N] total normal force of `Hold::squeeze`
    double most_change = infinity;  // [N] by which a force may change in one tick beyond what balance asks
    int release = 2;  // ticks without force after which a finger no longer counts as in contact
};

// What solvers and motors were asked since `begin_step`.
struct Effort {
    int iterations = 0, trials = 0;  // of the method: accepted steps, and all that were tried
    int followed = 0;  // iterations at control ticks between two of the method's
    int limited = 0;   // iterations of Newton within the torque limits, where a force exceeded them
    bool saturated = false;  // torques had to be cut: no force within the limits balances the wrench, or none was found
    double margin = infinity;  // least distance of a torque from its limit [N m]
    double share = 0.0;  // largest torque as a share of its limit
};

// Costs of an agent's step, each from 0 to 1.
struct Costs {
    double force;   // share of the commanded normal forces above the least that balances the wrench; 1: no force balances it
    double torque;  // largest torque of the step as a share of its limit
    double change;  // change of the commanded forces in the step as a share of the forces before and after: sums of |components|
};

// What the fingers in contact do.
enum class Hold {
    optimized,  // the force that the method finds, and Newton after it
    squeeze,  // a constant internal force, and what balances
    place,  // no force: every finger holds its place
    direct,  // given forces
    reach,  // no force: every finger is drawn to its contact
};

class Controller {
public:
    const std::shared_ptr<Scene> scene;
    const std::shared_ptr<const Tree> tree;
    const ControlSettings settings;
    Sensors sensors;
    Hold hold = Hold::optimized;
    Vec6 wrench{};  // that is balanced [N, N m], object frame
    std::vector<double> torques;  // (M,) [N m]
    std::vector<double> force;  // (N, 3) commanded [N], contact frames
    std::vector<double> frames;  // (N, 3, 3) these, columns (n, o, t), object frame
    std::vector<double> depths;  // (N,) [m] inside the surface of the places that fingers hold where nothing is optimized
    std::vector<double> home;  // (M,) rest posture [rad]
    std::vector<Point> goals, inwards;  // (N,) the grasp's contact points [m] and inward normals, object frame
    std::vector<double> solution;  // the row of the method's last solve
    double peak = 0.0;  // largest |torque| since `reset` [N m]
    std::uint64_t mask = 0;  // the fingers that count as in contact
    int changes = 0;  // how often they changed
    bool closure = true;  // whether a force was found at the last tick that optimized
    Effort effort;

    // method: finds the forces at an agent's step, made for the contacts of all fingers. Throws std::invalid_argument.
    Controller(std::shared_ptr<Scene> given, const ForceOptimizer& method, const ControlSettings& settings,
               const SensorSettings& sensing)
        : scene(std::move(given)), tree(scene->tree), settings(settings), sensors(scene, sensing), torques(tree->joints()),
          force(3 * tree->fingers()), frames(9 * tree->fingers()), depths(tree->fingers()), home(torques), goals(tree->fingers()),
          inwards(goals), solution(method.size()), method_(method), motors_(*tree), follow_({method.contacts()}, settings.follow),
          within_(within(method.contacts())), least_({method.contacts()}, {.method = Method::conic, .tolerance = 1e-4}),
          elastic_(tree->fingers()), followed_(follow_.size()), found_(within_.size()), cheapest_(least_.size()), last_(found_),
          slid_(goals), apart_(tree->fingers()), before_(force), began_(force), given_(force), squeezed_(force),
          adjustment_(force), torsion_(tree->fingers()), pull_(torques), extra_(torques), trial_(torques), push_(force),
          posture_(force.size() * torques.size()), normal_(int(force.size())), redundant_(is_redundant(*tree)) {
        if (method.contacts().count != tree->fingers())
            throw std::invalid_argument("the method needs one contact of each finger");
    }
    Controller(const Controller&) = delete;

    // Forgets the episode; before it the scene stood still.
    void reset() {
        std::fill(torques.begin(), torques.end(), 0.0);
        std::fill(force.begin(), force.end(), 0.0);
        std::fill(frames.begin(), frames.end(), 0.0);
        std::fill(apart_.begin(), apart_.end(), 0);
        forget_solution();
        wrench = {}, peak = 0.0, mask = squeezing_ = 0, changes = 0, closure = true;
        begin_step();
        missing_ = known_ = limited_ = false;
        worst_ = {}, std::fill(slid_.begin(), slid_.end(), Point{0.0, 0.0, 0.0});
        sensors.reset();
    }

    // What is known at a control tick.
    struct Known {
        Doubles reading;  // of the simulator or the hand, see `Reading`; none: the scene stands as it was read
        const double* external;  // (6,) wrench on the object as a perfect sensor would tell it [N, N m], object frame
        const double* noise;  // (3 + 3N,) standard normal numbers where sensors are noisy
        Point gravity;  // [m/s^2], world
        Target target;
    };
    // What an agent does in its step, which begins at this tick. All may be left out.
    struct Step {
        Doubles adjustment{};  // (K,) [N] along `settings.directions`: added to the start, which is then repaired
        Start start = Start::standard;  // of the method: its own, or `given`
        Doubles force{};  // (N, 3) [N], contact frames: that start, or with `Hold::direct` what is commanded
    };
    // One control tick, from a reading to `torques`, within the motors' limits. step: where an agent's step begins. False: the reading is not
    // finite or the object is lost; nothing has changed.
    bool tick(const Known& known, const Step* step = nullptr) {
        const bool good = see(known);
        if (good) act(step);
        return good;
    }
    // The two halves of a tick, for starts that need to know what is seen.
    bool see(const Known& known) {
        if (!known.reading.empty() && !scene->read(known.reading.data(), known.reading.size())) return false;
        sensors.see(known.external, known.noise, settings.body, known.gravity);
        target_ = known.target;
        wrench = sensors.external + settings.body.wrench(seen(), target_, known.gravity);
        count_contacts();
        for (int i = 0; i < tree->fingers(); ++i) {
            if (scene->now.touching[i] > 0.0) slid_[i] += sensors.settings.tick * scene->now.sliding[i];
            worst_.slide = std::max(worst_.slide, length(slid_[i]));
        }
        const double mass = settings.body.mass;
        load_ = std::max(length(point(known.external) + mass * scene->now.to_object(scene->gravity)), STANDARD_GRAVITY * mass);
        worst_ = worst();
        return true;
    }
    void act(const Step* step = nullptr) {
        before_ = force;  // not swapped: Python looks at it
        std::fill(force.begin(), force.end(), 0.0);
        std::fill(torsion_.begin(), torsion_.end(), 0.0);
        write_frames();
        const bool pushes = hold != Hold::place && hold != Hold::reach && mask;
        closure = mask || hold != Hold::optimized;
        if (step) forget_solution();
        if (pushes) find_forces(step);
        remember(pushes);
        torques_of(force.data(), torques);
        for (int i = 0; i < tree->fingers(); ++i) {
            if (pushes && mask >> i & 1) continue;
            std::fill(extra_.begin(), extra_.end(), 0.0);
            seen().posture.push(tree->tips[i].link, seen().tips[i], reach(i), extra_.data());
            add_within();
        }
        if (redundant_) keep_posture();
        cut();
    }
    const Snapshot& seen() const { return sensors.seen(); }

    // An agent's step begins: its effort is counted anew.
    void begin_step() { effort = {}, began_ = force; }
    // The costs of the step since `begin_step`, on the contacts that are seen now.
    Costs costs() {
        double total = 0.0, moved = 0.0, both = 0.0;
        for (int i = 0; i < tree->fingers(); ++i) total += force[3 * i];
        for (std::size_t j = 0; j < force.size(); ++j)
            moved += std::abs(force[j] - began_[j]), both += std::abs(force[j]) + std::abs(began_[j]);
        Costs out{.force = closure ? 0.0 : 1.0, .torque = std::min(effort.share, 1.0), .change = both > 0.0 ? moved / both : 0.0};
        if (closure && total > 0.0) {
            least_.solve({.wrench = wrench.data(), .now = contacts()}, cheapest_.data());
            const Record row(cheapest_.data());
            out.force = row.has_force() ? std::max(0.0, 1.0 - row.summary().objective / total) : 1.0;
        }
        return out;
    }
    // How the method's last solve ended.
    Code code() const { return Code(int(reinterpret_cast<const Summary*>(solution.data())->code)); }

    // Frames, and measured forces as the commanded ones: what the hand does at rest, before the first command.
    void rest() {
        write_frames();
        worst_.slide = 0.0, std::fill(slid_.begin(), slid_.end(), Point{0.0, 0.0, 0.0});  // the first tick sees the same again
        for (int i = 0; i < tree->fingers(); ++i)
            for (int a = 0; a < 3; ++a) force[3 * i + a] = dot(axis(i, a), seen().forces[i]);
    }

    // What was worst since `reset`, by the truth.
    struct Worst {
        double slide = 0.0;  // [m] of a touching tip from where it was on the object, by sliding
        double overlap = 0.0;  // [m] of a tip and the object
        double stray = 0.0;  // force of links on the object, as a share of external force and weight, the weight at least
    };
    // How the object is held, by the truth: its error against the wanted pose, and what the fingers do.
    struct Outcome {
        PoseError error;
        double drift, tilt;  // [m], [rad]: lengths of the errors of position and orientation
        double force_error = 0.0;  // largest component of measured - commanded force [N]
        double slip = 0.0;  // fastest touching tip on the object [m/s]
        double stray = 0.0;  // force of links on the object [N]
        Worst worst;
    };
    // measured: (N, 3) receives the measured forces in the commanded contact frames [N]
    Outcome outcome(const Target& target, double* measured) const {
        const Snapshot& now = scene->now;
        const PoseError error(now, target);
        Outcome out{.error = error,
                    .drift = length(error.position),
                    .tilt = length(error.orientation),
                    .stray = now.stray,
                    .worst = worst()};
        for (int i = 0; i < tree->fingers(); ++i) {
            for (int a = 0; a < 3; ++a) {
                const int j = 3 * i + a;
                measured[j] = dot(axis(i, a), now.forces[i]);
                out.force_error = std::max(out.force_error, std::abs(measured[j] - force[j]));
            }
            if (now.touching[i] > 0.0) out.slip = std::max(out.slip, now.slip[i]);
        }
        return out;
    }

private:
    static constexpr double STANDARD_GRAVITY = 9.81;  // [m/s^2]
    static constexpr double NEAR = 0.9;  // of a torque limit: below, limits are left out of the next tick
    static constexpr double LIGHT = 1e-2;  // [N] of a finger that lands, times the friction
    static constexpr double ROUNDED = 1e-9;  // of a torque limit: rounding by which it may be passed

    // The joints that have motors, and how the contact points move with them.
    struct Motors {
        std::vector<int> of;  // (M,) the motor of a joint; -1: it is coupled
        std::vector<double> limit, bias;  // (J,) [N m]: of the motors; of them what the links' weight takes
        explicit Motors(const Tree& tree) : of(tree.joints(), -1) {
            for (int j = 0; j < tree.joints(); ++j)
                if (!tree.links[j].coupled()) of[j] = int(limit.size()), limit.push_back(tree.links[j].torque_limit);
            bias.resize(limit.size());
        }
    };
    ForceOptimizer method_;
    Motors motors_;
    std::vector<double> jacobian_;  // (N, 3 or 6, J) object frame; before what is made with it
    ForceOptimizer follow_, within_;  // what goes on after the method, on the cones alone; Newton within the motors' limits
    ForceOptimizer least_;  // the least sum of normal forces
    ElasticBalance elastic_;
    std::vector<double> followed_, found_, cheapest_, last_;  // rows of the three, and of the last command
    bool known_ = false;  // whether there is a last command
    bool limited_ = false,
         exceeding_ = false;  // whether it was made within the limits and is near them; whether it exceeds them least
    std::uint64_t squeezing_ = 0;  // the fingers that `squeezed_` is for
    Worst worst_;
    double load_ = 1.0;  // [N] external force and weight, the weight at least: pushes may cancel that
    std::vector<Point> slid_;  // (N,) the way of each tip on the object by sliding [m], object frame
    bool missing_ = false;  // a finger that counts has no force
    std::vector<int> apart_;  // (N,) ticks since a finger had force
    Target target_{};
    std::vector<double> before_, began_, given_, squeezed_,
        adjustment_;  // (N, 3): commanded at the last tick, and before the step; of the agent; internal; object frame
    std::vector<double> torsion_;  // (N,) commanded [N m]
    std::vector<double> pull_, extra_, trial_;  // (M,) of `keep_posture`, `add_within`, `fits`
    std::vector<double> push_, posture_;  // of `keep_posture`
    Cholesky normal_;
    bool redundant_;

    ForceOptimizer within(const Contacts& contacts) {
        jacobian_.resize((contacts.soft() ? 6 : 3) * contacts.count * motors_.limit.size());
        const auto limited = [](double limit) { return limit < infinity; };
        const bool elastic = std::any_of(motors_.limit.begin(), motors_.limit.end(), limited);
        return ForceOptimizer({contacts, {.jacobian = jacobian_, .torque_limit = motors_.limit}},
                              {.tolerance = settings.follow.tolerance, .limit = settings.follow.limit, .elastic = elastic});
    }
    // Whether the tips leave joints free: more than three of a finger, or some that move none.
    static bool is_redundant(const Tree& tree) {
        const std::vector<int> users = tree.users(tree.all_fingers());
        bool free = false;
        for (int i = 0; i < tree.fingers(); ++i) free = free || tree.movers(i).size() > 3;
        for (int j = 0; j < tree.joints(); ++j) free = free || !(users[j] || tree.links[j].coupled());
        return free;
    }

    // Of all that was and what is.
    Worst worst() const {
        Worst out = worst_;
        for (double gap : scene->now.gaps) out.overlap = std::max(out.overlap, -gap);
        out.stray = std::max(out.stray, scene->now.stray / load_);
        return out;
    }

    // --- contacts

    Point axis(int i, int a) const { return {frames[9 * i + a], frames[9 * i + 3 + a], frames[9 * i + 6 + a]}; }
    // f(i) for the fingers in contact
    template <class F> void touching(F&& f) const {
        for (int i = 0; i < tree->fingers(); ++i)
            if (mask >> i & 1) f(i);
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
        mask = held;
    }
    void write_frames() {
        for (int i = 0; i < tree->fingers(); ++i) {
            const Frame frame(seen().normals[i], nullptr);
            for (int a = 0; a < 3; ++a)
                for (int k = 0; k < 3; ++k) frames[9 * i + 3 * k + a] = frame[a][k];
        }
    }
    // The current contacts, as optimizers take them.
    Now contacts() const {
        const std::size_t size = 3 * seen().points.size();
        return {.positions = {&seen().points[0].u, size}, .normals = {&seen().normals[0].u, size}, .contacts = mask};
    }
    // The same with the motors' Jacobian and what the links' weight takes of them.
    Now limited_contacts() {
        const Snapshot& s = seen();
        const std::size_t joints = motors_.limit.size(), rows = joints ? jacobian_.size() / (joints * tree->fingers()) : 0;
        std::fill(jacobian_.begin(), jacobian_.end(), 0.0);
        touching([&](int i) {
            const auto add = [&](std::size_t row, int j, const Point& moves) {
                const Point there = s.rotation.transposed(moves);
                for (int k = 0; k < 3; ++k) jacobian_[joints * (rows * i + row + k) + motors_.of[j]] += there[k];
            };
            s.posture.carriers(tree->tips[i].link, s.touch[i], [&](int j, const Point& moves) { add(0, j, moves); });
            if (rows == 6) s.posture.turners(tree->tips[i].link, [&](int j, const Point& turns) { add(3, j, turns); });
        });
        for (int j = 0; j < tree->joints(); ++j)
            if (motors_.of[j] >= 0) motors_.bias[motors_.of[j]] = s.gravity_torques[j];
        Now now = contacts();
        now.jacobian = jacobian_, now.torque_bias = motors_.bias;
        return now;
    }

    // --- forces

    void forget_solution() { Record(solution.data(), tree->fingers()).summary() = {}; }
    // Forces of the fingers in contact into `force` and `torsion_`.
    void find_forces(const Step* step) {
        if (hold == Hold::optimized) {
            if (known_) land();
            if (step || !known_ || !limited_ || !keep_limits(last_.data())) {
                const Record row = step ? by_method(*step) : follow();
                if (!row.has_force()) return balance_elastically();
                take(row);
                if (fits(1.0)) limited_ = false;
                else keep_limits(known_ && limited_ ? last_.data() : (step ? solution : followed_).data());
            }
            if (known_) bound_change();
            return;
        }
        if (hold == Hold::direct && step) std::copy(step->force.begin(), step->force.end(), given_.begin());
        if (hold == Hold::squeeze && squeezing_ != mask) squeeze();
        const std::vector<double>& from = hold == Hold::direct ? given_ : squeezed_;
        touching([&](int i) { std::copy_n(&from[3 * i], 3, &force[3 * i]); });
        if (hold == Hold::squeeze) restore_balance();
    }
    void take(const Record& row) {
        std::copy_n(row.force(), force.size(), force.data());
        std::copy_n(row.torsion(), torsion_.size(), torsion_.data());
    }
    // The method on the current contacts.
    Record by_method(const Step& step) {
        Ask ask{.wrench = wrench.data(), .now = contacts(), .start = step.start};
        if (step.start == Start::given) ask.force = step.force;
        if (settings.remembers && known_) ask.previous = last_.data();
        if (!step.adjustment.empty()) adjust(step.adjustment), ask.adjustment = adjustment_;
        method_.solve(ask, solution.data());
        const Record row(solution.data());
        if (row.has_force()) effort.iterations += int(row.summary().iterations), effort.trials += int(row.summary().trials);
        return row;
    }
    // From the last command.
    Record follow() {
        follow_.solve(from_last(), followed_.data());
        const Record row(followed_.data());
        effort.followed += int(row.summary().iterations);
        return row;
    }
    Ask from_last() const {
        return {
            .wrench = wrench.data(), .now = contacts(), .start = Start::previous, .previous = known_ ? last_.data() : nullptr};
    }
    // Newton within the motors' limits from the row of a force near them; false without a force.
    bool keep_limits(const double* previous) {
        within_.solve({.wrench = wrench.data(), .now = limited_contacts(), .start = Start::previous, .previous = previous},
                      found_.data());
        const Record within(found_.data());
        effort.limited += int(within.summary().iterations);
        exceeding_ = within.code() == LIMITS_EXCEEDED;
        if (within.has_force()) take(within);
        limited_ = !fits(NEAR);
        return within.has_force();
    }
    // No force closure: the last forces, towards what misses balance least.
    void balance_elastically() {
        closure = limited_ = false;
        touching([&](int i) { std::copy_n(&before_[3 * i], 3, &force[3 * i]); });
        elastic_.solve(method_.contacts(), mask, &seen().points[0].u, frames.data(), wrench, settings.follow.limit, force.data());
        effort.followed += elastic_.iterations;
    }
    void adjust(Doubles coordinates) {
        const std::size_t columns = coordinates.size();
        for (std::size_t j = 0; j < adjustment_.size(); ++j) {
            adjustment_[j] = 0.0;
            for (std::size_t k = 0; k < columns; ++k) adjustment_[j] += settings.directions[columns * j + k] * coordinates[k];
        }
    }
    // A finger that was commanded no force in its cone, as it has just landed, was barely inside it.
    void land() {
        const Record row(last_.data());
        touching([&](int i) {
            double* f = row.force() + 3 * i;
            const double *scale = &method_.contacts().scale[3 * i], side = std::hypot(scale[1] * f[1], scale[2] * f[2]);
            if (!(scale[0] * f[0] > side)) f[0] = std::max(1.05 * side, LIGHT) / scale[0];
        });
    }
    // The command as the previous solution of the next tick.
    void remember(bool pushes) {
        known_ = pushes;
        if (!pushes) return;
        const Record row(last_.data(), tree->fingers());
        row.summary().code = limited_ && exceeding_ ? LIMITS_EXCEEDED : CONVERGED, row.summary().contacts = tree->fingers();
        std::copy(force.begin(), force.end(), row.force());
        std::copy(torsion_.begin(), torsion_.end(), row.torsion());
        std::copy(frames.begin(), frames.end(), row.frames());
    }
    // Moves the forces towards what was commanded before, so that no component changes by more than `most_change` beyond balance.
    void bound_change() {
        const auto change = [&](const double* then) {
            double most = 0.0;
            touching([&](int i) {
                for (int j = 3 * i; j < 3 * i + 3; ++j) most = std::max(most, std::abs(force[j] - then[j]));
            });
            return most;
        };
        if (change(before_.data()) <= settings.most_change) return;
        follow_.start(from_last(), followed_.data());
        const Record kept(followed_.data());
        if (!kept.has_force()) return;
        const double moved = change(kept.force());
        if (moved <= settings.most_change) return;
        const double share = within_limits(kept, settings.most_change / moved);
        for (std::size_t j = 0; j < force.size(); ++j) force[j] = kept.force()[j] + share * (force[j] - kept.force()[j]);
        for (std::size_t i = 0; i < torsion_.size(); ++i)
            torsion_[i] = kept.torsion()[i] + share * (torsion_[i] - kept.torsion()[i]);
    }
    // The least share, from one on, of the way from `kept` to the forces that is within the torque limits if the forces are.
    double within_limits(const Record& kept, double share) {
        torques_of(kept.force(), trial_), torques_of(force.data(), extra_);
        for (int j = 0; j < tree->joints(); ++j) {
            const double limit = tree->links[j].torque_limit, from = trial_[j], way = extra_[j] - from;
            if (std::abs(extra_[j]) <= limit && std::abs(from + share * way) > limit)
                share = std::min(1.0, (std::copysign(limit, from) - from) / way);
        }
        return share;
    }
    // An internal force of the contacts that the method was made for, of those fingers that touch, with the total normal force of the settings.
    void squeeze() {
        const double nothing[6] = {};
        follow_.solve({.wrench = nothing, .now = {.contacts = mask}}, followed_.data());
        const Record row(followed_.data());
        double total = 0.0;
        touching([&](int i) {
            for (int a = 0; a < 3; ++a) squeezed_[3 * i + a] = row.has_force() ? row.force()[3 * i + a] : a == 0;
            total += squeezed_[3 * i];
        });
        for (double& f : squeezed_) f *= settings.squeeze / total;
        squeezing_ = mask;
    }
    // The least change of the forces that restores balance, as far as these contacts can.
    void restore_balance() {
        constexpr double SHIFT = 1e-9;  // of the largest entry: two contacts cannot turn the object about the line between them
        Packed6 gram{};
        Vec6 missed = wrench;
        const auto column = [&](int i, int a) { return unit_wrench(seen().points[i], axis(i, a)); };
        touching([&](int i) {
            for (int a = 0; a < 3; ++a) missed = missed + force[3 * i + a] * column(i, a), add_gram(gram, column(i, a));
        });
        double largest = 0.0;
        for (int r = 0; r < 6; ++r) largest = std::max(largest, gram[packed(r, r)]);
        for (int r = 0; r < 6; ++r) gram[packed(r, r)] += SHIFT * largest;
        Ldl6 factor;
        if (!(factor.factor(gram) > 0.0)) return;
        const Vec6 pull = factor.solve(missed);
        touching([&](int i) {
            for (int a = 0; a < 3; ++a) force[3 * i + a] -= dot(column(i, a), pull);
        });
    }

    // --- torques

    // out (M,) = the torques that carry the hand and with which the fingers in contact push with forces (N, 3) [N], contact frames, and
    // their torsion. Forces of no finger: none.
    void torques_of(const double* forces, std::vector<double>& out) const {
        const Snapshot& s = seen();
        std::copy(s.gravity_torques.begin(), s.gravity_torques.end(), out.begin());
        touching([&](int i) {
            Point push{0.0, 0.0, 0.0};
            for (int k = 0; k < 3; ++k) push += forces[3 * i + k] * axis(i, k);
            s.posture.push(tree->tips[i].link, s.touch[i], s.rotation * push, out.data());
            if (torsion_[i] != 0.0) s.posture.twist(tree->tips[i].link, torsion_[i] * (s.rotation * axis(i, 0)), out.data());
        });
    }
    // Whether the motors can make the forces with a part of their limits, besides carrying the hand.
    bool fits(double part) {
        torques_of(force.data(), trial_);
        for (int j = 0; j < tree->joints(); ++j)
            if (!(std::abs(trial_[j]) <= part * tree->links[j].torque_limit)) return false;
        return true;
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
    // Torques within the motors' limits.
    void cut() {
        for (int j = 0; j < tree->joints(); ++j) {
            if (tree->links[j].coupled()) continue;
            const double limit = tree->links[j].torque_limit, asked = std::abs(torques[j]);
            effort.saturated = effort.saturated || asked > limit * (1.0 + ROUNDED);
            torques[j] = std::min(std::max(torques[j], -limit), limit);
            const double used = std::abs(torques[j]);
            peak = std::max(peak, used), effort.margin = std::min(effort.margin, limit - used);
            effort.share = std::max(effort.share, used / limit);
        }
    }

    // Spring and damper that bring tip i to its place inside the surface at its goal: the target's where nothing is optimised,
    // else carried by the object. World frame [N].
    Point reach(int i) const {
        const Snapshot& s = seen();
        const bool anchored = hold == Hold::place;
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
        for (int i = 0; i < tree->fingers(); ++i) s.posture.jacobian(tree->tips[i].link, s.tips[i], &posture_[3 * m * i]);
        for (int a = 0; a < rows; ++a) {
            push_[a] = 0.0;
            for (int j = 0; j < m; ++j) push_[a] += posture_[m * a + j] * pull_[j];
            for (int b = 0; b <= a; ++b) {
                normal_(a, b) = a == b ? 1e-10 : 0.0;
                for (int j = 0; j < m; ++j) normal_(a, b) += posture_[m * a + j] * posture_[m * b + j];
            }
        }
        if (!normal_.factor()) return;
        normal_.solve(push_.data());
        for (int j = 0; j < m; ++j) {
            extra_[j] = pull_[j];
            for (int a = 0; a < rows; ++a) extra_[j] -= posture_[m * a + j] * push_[a];
        }
        add_within();
    }
};

}  // namespace grasp
