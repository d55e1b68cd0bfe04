// A hand of four fingers around a cube, without a simulator: control ticks as a loop makes them.
#include <random>

#include <grasp/hand/controller.hpp>
#include <grasp/hand/reach.hpp>
#include <grasp/phi/basis.hpp>

#include "allocations.hpp"
#include <nanobind/stl/vector.h>

#include "module.hpp"

using namespace grasp;

namespace {

// Three joints a finger, across the links; `more` joints besides, for the rest posture.
std::shared_ptr<Tree> tree_of(int more) {
    auto tree = std::make_shared<Tree>();
    for (int finger = 0; finger < 4; ++finger)
        for (int j = 0; j < 3 + more; ++j) {
            const Point offset = j ? Point{0.0, -0.05, 0.0} : Point{finger % 2 ? 0.09 : -0.09, 0.12, finger < 2 ? 0.03 : -0.03};
            const Point axis = j == 0 ? Point{1.0, 0.0, 0.0} : Point{0.0, 0.0, 1.0};
            const int parent = j ? tree->joints() - 1 : -1;
            tree->links.push_back({parent, offset, {}, axis, 0.02, {0.0, -0.02, 0.0}, -2.0, 2.0, 3.0});
            if (j == 2 + more) tree->tips.push_back({tree->joints() - 1, {0.0, -0.03, 0.0}, 0.01});
        }
    return tree;
}

struct Trial {
    std::shared_ptr<Tree> tree;
    std::shared_ptr<Scene> scene;
    std::unique_ptr<Pipeline> pipeline;
    std::unique_ptr<Controller> controller;
    std::vector<double> reading, noise, record;
    int ticks = 0;
    double sum = 0.0;  // of all torques, so that nothing is left out

    Trial(int more, bool late) : tree(tree_of(more)) {
        scene = std::make_shared<Scene>(tree, Surface{Cuboid{{0.05, 0.05, 0.05}}}, Point{0.0, -9.81, 0.0});
        double places[12], inwards[12], scale[12], weights[8];
        for (int i = 0; i < 4; ++i) {
            const double side = i % 2 ? 0.05 : -0.05, z = i < 2 ? 0.03 : -0.03;
            const double place[] = {side, i == 3 ? 0.02 : 0.0, z}, inward[] = {-side / 0.05, 0.0, 0.0}, cone[] = {0.6, 1.0, 1.0};
            std::copy(place, place + 3, places + 3 * i), std::copy(inward, inward + 3, inwards + 3 * i);
            std::copy(cone, cone + 3, scale + 3 * i);
            weights[2 * i] = 1.0, weights[2 * i + 1] = 0.01;
        }
        const Contacts contacts = Contacts::checked(4, places, inwards, scale, weights);
        std::vector<double> basis(13 * 12), reference(12 * 6);
        NewtonOn<Lanes<1>, 0> newton(4, {1e-6, 100});
        newton.cones.pack(contacts);
        newton.internal_force(), make_basis(newton, false);
        for (int k = 0; k < 13; ++k) newton.cones.store(newton.starter.basis[k], &basis[12 * k]);
        pipeline = Pipeline::make(contacts, {1e-6, 100}, basis.data(), contacts.frames.data(), false, reference.data(), nullptr);
        ControlSettings settings;
        settings.body.mass = 0.2, settings.body.position_gain = 100.0, settings.body.position_damping = 8.0;
        settings.body.rotation_gain = 400.0, settings.body.rotation_damping = 40.0, settings.friction = 0.6;
        for (int k = 0; k < 3; ++k)
            settings.body.inertia.rows[k] = Point{k == 0 ? 1e-4 : 0.0, k == 1 ? 1e-4 : 0.0, k == 2 ? 1e-4 : 0.0};
        settings.reach.assign(4, {60.0, 2.0, 1.0}), settings.spring = {800.0, 4.0, infinity};
        settings.posture.assign(tree->joints(), {0.01, 0.001}), settings.most_change = 0.05, settings.reach_depth = 0.005;
        SensorSettings sensors;
        sensors.tick = 0.004, sensors.keep = 0.5;
        if (late)
            sensors.wrench = WrenchSource::estimated, sensors.delay = 2, sensors.pose_noise = 1e-5, sensors.tactile_noise = 0.02;
        controller = std::make_unique<Controller>(scene, settings, sensors);
        for (int i = 0; i < 4; ++i) controller->goals[i] = point(places + 3 * i), controller->inwards[i] = point(inwards + 3 * i);
        for (std::uint64_t which : {0, 3, 7, 15}) controller->add_set(which, which == 15 ? pipeline.get() : nullptr);
        reading.resize(Reading::size(tree->joints(), 4));
        noise.resize(15), record.resize(record_size(4));
        read();
        controller->reset();
    }

    // The next of a sequence: all wander a little, and now and then a finger loses its force.
    void read() {
        const int m = tree->joints();
        for (int j = 0; j < m; ++j)
            reading[j] = 0.3 * std::sin(0.1 * ticks + j), reading[m + j] = 0.1 * std::cos(0.1 * ticks + j);
        BodyRow body{{1e-3 * std::sin(0.03 * ticks), 0.0, 0.0}, {0.0, 0.0, 0.0, 1.0}, {0.01, 0.0, 0.0}, {0.0, 0.1, 0.0}};
        const double turn = 0.02 * std::sin(0.05 * ticks);
        body.quaternion[2] = std::sin(turn), body.quaternion[3] = std::cos(turn);
        std::memcpy(&reading[2 * m], &body, sizeof body);
        for (int i = 0; i < 4; ++i) {
            const Point touch = scene->now.touch[i];
            const double force = ticks % 50 > 40 && i > 1 ? 0.0 : 2.0;
            const ContactRow row{double(tree->tips[i].link), touch, {i % 2 ? -force : force, 0.1 * force, 0.0}};
            std::memcpy(&reading[2 * m + Reading::BODY + Reading::CONTACT * i], &row, sizeof row);
        }
        scene->read(reading.data(), reading.size());
    }

    void see() {
        read();
        Target target{};
        target.quaternion[3] = 1.0;
        const double wrench[] = {0.5, -0.2, 0.1, 0.01, 0.0, -0.01};
        ++ticks;
        for (std::size_t j = 0; j < noise.size(); ++j) noise[j] = std::sin(1.7 * ticks + double(j));
        controller->see(wrench, noise.data(), {{0.0, -9.81, 0.0}, target});
    }
    void tick() {
        see();
        if (ticks % 5 == 0 || controller->changed) give();
        controller->command();
        for (double torque : controller->torques) sum += torque;
        std::vector<double>& measured = record;
        Target target{};
        target.quaternion[3] = 1.0;
        sum += controller->outcome(target, measured.data()).drift;
    }

    void give() {
        const double forces[12] = {2.0, 0.1, 0.0, 2.0, 0.0, 0.1, 2.0, 0.0, 0.0, 2.0, 0.1, 0.0};
        if (controller->mask == 15) {
            const Snapshot& s = controller->seen();
            pipeline->solve({&s.points[0].u, &s.normals[0].u, controller->wrench.data()}, record.data());
            controller->give(Hold::optimised, 15, nullptr);
        } else {
            const Hold kinds[] = {Hold::lost, Hold::squeeze, Hold::direct, Hold::place};
            const std::uint64_t known = controller->has_set(controller->mask) ? controller->mask : 0;
            controller->give(kinds[ticks / 50 % 4], known, forces);
        }
    }
};

nb::tuple ticks(int count, int more, bool late) {
    Trial trial(more, late);
    for (int k = 0; k < 200; ++k) trial.tick();  // what is made once
    const long made = counted([&] {
        for (int k = 0; k < count; ++k) trial.tick();
    });
    return nb::make_tuple(made, trial.sum, trial.controller->repaired, trial.controller->changes, trial.controller->peak);
}

// Forces of 2 N and `shear` N along the surface, outside their cones where that is much, and then optimised ones: those of the first
// tick, and the given ones taken into their cones and carried to that tick, (4, 3) each.
nb::tuple landed(double shear) {
    Trial trial(0, false);
    auto& controller = *trial.controller;
    do trial.tick();
    while (trial.ticks < 200 || controller.mask != 15 || trial.ticks % 50 > 10);
    double given[12];
    for (int i = 0; i < 4; ++i) given[3 * i] = 2.0, given[3 * i + 1 + i % 2] = shear, given[3 * i + 2 - i % 2] = 0.1;
    trial.see(), controller.give(Hold::direct, 15, given), controller.command();
    std::vector<double> carried = controller.force;
    const std::vector<double> frames = controller.frames;
    for (int i = 0; i < 4; ++i) {
        double* f = &carried[3 * i];
        f[0] = std::max(f[0], 1.05 * std::hypot(f[1], f[2]) / controller.settings.friction);
    }
    trial.see(), trial.give();
    const Snapshot& s = controller.seen();
    const Load load{&s.points[0].u, &s.normals[0].u, controller.wrench.data()};
    controller.command();
    trial.pipeline->carry_from(load, carried.data(), frames.data(), carried.data());
    return nb::make_tuple(controller.force, carried);
}

// The worst miss of tips that were somewhere within the limits [m].
double reached(int count, int more, unsigned seed) {
    const auto tree = tree_of(more);
    Reach reach(tree);
    Posture posture(tree);
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> angle(-1.0, 1.0);
    std::vector<double> angles(tree->joints()), start(tree->joints()), found(tree->joints()), missed(reach.groups.size());
    double worst = 0.0;
    for (int k = 0; k < count; ++k) {
        for (double& a : angles) a = angle(random);
        for (std::size_t j = 0; j < start.size(); ++j) start[j] = angles[j] + 0.2 * angle(random);
        posture.trace(angles.data());
        std::vector<Point> targets;
        for (int i = 0; i < tree->fingers(); ++i) targets.push_back(posture.tip(i));
        reach.solve(targets.data(), start.data(), 1, found.data(), missed.data());
        for (double m : missed) worst = std::max(worst, m);
    }
    return worst;
}

}  // namespace

void bind_hand(nb::module_& m) {
    m.def("ticks", &ticks, "count"_a, "more"_a, "late"_a,
          "Control ticks of a hand with 3 + `more` joints a finger: allocations, the sum of all torques, repaired ticks, changes "
          "of the contacts, the largest torque.");
    m.def("landed", &landed, "shear"_a);
    m.def("reached", &reached, "count"_a, "more"_a, "seed"_a, "The worst miss of inverse kinematics [m].");
}
