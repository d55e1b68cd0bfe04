// Latencies of a million solves of each kind: `latency MODEL [CALLS]`. One line of each: name, then median, p99, p99.9 and largest
// [us] by the clock on the wall, and the same by the thread's own clock, which does not run while others have the processor.
#include <grasp/optimizer.hpp>

#include <time.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <random>

namespace {

double seconds(clockid_t clock) {
    timespec at;
    clock_gettime(clock, &at);
    return double(at.tv_sec) + 1e-9 * double(at.tv_nsec);
}

void print(std::vector<double>& all) {
    std::sort(all.begin(), all.end());
    for (const double p : {0.5, 0.99, 0.999, 1.0}) std::printf(" %.3f", all[std::size_t(p * double(all.size() - 1))]);
}

// call(k) solves the k-th problem; all but CONVERGED count as failed
template <class F> void measure(const char* name, int calls, F&& call) {
    std::vector<double> wall(calls), own(calls);
    int failed = 0;
    for (int k = 0; k < 20000 && k < calls; ++k) call(k);
    for (int k = 0; k < calls; ++k) {
        const double begin = seconds(CLOCK_MONOTONIC);
        const grasp::Code code = call(k);
        wall[k] = 1e6 * (seconds(CLOCK_MONOTONIC) - begin);
        failed += code != grasp::CONVERGED;
    }
    for (int k = 0; k < calls; ++k) {
        const double begin = seconds(CLOCK_THREAD_CPUTIME_ID);
        call(k);
        own[k] = 1e6 * (seconds(CLOCK_THREAD_CPUTIME_ID) - begin);
    }
    std::printf("%s %d", name, failed);
    print(wall), print(own);
    std::printf("\n");
    std::fflush(stdout);
}

}  // namespace

int main(int given, char** arguments) {
    if (given < 2) return 2;
    const int calls = given > 2 ? std::atoi(arguments[2]) : 1000000, many = 1000, count = 4;
    const double positions[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
    const double normals[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};
    const auto contacts = grasp::Contacts::from(positions, normals, 0.4);
    std::mt19937_64 random(1);
    std::normal_distribution<double> normal;
    // any wrench, and one that turns a little from call to call
    std::vector<std::array<double, 6>> loads(many), path(many);
    for (auto& load : loads)
        for (int r = 0; r < 6; ++r) load[r] = normal(random) * (r < 3 ? 1.0 : 0.03);
    for (int k = 0; k < many; ++k) {
        const double turn = 6.283185307179586 * k / many;
        path[k] = {std::sin(turn), 0.5 * std::cos(turn), -std::cos(turn), 0.02 * std::sin(turn), 0.02 * std::cos(turn), 0.0};
    }
    std::vector<std::vector<double>> points, directions;
    for (int k = 0; k < many; ++k) {
        points.emplace_back(positions, positions + 12), directions.emplace_back(normals, normals + 12);
        for (int i = 0; i < count; ++i) {
            const double phase = 6.283185307179586 * k / many + i;
            points[k][3 * i] += 0.001 * std::sin(phase);
            directions[k][3 * i] = std::sin(0.01 * std::sin(phase)), directions[k][3 * i + 2] *= std::cos(0.01 * std::sin(phase));
        }
    }
    std::vector<double> jacobian(12 * 12), torque(12, 0.6), bias(12, 0.01);
    const double levers[] = {0.06, 0.05, 0.03, 0.01, -0.02, -0.03, 0.05, 0.0, 0.0};
    for (int i = 0; i < count; ++i)
        for (int a = 0; a < 3; ++a)
            for (int j = 0; j < 3; ++j) jacobian[(3 * i + a) * 12 + 3 * i + j] = levers[3 * a + j];
    const grasp::ForceLimits limits{.jacobian = jacobian, .torque_limit = torque, .torque_bias = bias};

    const auto model = std::make_shared<const grasp::Model>(grasp::ModelFile::load(arguments[1]));
    const grasp::Options follows{.start = grasp::Start::previous}, learns{.start = grasp::Start::learned, .model = model};
    grasp::ForceOptimizer newton({contacts}), follow({contacts}, follows), conic({contacts}, {.method = grasp::Method::conic});
    grasp::ForceOptimizer limited({contacts, limits}), holding({contacts, limits}, follows), learned({contacts}, learns);
    const auto moved = [&](int k) { return grasp::Now{.positions = points[k % many], .normals = directions[k % many]}; };
    const auto some = [&](int k) {
        grasp::Now now = moved(k);
        now.contacts = 0b0111;
        return now;
    };
    measure("newton:", calls, [&](int k) { return newton.solve(loads[k % many]).code(); });
    measure("newton, previous:", calls, [&](int k) { return follow.solve(path[k % many]).code(); });
    measure("newton, moving contacts:", calls, [&](int k) { return newton.solve(loads[k % many], moved(k)).code(); });
    measure("previous, moving contacts:", calls, [&](int k) { return follow.solve(path[k % many], moved(k)).code(); });
    measure("previous, three of four:", calls, [&](int k) { return follow.solve(path[k % many], some(k)).code(); });
    measure("conic:", calls, [&](int k) { return conic.solve(loads[k % many]).code(); });
    measure("learned start:", calls, [&](int k) { return learned.forget(), learned.solve(loads[k % many]).code(); });
    measure("limits:", calls, [&](int k) { return limited.solve(loads[k % many]).code(); });
    measure("limits, previous:", calls, [&](int k) { return holding.solve(path[k % many]).code(); });
    measure("limits, moving contacts:", calls, [&](int k) {
        grasp::Now now = moved(k);
        now.jacobian = jacobian, now.torque_bias = bias;
        return holding.solve(path[k % many], now).code();
    });
}
