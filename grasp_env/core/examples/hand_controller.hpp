// A controller for a torque-controlled hand: joint state, contacts and a wrench go in; commands in the units of the motors come out. It
// has the life cycle that robot middleware asks of controllers, without any middleware: copy it and make it yours. `hand_controller.cpp`
// runs it. The same in Python: examples/hand_controller.py.
#pragma once
#include <grasp/hand/tree_file.hpp>
#include <grasp/optimizer.hpp>

#include <chrono>
#include <numbers>

using Numbers = std::vector<double>;

// A message of a hand with M joints and N fingertips, in the frame of the hand's base.
struct HandState {
    Numbers angles, rates;  // (M,) [rad], [rad/s]
    Numbers touching;  // (N,) which fingertips touch: 1 or 0
    Numbers positions, normals;  // (N, 3) where they do [m], unit vectors into the object
    Numbers wrench;  // (6,) that the fingers balance: the object's weight and feedback on its pose [N, N m]
    Numbers gravity;  // (3,) [m/s^2]: the hand may be on an arm
    Numbers age;  // (1,) [s] since the contacts were measured

    explicit HandState(int m = 0, int n = 0)
        : angles(m), rates(m), touching(n), positions(3 * n), normals(3 * n), wrench(6), gravity(3), age(1) {}
};
constexpr Numbers HandState::* PARTS[] = {&HandState::angles,  &HandState::rates,  &HandState::touching, &HandState::positions,
                                          &HandState::normals, &HandState::wrench, &HandState::gravity,  &HandState::age};

// What is tuned for a hand and a task.
struct Settings {
    double friction = 0.8;
    double rate = 1000.0;  // [Hz] of `update`
    int iterations = 40;  // most steps of the solver in an update
    double budget = 1e-4;  // [s] of an update: longer ones are counted
    double damping = 0.01;  // [N m s/rad] of every joint
    double stiffness = 0.1;  // [N m/rad] towards the posture at `activate`, for joints that the fingertips leave free
    double push = 0.3;  // [N] of a finger without contact, along its last normal
    double slew = 50.0;  // [1/s] fastest change of a torque, as a part of its limit
    double stale = 0.005;  // [s] largest age of contacts that are solved for
    double grace = 0.1;  // [s] for which the last forces are kept without a solution
    double fade = 0.2;  // [s] in which they are then let go
};

// Torques [N m] to whole device units: for each joint piecewise linear between points, clipped at the outer ones.
struct Calibration {
    std::vector<Numbers> torques, units;  // of each joint: [N m] ascending from below zero to above it; as many

    double limit(int j) const { return std::min(-torques[j].front(), torques[j].back()); }  // reached in both directions
    double operator()(int j, double torque) const {
        double out = units[j][0];
        for (std::size_t k = 1; k < torques[j].size(); ++k) {
            const double from = torques[j][k - 1], width = torques[j][k] - from;
            out += (units[j][k] - units[j][k - 1]) / width * std::clamp(torque - from, 0.0, width);
        }
        return std::nearbyint(out);
    }
};

// `configure` allocates and may throw, the others never do. Inactive: no torque. Holding: forces that balance the wrench. Overloaded:
// those that exceed the motors' limits least. Coasting: the last forces, as contacts are stale, numbers broken or no force balances.
// Released: the hand carries itself.
class HandController {
public:
    enum Status { inactive, holding, overloaded, coasting, released } status = inactive;
    Numbers torques, commands;  // (M,) [N m], device units
    double duration = 0.0;  // [s] of the last update
    int late = 0, over_budget = 0;  // updates after a missed deadline; that took longer than the budget

    void configure(std::shared_ptr<const grasp::Tree> hand, const Settings& settings, const Calibration& calibration) {
        const int m = hand->joints(), n = hand->fingers();
        hand_ = hand, s_ = settings, calibration_ = calibration, posture_.emplace(hand), now_ = HandState(m, n);
        torques = commands = home_ = limits_ = carry_ = seek_ = wanted_ = Numbers(m);
        forces_ = Numbers(3 * n), jacobian_ = Numbers(3 * n * m);
        for (int j = 0; j < m; ++j) limits_[j] = std::min(hand->links[j].torque_limit, calibration.limit(j));
        Numbers ring(3 * n), inward(3 * n);  // any N contacts: every call brings its own
        for (int i = 0; i < n; ++i) {
            inward[3 * i] = -std::cos(2 * std::numbers::pi * i / n), inward[3 * i + 1] = -std::sin(2 * std::numbers::pi * i / n);
            for (int a = 0; a < 2; ++a) ring[3 * i + a] = -0.03 * inward[3 * i + a];
        }
        const auto contacts = grasp::Contacts::from(ring, inward, s_.friction);
        solver_.emplace(grasp::Problem{contacts, {.jacobian = jacobian_, .torque_limit = limits_}},
                        grasp::Options{.start = grasp::Start::previous, .limit = s_.iterations, .elastic = true});
        deactivate();
    }
    // Begins where the hand is; torques rise from none.
    void activate(const HandState& state) {
        now_ = state, home_ = state.angles, blind_ = grasp::infinity, late = over_budget = 0;
        solver_->forget();
        status = released;
    }
    // From now on no torque is commanded.
    void deactivate() { status = inactive, std::fill(torques.begin(), torques.end(), 0.0); }
    // Fills `commands`. state: the newest, however old; period: [s] since the last update.
    void update(const HandState& state, double period) noexcept {
        const auto begin = std::chrono::steady_clock::now();
        if (status != inactive) late += period > 1.9 / s_.rate, take(state, period), command(period);
        for (std::size_t j = 0; j < torques.size(); ++j) commands[j] = calibration_(int(j), torques[j]);
        duration = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
        over_budget += duration > s_.budget;
    }

private:
    std::shared_ptr<const grasp::Tree> hand_;
    Settings s_;
    Calibration calibration_;
    std::optional<grasp::Posture> posture_;
    std::optional<grasp::ForceOptimizer> solver_;
    HandState now_;  // the last good message; a finger without contact keeps its last
    double blind_ = 0.0;  // [s] without a solution
    Numbers home_, limits_, carry_, seek_, wanted_, forces_, jacobian_;

    void take(const HandState& state, double period) {
        bool good = true;
        for (auto part : PARTS) {
            good = good && (state.*part).size() == (now_.*part).size();
            for (double value : state.*part) good = good && std::isfinite(value);
        }
        now_.age[0] += period;
        if (!good) return;
        for (auto part : PARTS)
            if (part != &HandState::positions && part != &HandState::normals) now_.*part = state.*part;
        for (std::size_t k = 0; k < forces_.size(); ++k)
            if (now_.touching[k / 3] != 0.0) now_.positions[k] = state.positions[k], now_.normals[k] = state.normals[k];
    }
    // torques += those with which a fingertip pushes
    void push(std::size_t i, const grasp::Point& force, Numbers& torques) const {
        posture_->push(hand_->tips[i].link, grasp::point(&now_.positions[3 * i]), force, torques.data());
    }
    void command(double period) {
        posture_->statics(now_.angles.data(), now_.positions, grasp::point(now_.gravity.data()), jacobian_, carry_);
        for (std::size_t j = 0; j < torques.size(); ++j) {
            carry_[j] -= s_.damping * now_.rates[j];
            seek_[j] = s_.stiffness * (home_[j] - now_.angles[j]);
        }
        std::uint64_t touching = 0;
        for (std::size_t i = 0; i < now_.touching.size(); ++i)
            if (now_.touching[i] != 0.0) touching |= std::uint64_t(1) << i;
            else push(i, s_.push * grasp::point(&now_.normals[3 * i]), seek_);
        for (std::size_t j = 0; j < torques.size(); ++j) wanted_[j] = carry_[j] + seek_[j];
        const grasp::Now contacts{now_.positions, now_.normals, {}, jacobian_, wanted_, touching};
        const bool fresh = now_.age[0] <= s_.stale;
        const grasp::Record* found = fresh ? &solver_->solve(grasp::Wrench(now_.wrench), contacts) : nullptr;
        if (found && found->has_force()) {
            blind_ = 0.0, status = found->code() == grasp::LIMITS_EXCEEDED ? overloaded : holding;
            for (int i = 0; i < found->contacts(); ++i) found->object_force(i, &forces_[3 * i]);
            std::copy_n(found->torques(), torques.size(), wanted_.begin());
        } else {
            // The object was in balance a moment ago: the same forces hold it until contacts have moved or the load has changed.
            // Later a hand that does not know what it holds must not go on to squeeze it: forces fade.
            blind_ += period;
            const double share = std::clamp(1.0 - (blind_ - s_.grace) / s_.fade, 0.0, 1.0);
            for (std::size_t i = 0; i < now_.touching.size(); ++i) push(i, grasp::point(&forces_[3 * i]), seek_);
            for (std::size_t j = 0; j < torques.size(); ++j) wanted_[j] = carry_[j] + share * seek_[j];
            status = share > 0.0 ? coasting : released;
        }
        for (std::size_t j = 0; j < torques.size(); ++j) {  // a missed deadline does not make torques jump
            const double most = s_.slew * std::min(period, 2.0 / s_.rate) * limits_[j];
            const double next = std::clamp(wanted_[j], torques[j] - most, torques[j] + most);
            torques[j] = std::clamp(next, -limits_[j], limits_[j]);
        }
    }
};
