// Eight threads make solvers of the same contacts and model at the same time, and solve: each has the bits of the others.
#include <grasp/grasp.hpp>

#include <cstdio>
#include <thread>

int main(int given, char** arguments) {
    if (given < 3) return 2;
    const int calls = std::atoi(arguments[2]);
    const double positions[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
    const double normals[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};
    const auto contacts = grasp::Contacts::from(positions, normals, 0.4);
    const grasp::Model model = grasp::ModelFile::load(arguments[1]);
    const std::vector<double> most(4, 8.0);
    std::vector<std::vector<double>> said(8);
    std::vector<std::thread> threads;
    for (auto& mine : said)
        threads.emplace_back([&] {
            grasp::Newton newton(contacts);
            grasp::Conic conic(contacts);
            grasp::Learned learned(contacts, model);
            grasp::Pipeline pipeline(contacts);
            grasp::LimitedNewton limited(contacts, {.max_normal = most});
            const auto keep = [&](const grasp::Record& r) { mine.insert(mine.end(), r.force(), r.force() + 12); };
            for (int k = 0; k < calls; ++k) {
                const double turn = 0.1 * k, wrench[6] = {std::sin(turn), std::cos(turn), -1.0, 0.02 * std::sin(turn), 0.0, 0.01};
                keep(newton.solve(wrench)), keep(newton.follow(wrench)), keep(conic.solve(wrench)), keep(learned.solve(wrench));
                keep(pipeline.solve(positions, normals, wrench)), keep(limited.follow(wrench));
            }
        });
    for (auto& thread : threads) thread.join();
    for (const auto& mine : said)
        if (mine != said[0]) return 1;
    std::printf("%zu\n", said[0].size());
}
