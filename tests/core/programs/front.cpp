// What test_front.py asks of grasp.hpp: `front MODEL CALLS` prints, a line each, how calls ended, and what they allocated.
#include <grasp/grasp.hpp>

#include <cstdio>
#include <cstdlib>
#include <new>

namespace {
long allocations = 0;
}  // namespace

void* operator new(std::size_t size) {
    ++allocations;
    if (void* made = std::malloc(size)) return made;
    throw std::bad_alloc();
}
void* operator new(std::size_t size, std::align_val_t alignment) {
    ++allocations;
    const std::size_t whole = (size + std::size_t(alignment) - 1) / std::size_t(alignment) * std::size_t(alignment);
    if (void* made = std::aligned_alloc(std::size_t(alignment), whole)) return made;
    throw std::bad_alloc();
}
void operator delete(void* made) noexcept { std::free(made); }
void operator delete(void* made, std::size_t) noexcept { std::free(made); }
void operator delete(void* made, std::align_val_t) noexcept { std::free(made); }
void operator delete(void* made, std::size_t, std::align_val_t) noexcept { std::free(made); }

namespace {

const double positions[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
const double normals[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1}, wrench[] = {1, 0.5, -0.6, -0.1, 0.2, 0};
const double none = std::numeric_limits<double>::quiet_NaN();

void print(const char* name, const grasp::Record& record) {
    std::printf("%s: %d %.12g %g", name, record.code(), record.summary().objective, record.summary().limit_excess);
    for (int i = 0; i < 12; ++i) std::printf(" %.9g", record.force()[i]);
    std::printf("\n");
}
template <class F> void refused(const char* name, F&& setup) {
    try {
        setup();
        std::printf("%s: no error\n", name);
    } catch (const std::invalid_argument& error) { std::printf("%s: %s\n", name, error.what()); }
}
template <class F> void counted(const char* name, int calls, F&& call) {
    const long before = allocations;
    int wrong = 0;
    for (int k = 0; k < calls; ++k) wrong += !call(k);
    std::printf("allocations of %s: %ld, wrong: %d\n", name, allocations - before, wrong);
}

}  // namespace

int main(int given, char** arguments) {
    if (given < 3) return 2;
    const int calls = std::atoi(arguments[2]);
    const auto contacts = grasp::Contacts::from(positions, normals, 0.4);
    const grasp::Options exact{.tolerance = 1e-9};
    const std::vector<double> jacobian(12 * 4, 0.05), most(4, 6.0), least(4, 0.5), torque(4, 0.2), bias(4, 0.01);
    std::vector<double> own(12 * 12);
    for (int i = 0; i < 4; ++i)
        for (int a = 0; a < 3; ++a)
            for (int j = 0; j < 3; ++j) own[(3 * i + a) * 12 + 3 * i + j] = 0.02 + 0.01 * ((a + 2 * j) % 3);
    const std::vector<double> each(12, 0.25), little(12, 0.1);
    const grasp::ForceLimits limits{.min_normal = least, .max_normal = most, .jacobian = own, .torque_limit = each};
    const grasp::ForceLimits tight{.jacobian = own, .torque_limit = little, .torque_bias = std::span(little).first(0)};

    const grasp::Model model = grasp::ModelFile::load(arguments[1]);
    grasp::Newton newton(contacts, exact);
    grasp::Conic conic(contacts);
    grasp::LimitedNewton limited(contacts, limits, grasp::Limits::elastic, exact), elastic(contacts, tight);
    grasp::LimitedNewton strict(contacts, tight, grasp::Limits::strict);
    grasp::Learned learned(contacts, model, exact);
    grasp::Pipeline pipeline(contacts, exact);
    print("newton", newton.solve(wrench));
    print("again", newton.follow(wrench));
    print("from", newton.from(wrench, std::vector<double>(newton.last().begin(), newton.last().end())));
    print("conic", conic.solve(wrench));
    print("limited", limited.solve(wrench));
    print("elastic", elastic.solve(wrench));
    print("strict", strict.solve(wrench));
    print("learned", learned.solve(wrench));
    print("pipeline", pipeline.solve(positions, normals, wrench));
    const double elliptic[] = {0.4, 0.6, 0.4, 0.6, 0.4, 0.6, 0.4, 0.6};
    grasp::Newton other(grasp::Contacts::from(positions, normals, elliptic, {2.0, 0.02}), exact);
    print("elliptic", other.solve(wrench));

    // refused: the last forces stay
    const double wrong[] = {1, 0, 0, 0, none, 0}, huge[] = {1e13, 0, 0, 0, 0, 0};
    std::printf("numbers %d %d %d\n", newton.solve(wrong).code(), newton.follow(huge).code(), conic.solve(wrong).code());
    std::printf("sizes %d %d %d\n", newton.from(wrench, newton.last().first(9)).code(), learned.follow(wrong).code(),
                pipeline.solve(std::span(positions).first(9), normals, wrench).code());
    std::vector<double> flat(normals, normals + 12), far(positions, positions + 12);
    flat[2] = none, far[5] = 1e300;
    std::printf("contacts %d %d\n", pipeline.solve(positions, flat, wrench).code(), pipeline.solve(far, normals, wrench).code());
    print("kept", newton.follow(wrench));
    const bool moved = limited.move(positions, flat, limits) || limited.move(positions, normals, {.min_normal = each}) ||
                       limited.move(positions, normals, {.max_normal = std::span(&none, 1)});
    std::printf("moved %d, then %d; ", moved, limited.follow(wrench).code());
    const bool back = limited.move(positions, normals, limits);
    std::printf("back %d, then %d\n", back, limited.follow(wrench).code());

    using grasp::Contacts;
    const std::span<const double> all(positions), up(normals);
    refused("two contacts", [&] { Contacts::from(all.first(6), up.first(6), 0.4); });
    refused("normals", [&] { Contacts::from(all, up.first(9), 0.4); });
    refused("length", [&] { Contacts::from(all, std::vector<double>(12, 1.0), 0.4); });
    refused("nan", [&] { Contacts::from(all, flat, 0.4); });
    refused("friction", [&] { Contacts::from(all, up, -0.4); });
    refused("weights", [&] { Contacts::from(all, up, 0.4, {.force_weight = 0.0}); });
    refused("nothing", [&] { Contacts::from({}, {}, 0.4); });
    std::vector<double> upward(12, 0.0);
    for (int i = 0; i < 4; ++i) upward[3 * i + 2] = 1.0;
    refused("closure", [&] { grasp::Newton(Contacts::from(all, upward, 0.4)); });
    refused("conic closure", [&] { grasp::Conic(Contacts::from(all, upward, 0.4)); });
    refused("shared joints", [&] { grasp::LimitedNewton(contacts, {.jacobian = jacobian, .torque_limit = torque}); });
    refused("jacobian", [&] { grasp::LimitedNewton(contacts, {.jacobian = own, .torque_limit = torque}); });
    refused("limits", [&] { grasp::LimitedNewton(contacts, {.max_normal = torque, .torque_bias = bias}); });
    refused("file", [&] { grasp::ModelFile::load("nowhere"); });
    refused("three", [&] { grasp::Learned(Contacts::from(all.first(9), up.first(9), 0.4), model); });

    const auto load = [](int k) {
        const double turn = 0.01 * k;
        return std::array<double, 6>{std::sin(turn), std::cos(turn), -1.0, 0.02 * std::cos(turn), 0.0, 0.01};
    };
    const auto point = [](int k) {
        std::array<double, 12> out;
        for (int j = 0; j < 12; ++j) out[j] = positions[j] + 0.0005 * std::sin(0.01 * k + j);
        return out;
    };
    const auto away = grasp::Contacts::from(point(50), normals, 0.4);
    grasp::LimitedNewton there(away, limits, grasp::Limits::elastic, exact);
    limited.move(point(50), normals, limits);
    print("limits there", there.solve(wrench)), print("limits moved there", limited.solve(wrench));
    print("limits followed there", limited.follow(wrench));
    print("there", grasp::Newton(away, exact).solve(wrench)), print("moved there", pipeline.solve(point(50), normals, wrench));
    const auto ended = [](const grasp::Record& record) { return record.code() == grasp::CONVERGED; };
    counted("newton", calls, [&](int k) { return ended(newton.solve(load(k))) && ended(newton.follow(load(k + 1))); });
    counted("conic", calls, [&](int k) { return ended(conic.solve(load(k))); });
    counted("learned", calls, [&](int k) { return ended(learned.solve(load(k))) && ended(learned.follow(load(k + 1))); });
    counted("pipeline", calls, [&](int k) { return ended(pipeline.solve(point(k), normals, load(k))); });
    counted("limited", calls,
            [&](int k) { return limited.move(point(k), normals, limits) && limited.follow(load(k)).summary().margin > 0.0; });
    counted("elastic", calls, [&](int k) { return elastic.solve(load(k)).summary().margin > 0.0; });
    counted("set-up", 1, [&](int) { return ended(grasp::Newton(contacts).solve(wrench)); });
}
