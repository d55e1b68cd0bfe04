// A learned start: Newton from what a network predicts, far from the last wrench. The same in Python: examples/07_learned_start.py,
// where `LearnedInitialForce.pretrained().export("four.model", grasp)` makes the file:
//
//     07_learned_start four.model
#include <grasp/grasp.hpp>

#include <cstdio>
#include <exception>

// A thumb below, three fingers above; metres and unit vectors INTO the object.
constexpr double POSITIONS[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
constexpr double NORMALS[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};

int main(int given, char** arguments) try {
    if (given < 2) throw std::invalid_argument("usage: 07_learned_start MODEL");
    const auto contacts = grasp::Contacts::from(POSITIONS, NORMALS, 0.4);
    grasp::Newton newton(contacts);
    grasp::Learned learned(contacts, grasp::ModelFile::load(arguments[1]));  // a damaged file is refused
    for (double size : {0.5, 1.0, 2.0}) {
        const double wrench[] = {size, 0.5 * size, -0.6 * size, -0.01 * size, 0.02 * size, 0};  // [N, N m]
        const double steps = newton.solve(wrench).summary().iterations;
        const grasp::Record solution = learned.solve(wrench);  // certified as any other, whatever the weights say
        if (solution.code() != grasp::CONVERGED) return 1;
        std::printf("wrench x %.1f: %.0f Newton steps from the network, %.0f from the 12-basis; normal forces", size,
                    solution.summary().iterations, steps);
        for (int i = 0; i < 4; ++i) std::printf(" %.3f", solution.force()[3 * i]);
        std::printf(" N%s\n", learned.outside() ? ", outside the training range" : "");
    }
} catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 2;
}
