// A control loop at 1 kHz: four fingers hold a cuboid that is turned, their contacts roll a little, one is lost and comes back,
// twelve joints have limits. Beside it, how fast a learned start answers what is far from the last wrench.
//
//     controller four_finger.model          paced, 5 s; the model: `LearnedInitialForce.pretrained("four_finger").export(...)`
//     controller four_finger.model 1000000  as many ticks, one after the other
//
// The same in Python: controller.py.
#include <grasp/grasp.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <thread>

using Clock = std::chrono::steady_clock;
constexpr int FINGERS = 4, JOINTS = 3, LOST = 3;  // each finger has joints of its own; which contact is lost
constexpr double FRICTION = 0.4, TORQUE = 0.4, WEIGHT = 6.0;  // [-], [N m], [N]
// A thumb below, three fingers above; object frame.
constexpr double POSITIONS[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};  // [m]
constexpr double NORMALS[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};                                // into the object
// Of one finger: joint speeds -> velocity of its contact point, contact frame [m]; what its weight asks of the joints [N m].
constexpr double LEVERS[] = {0.06, 0.05, 0.03, 0.01, -0.02, -0.03, 0.05, 0.0, 0.0}, BIAS[] = {0.02, 0.01, 0.005};

// Microseconds of one kind of call.
class Latency {
public:
    Latency(const char* of, int ticks) : of_(of) { all_.reserve(ticks); }
    template <class F> auto operator()(F&& call) {
        const auto begin = Clock::now();
        const auto result = call();
        all_.push_back(std::chrono::duration<double, std::micro>(Clock::now() - begin).count());
        return result;
    }
    void print() {
        std::sort(all_.begin(), all_.end());
        const auto part = [&](double p) { return all_[std::size_t(p * double(all_.size() - 1))]; };
        std::printf("\n%s: %zu calls, median %.2f us, p99 %.2f, p99.9 %.2f, max %.2f\n", of_, all_.size(), part(0.5), part(0.99),
                    part(0.999), part(1.0));
        double low = 0.0;
        for (double high = 0.25; low < part(1.0); low = high, high *= 2.0) {
            const auto in = std::lower_bound(all_.begin(), all_.end(), high) - std::lower_bound(all_.begin(), all_.end(), low);
            if (in > 0)
                std::printf("%8.2f us |%.*s %td\n", high, 1 + int(50 * in / std::ptrdiff_t(all_.size())),
                            "###################################################", in);
        }
    }

private:
    const char* of_;
    std::vector<double> all_;
};

// Contacts and wrench at a time [s].
struct World {
    double positions[3 * FINGERS], normals[3 * FINGERS], wrench[6];

    explicit World(double time) {
        for (int i = 0; i < FINGERS; ++i) {  // rolling: a millimetre, a hundredth of a radian
            const double phase = 6.0 * time + i, tilt = 0.01 * std::sin(phase);
            std::copy_n(POSITIONS + 3 * i, 3, positions + 3 * i);
            positions[3 * i] += 0.001 * std::sin(phase), positions[3 * i + 1] += 0.001 * std::cos(phase);
            normals[3 * i] = std::sin(tilt), normals[3 * i + 1] = 0.0, normals[3 * i + 2] = NORMALS[3 * i + 2] * std::cos(tilt);
        }
        const double turn = 2.0 * time;  // the object's weight, as it turns; it hangs a little off its middle
        const double force[] = {0.5 * WEIGHT * std::sin(turn), 0.3 * WEIGHT * std::cos(turn), -WEIGHT * std::cos(0.5 * turn)};
        std::copy_n(force, 3, wrench);
        wrench[3] = 0.01 * force[1], wrench[4] = -0.01 * force[0], wrench[5] = 0.02 * std::sin(turn);
    }
};

// The solvers of the first `count` contacts. Everything is made beforehand, also for those that stay when a contact is lost.
class Hand {
public:
    explicit Hand(int count)
        : count_(count), jacobian_(3 * count * JOINTS * count), torque_(JOINTS * count, TORQUE), bias_(JOINTS * count),
          contacts_(grasp::Contacts::from(first(POSITIONS), first(NORMALS), FRICTION)), limits_(filled()), free(contacts_),
          limited(contacts_, limits_) {}

    grasp::Triples first(const double* of_all) const { return {of_all, std::size_t(3 * count_)}; }
    bool move(const World& now) { return limited.move(first(now.positions), first(now.normals), limits_); }
    const grasp::Contacts& contacts() const { return contacts_; }

private:
    int count_;
    std::vector<double> jacobian_, torque_, bias_;  // (N, 3, J), (J,), (J,) with J = 3N: what `ForceLimits` looks at
    grasp::Contacts contacts_;
    grasp::ForceLimits limits_;

    grasp::ForceLimits filled() {
        for (int i = 0; i < count_; ++i)
            for (int j = 0; j < JOINTS; ++j) {
                bias_[JOINTS * i + j] = BIAS[j];
                for (int a = 0; a < 3; ++a) jacobian_[(3 * i + a) * JOINTS * count_ + JOINTS * i + j] = LEVERS[JOINTS * a + j];
            }
        return {.jacobian = jacobian_, .torque_limit = torque_, .torque_bias = bias_};
    }

public:
    grasp::Pipeline free;          // without limits
    grasp::LimitedNewton limited;  // within the joints' torques
};

int main(int given, char** arguments) try {
    if (given < 2) throw std::invalid_argument("usage: controller MODEL [TICKS]");
    const bool paced = given < 3;
    const int ticks = paced ? 5000 : std::atoi(arguments[2]);
    Hand all(FINGERS), rest(LOST);
    grasp::Learned learned(all.contacts(), grasp::ModelFile::load(arguments[1]));
    Latency free("Newton, moving contacts", ticks), limited("Newton within torque limits", ticks), far("learned start", ticks);
    const Hand* before = &all;
    int exceeded = 0, unsolved = 0, proven = 0;
    auto next = Clock::now();
    for (int tick = 0; tick < ticks; ++tick) {
        const double time = 1e-3 * tick;
        const World now(time);
        Hand& hand = tick % 1000 >= 400 && tick % 1000 < 600 ? rest : all;
        if (&hand != before) hand.limited.forget(), hand.free.forget();  // what was held then is not held now
        before = &hand;

        const auto force = free([&] { return hand.free.solve(hand.first(now.positions), hand.first(now.normals), now.wrench); });
        const auto kept = limited([&] { return hand.move(now) ? hand.limited.follow(now.wrench) : force; });
        // The joints get tau = J^T f + bias of `kept`. Where no force keeps the limits it is the one least beyond them: a hand would
        // slow down then. REFUSED does not come with sound numbers; then `hand.limited.last()` goes on.
        exceeded += kept.summary().limit_excess > 0.0;
        unsolved += kept.code() == grasp::REFUSED || force.code() != grasp::CONVERGED;

        const double knock[] = {5.0 * std::cos(7.0 * tick), 5.0 * std::sin(11.0 * tick), now.wrench[2], 0.0, 0.0, 0.1};
        proven += far([&] { return learned.solve(knock); }).code() == grasp::CONVERGED;
        if (paced) std::this_thread::sleep_until(next += std::chrono::milliseconds(1));
    }
    std::printf("%d ticks: %d beyond torque limits, %d unsolved, %d knocks answered\n", ticks, exceeded, unsolved, proven);
    free.print(), limited.print(), far.print();
    return unsolved > 0;
} catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 2;
}
