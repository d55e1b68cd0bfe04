// Bytes make contacts, wrenches, options and a model's file, of which every solver of grasp.hpp is made and asked. It must not
// crash or hang, and what it calls a force must be balanced and inside the cones, whatever it was given.
//
//     clang++ -fsanitize=fuzzer,address,undefined ... fuzz.cpp   with libFuzzer
//     g++ -DGRASP_SEEDED ... fuzz.cpp; fuzz SEED COUNT           bytes by chance, everywhere
#include <grasp/grasp.hpp>

#include <cstdint>
#include <cstdio>
#include <cstdlib>

namespace {

using grasp::infinity;

class Bytes {
public:
    Bytes(const std::uint8_t* data, std::size_t size) : data_(data), left_(size) {}

    int whole(int least, int most) { return least + next() % (most - least + 1); }
    bool one_in(int many) { return whole(1, many) == many; }
    double fraction() { return (next() + 256.0 * next()) / 65535.0; }
    double signed_fraction() { return 2.0 * fraction() - 1.0; }
    // of this size; in a `wild` input now and then any number at all
    double number(double size) {
        if (!wild || !one_in(32)) return size * signed_fraction();
        constexpr double odd[] = {0.0, -0.0, infinity, -infinity, NAN, 1e308, -1e308, 5e-324, 1e-310, 1e12, 1.1e12, 1e-200, 1e20};
        if (one_in(2)) return odd[whole(0, int(std::size(odd)) - 1)];
        std::uint64_t bits = 0;
        for (int k = 0; k < 8; ++k) bits = 256 * bits + next();
        double out;
        std::memcpy(&out, &bits, sizeof out);
        return out;
    }
    double decades(double least, double most) { return least * std::pow(most / least, fraction()); }
    bool wild = false;
    const std::uint8_t* data() const { return data_; }
    std::size_t left() const { return left_; }

private:
    const std::uint8_t* data_;
    std::size_t left_;

    int next() { return left_ ? --left_, *data_++ : 0; }
};

std::vector<double> numbers(Bytes& from, int count, double size) {
    std::vector<double> out(count);
    for (double& value : out) value = from.number(size);
    return out;
}

[[noreturn]] void fail(const char* solver, const char* what, const grasp::Record& record, double value) {
    const auto& s = record.summary();
    std::fprintf(stderr, "%s: %s (%g); code %g, objective %g, bound %g, margin %g, residual %g\n", solver, what, value, s.code,
                 s.objective, s.lower_bound, s.margin, s.residual);
    std::abort();
}

constexpr double BALANCED =
    1e-6;  // part of wrench and forces; a solver is good to some 1e-12, of contacts nearly on a line to less
constexpr double INSIDE = 1e-9;    // part of a force by which conic forces may leave their cones: rounding

// What a record says of a force, looked at from outside; exact: strictly inside the cones.
void check(const char* solver, const grasp::Contacts& c, const double* wrench, const grasp::Record& record, bool exact) {
    using namespace grasp;
    const Summary& s = record.summary();
    if (!(record.code() >= CONVERGED && record.code() <= LIMITS_EXCEEDED)) fail(solver, "no code", record, s.code);
    if (record.code() == REFUSED) return;
    if (record.code() == INFEASIBLE) {
        for (const double v : s.multipliers)
            if (!(std::abs(v) < infinity)) fail(solver, "a proof of no numbers", record, v);
        return;
    }
    double most = 0.0;
    for (int j = 0; j < 3 * c.count; ++j) {
        if (!(std::abs(record.force()[j]) < infinity)) fail(solver, "a force that is no number", record, record.force()[j]);
        most += std::abs(record.force()[j]);
    }
    for (int i = 0; i < c.count; ++i) {
        double x[3];
        for (int a = 0; a < 3; ++a) x[a] = record.force()[3 * i + a] * c.scale[3 * i + a];
        const double depth = x[0] - std::hypot(x[1], x[2]);
        if (!(depth >= (exact ? 0.0 : -INSIDE * std::max(x[0], most)))) fail(solver, "outside a cone", record, depth);
    }
    Vec6 missed = c.unit.of(wrench), size{};
    for (int r = 0; r < 6; ++r) size[r] = std::abs(missed[r]);
    for (int j = 0; j < 3 * c.count; ++j)
        for (int r = 0; r < 6; ++r) {
            const double part = c.force_rows[3 * c.count * r + j] * record.force()[j];
            missed[r] += part, size[r] += std::abs(part);
        }
    if (!(grasp::size(missed) <= BALANCED * grasp::size(size))) fail(solver, "not balanced", record, grasp::size(missed));
    if (!(s.residual <= BALANCED * grasp::size(size))) fail(solver, "a residual", record, s.residual);
    if (record.code() == CONVERGED &&
        !(s.lower_bound > 0.0 && s.objective < infinity && s.objective >= (1.0 - 1e-6) * s.lower_bound))
        if (s.objective != 0.0 || exact) fail(solver, "converged, not certified", record, s.objective - s.lower_bound);
    if (record.code() == LIMITS_EXCEEDED && !(s.limit_excess > 0.0)) fail(solver, "no excess", record, s.limit_excess);
}

struct Problem {
    int count;
    std::vector<double> positions, normals, friction;
    grasp::Objective objective;
    grasp::Options options;

    explicit Problem(Bytes& from) : count(from.whole(2, from.one_in(4) ? 18 : 6)) {
        from.wild = from.one_in(2);
        const double far = from.one_in(4) ? 1.0 : 0.0, thin = from.one_in(4) ? from.decades(1e-6, 1.0) : 1.0;
        for (int i = 0; i < count; ++i) {
            double at[3], length = 0.0;
            for (double& v : at) v = from.signed_fraction(), length += v * v;
            length = std::sqrt(length) + 1e-9;
            for (int a = 0; a < 3; ++a) {
                positions.push_back(far + 0.05 * at[a] / length * (a == 1 ? thin : 1.0) + from.number(1e-4));
                normals.push_back(-at[a] / length);
            }
            double* normal = &normals[3 * i];
            normal[0] += 0.3 * from.signed_fraction();
            const double size = std::hypot(normal[0], normal[1], normal[2]);
            for (int a = 0; a < 3; ++a) normal[a] /= size > 0.0 ? size : 1.0;
            if (from.wild && from.one_in(64)) normal[from.whole(0, 2)] = from.number(1.0);
        }
        for (int i = 0; i < (from.one_in(2) ? 1 : from.one_in(2) ? count : 2 * count); ++i)
            friction.push_back(from.wild && from.one_in(8) ? std::abs(from.number(1.0)) : from.decades(0.05, 3.0));
        if (from.one_in(4)) objective = {from.decades(1e-4, 1e4), from.decades(1e-16, 1e6)};
        if (from.one_in(4)) options.tolerance = from.decades(1e-14, 1.0);
        if (from.one_in(8)) options.limit = from.whole(0, 200);
        if (from.wild && from.one_in(16)) options.tolerance = from.number(1.0);
    }
};

struct Load {
    double w[6];
    explicit Load(Bytes& from) {
        const double size = from.one_in(4) ? from.decades(1e-12, 1e9) : 5.0;
        for (int r = 0; r < 6; ++r) w[r] = from.number(r < 3 ? size : 0.05 * size);
    }
};

template <class Solver, class F> void ask(const char* name, Bytes& from, Solver& solver, bool exact, F&& call) {
    for (int round = from.whole(1, 4); round > 0; --round) {
        const Load load(from);
        check(name, solver.contacts(), load.w, call(load.w), exact);
        if (from.one_in(8)) solver.forget();
    }
}

grasp::Model small_model(Bytes& from, int count) {
    grasp::Model model;
    const int outputs = std::max(3 * count - 6, 1), sizes[] = {8, 3, outputs};
    const auto floats = [&](std::size_t many) {
        std::vector<float> out(many);
        for (float& v : out) v = from.left() ? float(from.signed_fraction()) : 0.1f;
        return out;
    };
    model.network = grasp::Network(sizes, floats(grasp::Network::numbers(sizes)).data());
    model.normalisation = {0.05, 0.2, 0.5, 1.3, 0.4, 0.12};
    model.friction = 0.4;
    for (int k = 0; k < 3 * count * outputs; ++k) model.null_space.push_back(k % 7 == 0 ? 0.5 : 0.0);
    return model;
}

void run(Bytes& from) {
    using namespace grasp;
    const int kind = from.whole(0, 7);
    if (kind == 7) {
        const std::string_view bytes(reinterpret_cast<const char*>(from.data()), from.left());
        if (ModelFile::read(bytes)) std::abort();  // one in 2^64 hashes
        if (ModelFile::body(bytes) && bytes.size() < 14 * sizeof(double)) std::abort();
        return;
    }
    const Problem p(from);
    const Contacts c = Contacts::from(p.positions, p.normals, p.friction, p.objective);
    if (kind == 0) {
        Newton newton(c, p.options);
        ask("newton", from, newton, true, [&](Wrench w) { return from.one_in(2) ? newton.solve(w) : newton.follow(w); });
        const auto start = numbers(from, 3 * c.count, 5.0);
        const Load load(from);
        check("newton from", c, load.w, newton.from(load.w, start), true);
    } else if (kind == 1) {
        Conic conic(c, {p.options.tolerance, from.whole(0, 100)});
        ask("conic", from, conic, false, [&](Wrench w) { return conic.solve(w); });
    } else if (kind == 2 || kind == 3) {
        const int joints = 3 * c.count;
        std::vector<double> jacobian(3 * c.count * joints), least, most, torque, bias = numbers(from, joints, 0.05);
        for (int i = 0; i < c.count; ++i)
            for (int k = 0; k < 9; ++k) jacobian[(3 * i + k / 3) * joints + 3 * i + k % 3] = from.number(0.06);
        for (int j = 0; j < joints; ++j)
            torque.push_back(from.wild && from.one_in(16) ? from.number(1.0) : from.decades(1e-3, 10.0));
        if (from.one_in(2)) most = numbers(from, c.count, 1.0);
        for (double& v : most) v = std::abs(v) * 20.0 + 0.1;
        if (from.one_in(2)) least = numbers(from, c.count, 0.1);
        const ForceLimits limits{least, most, jacobian, torque, bias};
        LimitedNewton limited(c, limits, kind == 2 ? Limits::elastic : Limits::strict, p.options);
        ask("limited", from, limited, true, [&](Wrench w) {
            if (from.one_in(4)) {
                auto moved = p.positions;
                for (double& v : moved) v += from.number(from.one_in(8) ? 0.05 : 1e-3);
                limited.move(moved, p.normals, limits);
            }
            const Record record = from.one_in(2) ? limited.solve(w) : limited.follow(w);
            if (record.code() == CONVERGED && record.summary().limit_excess > 0.0)
                fail("limited", "exceeds limits", record, record.summary().limit_excess);
            return record;
        });
    } else if (kind == 4) {
        Pipeline pipeline(c, p.options);
        ask("pipeline", from, pipeline, true, [&](Wrench w) {
            auto points = p.positions;
            for (double& v : points) v += from.number(from.one_in(8) ? 0.05 : 1e-3);
            return pipeline.solve(points, p.normals, w);
        });
    } else {
        const std::string bytes = ModelFile::write(small_model(from, c.count));
        std::string body = bytes.substr(16);
        for (int k = from.whole(0, 4); k > 0; --k) {
            const std::size_t at = (256 * from.whole(0, 255) + from.whole(0, 255)) % body.size();
            body[at] = char(from.whole(0, 255));
        }
        const std::optional<Model> model = ModelFile::body(body);
        if (!model || !model->fits(c.count)) return;
        if (ModelFile::write(*model).substr(16) != body) std::abort();
        Learned learned(c, *model, p.options);
        ask("learned", from, learned, true, [&](Wrench w) { return from.one_in(2) ? learned.solve(w) : learned.follow(w); });
    }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    Bytes from(data, size);
    try {
        run(from);
    } catch (const std::invalid_argument&) {  // set-up said what is wrong
    }
    return 0;
}

#ifdef GRASP_SEEDED
int main(int given, char** arguments) {
    if (given != 3) return 2;
    std::uint64_t state = std::strtoull(arguments[1], nullptr, 10) * 2 + 1;
    const long count = std::atol(arguments[2]);
    std::vector<std::uint8_t> bytes;
    for (long k = 0; k < count; ++k) {
        bytes.resize(700);
        for (std::uint8_t& byte : bytes)
            state = state * 6364136223846793005u + 1442695040888963407u, byte = std::uint8_t(state >> 56);
        std::FILE* last = std::getenv("GRASP_FUZZ_LAST") ? std::fopen(std::getenv("GRASP_FUZZ_LAST"), "wb") : nullptr;
        if (last) std::fwrite(bytes.data(), 1, bytes.size(), last), std::fclose(last);
        LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
    }
    std::printf("%ld\n", count);
}
#endif
