// A contact is lost, and comes back: a pipeline for each set that may remain is made beforehand. The same in Python:
// examples/03_lost_contact.py.
#include <grasp/grasp.hpp>

#include <cmath>
#include <cstdio>
#include <exception>
#include <map>
#include <numbers>

// A thumb below, three fingers above; metres and unit vectors INTO the object.
constexpr double POSITIONS[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
constexpr double NORMALS[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};

grasp::Triples first(const double* of_all, int count) { return {of_all, std::size_t(3 * count)}; }

grasp::Pipeline made(int count) {
    return grasp::Pipeline(grasp::Contacts::from(first(POSITIONS, count), first(NORMALS, count), 0.4));
}

int main() {
    grasp::Pipeline three = made(3), four = made(4);  // set-up allocates and may throw; the loop does neither
    const std::map<int, const char*> events{
        {399, "four hold"}, {400, "one is lost"}, {401, "three hold"}, {600, "it is back"}, {601, "four hold"}};
    int before = 4;
    for (int tick = 0; tick < 1000; ++tick) {
        const int count = 400 <= tick && tick < 600 ? 3 : 4;
        grasp::Pipeline& pipeline = count == 3 ? three : four;
        if (count != before) pipeline.reset();  // what it held then is not held now
        before = count;
        const double turn = 2 * std::numbers::pi * 1e-3 * tick;
        const double wrench[] = {3 * std::sin(turn), 2 * std::cos(turn), 2, 0, 0, 0.02};  // [N, N m]
        const grasp::Record solution = pipeline.solve(first(POSITIONS, count), first(NORMALS, count), wrench);
        if (solution.code() != grasp::CONVERGED) return 1;

        const auto event = events.find(tick);
        if (event == events.end()) continue;
        std::printf("%d ms, %-11s %.0f iterations, normal forces [", tick, event->second, solution.summary().iterations);
        for (int i = 0; i < count; ++i) std::printf("%s%.3f", i ? " " : "", solution.force()[3 * i]);
        std::printf("] N\n");
    }
    try {  // what no force can balance is said when the contacts are made, not in the loop
        made(2);
    } catch (const std::exception& error) { std::printf("two remain, %s\n", error.what()); }
}
