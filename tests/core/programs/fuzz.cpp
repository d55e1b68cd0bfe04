// Bytes make contacts, limits, options, calls and a model's file, of which `ForceOptimizer` is made and asked. It must not crash or hang,
// and what its records say of a force is computed here once more, plainly, from what was given.
//
//     clang++ -fsanitize=fuzzer,address,undefined ... fuzz.cpp   with libFuzzer
//     g++ -DGRASP_SEEDED ... fuzz.cpp; fuzz SEED COUNT           bytes by chance, everywhere
#include <grasp/hand/tree_file.hpp>
#include <grasp/optimizer.hpp>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <utility>

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

using namespace grasp;

// The contacts and limits of a call, all of them.
struct Given {
    int count = 0, joints = 0;
    std::vector<double> positions, normals, friction, along, gamma, least, most, jacobian, torque, bias;
    Objective objective;
    std::uint64_t contacts = ~std::uint64_t(0);

    bool touches(int i) const { return count >= 64 || contacts >> i & 1; }
    int moves() const { return joints ? int(jacobian.size()) / (count * joints) : 0; }
    bool limited() const { return !least.empty() || !most.empty() || joints; }
    double mu(int i, int axis) const {
        const std::size_t given = friction.size(), n = std::size_t(count);
        return given == 1 ? friction[0] : given == n ? friction[i] : friction[2 * i + axis];
    }
    bool slippery(int i) const { return !(mu(i, 0) > 0.0 && mu(i, 1) > 0.0); }
    double torsion(int i) const { return gamma.empty() ? 0.0 : gamma[i]; }
    // Whether contacts and joints are of this world, so that doubles tell what is within limits and optimal.
    bool has_digits() const {
        const auto large = [](double most) { return [most](double v) { return std::abs(v) > most; }; };
        const auto tiny = [](double mu) { return mu > 0.0 && mu < 1e-9; };
        return !std::ranges::any_of(positions, large(100.0)) && !std::ranges::any_of(jacobian, large(1e6)) &&
               !std::ranges::any_of(friction, tiny) && !std::ranges::any_of(friction, large(1e9));
    }
    ForceLimits limits() const { return {least, most, jacobian, torque, bias}; }
};

const char* asked = "";  // what was called

[[noreturn]] void fail(const char* what, const Record& record, double value) {
    const auto& s = record.summary();
    std::fprintf(
        stderr,
        "%s: %s (%g); code %g, start %g, objective %.17g, bound %.17g, margin %g, residual %g, excess %g, iterations %g\n", asked,
        what, value, s.code, s.start, s.objective, s.lower_bound, s.margin, s.residual, s.limit_excess, s.iterations);
    std::abort();
}

constexpr double BALANCED =
    1e-6;  // part of wrench and forces; a solver is good to some 1e-12, of contacts nearly on a line to less
constexpr double INSIDE = 1e-9;  // part of a force by which conic forces may leave their cones: rounding
constexpr double ROUNDING = 1e-11;  // part of what is added up

struct Sum {
    double value = 0.0, size = 0.0;
    void operator+=(double part) { value += part, size += std::abs(part); }
    bool is(double other) const { return std::abs(value - other) <= ROUNDING * size + 1e-300; }
};

// Where the contacts that touch are, and how far from each other.
struct Around {
    double centre[3] = {}, spread = 0.0;
    explicit Around(const Given& g) {
        int touching = 0;
        for (int i = 0; i < g.count; ++i) touching += g.touches(i);
        for (int j = 0; j < 3 * g.count; ++j)
            if (g.touches(j / 3)) centre[j % 3] += g.positions[j] / touching;
        for (int i = 0; i < g.count; ++i) {
            double far[3];
            for (int a = 0; a < 3; ++a) far[a] = g.positions[3 * i + a] - centre[a];
            if (g.touches(i)) spread = std::max(spread, std::hypot(far[0], far[1], far[2]));
        }
    }
};
void cross(const double* a, const double* b, double* out) {
    for (int r = 0; r < 3; ++r) out[r] = a[(r + 1) % 3] * b[(r + 2) % 3] - a[(r + 2) % 3] * b[(r + 1) % 3];
}

// INFEASIBLE without limits: a twist to which no force within friction does work, but the wrench does.
void check_proof(const Given& g, const double* wrench, const Record& record) {
    const Vec6& twist = record.summary().multipliers;
    const Around at(g);
    double there[3], power = 0.0, load = 0.0;
    cross(&twist[3], at.centre, there);
    for (int a = 0; a < 3; ++a) there[a] += twist[a];
    double moment[3], size = std::hypot(there[0], there[1], there[2]) + at.spread * std::hypot(twist[3], twist[4], twist[5]);
    cross(at.centre, wrench, moment);
    for (int a = 0; a < 3; ++a) {
        power += there[a] * wrench[a] + twist[3 + a] * (wrench[3 + a] - moment[a]);
        load += std::abs(wrench[a]) + std::abs(wrench[3 + a] - moment[a]) / at.spread;
    }
    if (!(size > 0.0)) fail("no proof", record, size);
    if (!(power >= -BALANCED * size * load)) fail("a proof without power", record, power);
    for (int i = 0; i < g.count; ++i) {
        if (!g.touches(i)) continue;
        const Frame frame(point(&g.normals[3 * i]), g.along.empty() ? nullptr : &g.along[3 * i]);
        double arm[3], v[3], y[3] = {}, turn = 0.0;
        for (int a = 0; a < 3; ++a) arm[a] = g.positions[3 * i + a] - at.centre[a];
        cross(&twist[3], arm, v);
        for (int a = 0; a < 3; ++a)
            for (int r = 0; r < 3; ++r) y[a] += frame[a][r] * (v[r] + there[r]);
        for (int r = 0; r < 3; ++r) turn += frame.n[r] * twist[3 + r];
        const bool slips = g.slippery(i);
        const double across = slips ? 0.0 : std::hypot(g.mu(i, 0) * y[1], g.mu(i, 1) * y[2]),
                     twisted = g.torsion(i) * std::abs(turn);
        const double most = 1.0 + (slips ? 0.0 : std::max(g.mu(i, 0), g.mu(i, 1))) + g.torsion(i) / at.spread;
        if (!(y[0] - across - twisted >= -BALANCED * size * most))
            fail("a proof that a contact breaks", record, y[0] - across - twisted);
    }
}

// What a record says, against what was given. exact: of a method that stays strictly inside the cones; whole: an optimum's, not a start's.
void check(const Given& g, const double* wrench, const Options& options, const Record& record, bool whole = true) {
    const Summary& s = record.summary();
    const Code code = record.code();
    const int n = g.count, joints = g.joints;
    const bool exact = options.method != Method::conic;
    if (!(s.code >= double(CONVERGED) && s.code <= double(UNDECIDED))) fail("no code", record, s.code);
    if (record.contacts() != n || int(s.joints) != joints) fail("sizes", record, s.contacts);
    const double* end = record.prices() + int(s.limits);
    if (!record.has_force()) {
        for (const double* v = record.force(); v < (code == INFEASIBLE ? record.prices() : end); ++v)  // a proof has prices
            if (*v != 0.0) fail("no force, but numbers", record, *v);
        if (code != INFEASIBLE) return;
        for (const double v : s.multipliers)
            if (!(std::abs(v) < infinity)) fail("a proof of no numbers", record, v);
        if (!g.limited() && g.has_digits()) check_proof(g, wrench, record);
        return;
    }
    for (const double* v = record.force(); v < end; ++v)
        if (!(std::abs(*v) < infinity)) fail("no number", record, *v);
    for (const double* v = record.prices(); v < end; ++v)
        if (!(*v >= 0.0)) fail("a price below nothing", record, *v);

    double most = 0.0, normals = 0.0, largest = 0.0, phi = 0.0, lambda = g.objective.barrier_weight;
    for (int j = 0; j < 3 * n; ++j) most = std::max(most, std::abs(record.force()[j]));
    const Around at(g);
    Sum missed[6];
    std::vector<Sum> torques(joints);
    for (int j = 0; j < joints; ++j) torques[j] += g.bias.empty() ? 0.0 : g.bias[j];
    for (int a = 0; a < 3; ++a) missed[a] += wrench[a];
    double moment[3], nearest = infinity;
    cross(at.centre, wrench, moment);
    for (int a = 0; a < 3; ++a) missed[3 + a] += wrench[3 + a], missed[3 + a] += -moment[a];
    for (int i = 0; i < n; ++i) {
        const double *f = record.force() + 3 * i, *frame = record.frames() + 9 * i, turn = record.torsion()[i];
        if (!g.touches(i)) {
            bool zero = turn == 0.0;
            for (int a = 0; a < 3; ++a) zero = zero && f[a] == 0.0 && record.initial_force()[3 * i + a] == 0.0;
            for (int k = 0; k < 9; ++k) zero = zero && frame[k] == 0.0;
            if (!zero) fail("a force of what does not touch", record, i);
            continue;
        }
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) {
                double product = 0.0;
                for (int r = 0; r < 3; ++r) product += frame[3 * r + a] * frame[3 * r + b];
                if (!(std::abs(product - (a == b)) < 1e-9)) fail("a frame", record, product);
            }
        double v[3], arm[3];
        record.object_force(i, v);
        for (int r = 0; r < 3; ++r) {
            if (!(std::abs(frame[3 * r] - g.normals[3 * i + r]) < 2e-6)) fail("a frame's normal", record, frame[3 * r]);
            arm[r] = g.positions[3 * i + r] - at.centre[r];
        }
        cross(arm, v, moment);
        for (int r = 0; r < 3; ++r) missed[r] += v[r], missed[3 + r] += moment[r], missed[3 + r] += turn * frame[3 * r];
        for (int j = 0; j < joints; ++j)
            for (int r = 0; r < g.moves(); ++r) {
                const double lever = g.jacobian[(g.moves() * i + r) * joints + j];
                torques[j] += lever * (r < 3 ? v[r] : turn * frame[3 * (r - 3)]);
                torques[j].size +=
                    std::abs(lever) * (r < 3 ? std::hypot(f[0], f[1], f[2]) : std::abs(turn));  // of which v has rounding
            }

        // u, o, t and torsion in the units of Phi
        const bool free = g.slippery(i);
        const double mu_o = g.mu(i, 0), mu_t = g.mu(i, 1), mu = free ? 1.0 : std::sqrt(mu_o) * std::sqrt(mu_t);
        if (free && (f[1] != 0.0 || f[2] != 0.0)) fail("a tangential force without friction", record, f[1]);
        const double u = mu * f[0], side = free ? 0.0 : mu * std::hypot(f[1] / mu_o, f[2] / mu_t);
        const double gamma = g.torsion(i), twisted = gamma > 0.0 ? mu * std::abs(turn) / gamma : 0.0;
        if (gamma == 0.0 && turn != 0.0) fail("torsion of a hard contact", record, turn);
        const double room = std::min(u - side, u - twisted), slack = exact ? 1e-14 * u : INSIDE * std::max(u, most);
        if (!(room >= -slack)) fail("outside a cone", record, room);
        nearest = std::min(nearest, std::min(std::abs(room) / u, 1.0));
        normals += f[0], largest = std::max(largest, f[0]);
        phi += 3.0 * g.objective.force_weight * u + lambda * (1.0 / u + 1.0 / (u - side) + 1.0 / (u + side));
        if (gamma > 0.0) phi += lambda * (1.0 / (u - twisted) + 1.0 / (u + twisted));
    }
    for (int r = 0; r < 6 && at.spread < 1e6; ++r) {  // metres: further apart balance has no digits
        const double unit = r < 3 ? 1.0 : at.spread;
        double size = 0.0;
        for (int q = 0; q < 6; ++q) size += missed[q].size / (q < 3 ? 1.0 : at.spread);
        if (!(std::abs(missed[r].value) / unit <= BALANCED * size)) fail("not balanced", record, missed[r].value / unit);
    }

    // limits
    double excess = 0.0, rounding = 0.0;
    int rows = 0;
    const auto over = [&](double by, double limit, double size) {
        ++rows;
        if (by > 0.0) excess = std::max(excess, by / limit);
        rounding = std::max(rounding, ROUNDING * size / limit);
    };
    for (int i = 0; i < n; ++i) {
        const double f = record.force()[3 * i];
        if (!g.least.empty() && g.least[i] > 0.0 && g.least[i] < infinity)
            over(g.touches(i) ? g.least[i] - f : 0.0, g.least[i], std::abs(f));
        if (!g.most.empty() && g.most[i] > 0.0 && g.most[i] < infinity)
            over(g.touches(i) ? f - g.most[i] : 0.0, g.most[i], std::abs(f));
    }
    for (int j = 0; j < joints; ++j) {
        if (!torques[j].is(record.torques()[j])) fail("a torque", record, record.torques()[j] - torques[j].value);
        if (!(g.torque[j] < infinity)) continue;
        over(std::abs(record.torques()[j]) - g.torque[j], g.torque[j], torques[j].size), ++rows;
    }
    if (rows != int(s.limits)) fail("limits", record, rows);
    if (!(std::abs(excess - s.limit_excess) <= 1e-9 * excess || excess == s.limit_excess))
        fail("an excess", record, excess - s.limit_excess);
    if (!whole || !g.has_digits() || most > 1e12) return;
    if (code == LIMITS_EXCEEDED) {
        if (!options.elastic || s.objective != s.limit_excess) fail("no excess", record, s.limit_excess);
        // where torques add up to a limit's millionth of a millionth, or forces are a giganewton, which of them exceed it is rounding
        if (!(s.limit_excess > 0.0) && rounding < 1e-9 && most < 1e9) fail("no excess", record, s.limit_excess);
        return;
    }
    if (s.limit_excess > rounding) fail("exceeds limits", record, s.limit_excess);

    // what was minimized
    if (!exact) phi = options.criterion == Criterion::sum ? normals : largest;
    if (!g.limited() || !exact) {
        const double sure = 1e-9 + (exact ? 1e-13 / nearest : 0.0);
        if (!(std::abs(phi - s.objective) <= sure * std::abs(phi) || std::abs(phi - s.objective) < 1e-300))
            fail("an objective", record, phi - s.objective);
    }
    if (!(s.lower_bound <= (1.0 + 1e-6) * s.objective || s.lower_bound < 1e-300))
        fail("a bound above a force", record, s.objective - s.lower_bound);
    if (code == CONVERGED && !(s.objective - s.lower_bound <= 1.01 * std::max(options.gap(), 1e-12) * s.lower_bound) &&
        s.objective != 0.0)
        fail("converged, not certified", record, s.objective - s.lower_bound);
}

// No two records of one problem may contradict each other.
void compare(const Record& one, const Record& other) {
    if (one.code() == LIMITS_EXCEEDED || other.code() == LIMITS_EXCEEDED) return;
    for (const auto& [a, b] : {std::pair{one, other}, {other, one}}) {
        if (!a.has_force()) continue;
        const Summary &with = a.summary(), &against = b.summary();
        double most = 0.0;
        for (int j = 0; j < 3 * a.contacts(); ++j) most = std::max(most, std::abs(a.force()[j]));
        if (b.has_force() && !(against.lower_bound <= (1.0 + 1e-6) * with.objective + 1e-300))
            fail("a bound above another force", b, with.objective);
        if (b.code() == INFEASIBLE && a.code() == CONVERGED && with.margin > 1e-5 * most)
            fail("infeasible, but there is a force", a, with.margin);
    }
}

struct Made {
    Given given;
    Options options;
    bool wild;

    explicit Made(Bytes& from) {
        Given& g = given;
        g.count = from.whole(2, from.one_in(4) ? 18 : 6);
        wild = from.wild = from.one_in(2);
        const double far = from.one_in(4) ? 1.0 : 0.0, thin = from.one_in(4) ? from.decades(1e-6, 1.0) : 1.0;
        for (int i = 0; i < g.count; ++i) {
            double at[3], length = 0.0;
            for (double& v : at) v = from.signed_fraction(), length += v * v;
            length = std::sqrt(length) + 1e-9;
            for (int a = 0; a < 3; ++a) {
                g.positions.push_back(far + 0.05 * at[a] / length * (a == 1 ? thin : 1.0) + from.number(1e-4));
                g.normals.push_back(-at[a] / length);
            }
            tilt(from, &g.normals[3 * i], 0.3);
            if (wild && from.one_in(64)) g.normals[3 * i + from.whole(0, 2)] = from.number(1.0);
        }
        g.friction = set_friction(from);
        if (from.one_in(3))
            for (int i = 0; i < g.count; ++i) g.gamma.push_back(from.one_in(2) ? 0.0 : from.decades(1e-3, 0.1));
        if (from.one_in(4)) g.along = numbers(from, 3 * g.count, 1.0);
        if (from.one_in(4)) g.objective = {from.decades(1e-4, 1e4), from.decades(1e-16, 1e6)};

        constexpr Method methods[] = {Method::newton, Method::newton,       Method::newton,   Method::conic,
                                      Method::conic,  Method::reduced_flow, Method::full_flow};
        options.method = methods[from.whole(0, 6)];
        const bool flow = options.method == Method::reduced_flow || options.method == Method::full_flow;
        if (flow) g.gamma.clear(), options.limit = from.whole(0, 250);
        else if (from.one_in(2)) limit(from);
        if (options.method == Method::conic && from.one_in(3)) options.criterion = Criterion::largest;
        if (from.one_in(3)) options.start = Start(from.whole(0, int(Start::previous)));
        if (from.one_in(4)) options.tolerance = from.decades(1e-14, 1.0);
        if (from.one_in(8)) options.limit = from.whole(0, 200);
        if (wild && from.one_in(16)) options.tolerance = from.number(1.0);
        if (g.limited()) options.elastic = from.one_in(2);
        if (flow) options.step_rule.kind = from.whole(0, StepRule::EXACT);
        if (flow && options.step_rule.kind == StepRule::EXACT) options.step_rule.decrease = 0.1;
        if (g.count >= 3 && from.one_in(4)) learn(from);
    }

    std::vector<double> set_friction(Bytes& from) const {
        std::vector<double> friction;
        for (int i = 0; i < (from.one_in(2) ? 1 : from.one_in(2) ? given.count : 2 * given.count); ++i)
            friction.push_back(wild && from.one_in(8) ? std::abs(from.number(1.0))
                               : from.one_in(16)      ? 0.0
                                                      : from.decades(0.05, 3.0));
        const std::size_t n = given.count;  // the bytes may have said another number each time
        friction.resize(friction.size() >= 2 * n ? 2 * n : friction.size() >= n ? n : 1);
        return friction;
    }
    static void tilt(Bytes& from, double* normal, double by) {
        normal[0] += by * from.signed_fraction();
        const double size = std::hypot(normal[0], normal[1], normal[2]);
        for (int a = 0; a < 3; ++a) normal[a] /= size > 0.0 ? size : 1.0;
    }
    std::vector<double> move(Bytes& from) const {
        const Given& g = given;
        std::vector<double> jacobian(g.jacobian.size());
        const int rows = g.moves(), mixed = from.whole(0, 3);
        for (int i = 0; i < g.count; ++i)
            for (int r = 0; r < rows; ++r)
                for (int j = 0; j < g.joints; ++j)
                    if (mixed == 0 || j % g.count == i || (mixed == 1 && j == 0))
                        jacobian[(rows * i + r) * g.joints + j] =
                            from.left() ? from.number(r < 3 ? 0.06 : 1.0) : 0.01 * ((7 * r + j) % 5 - 2);
        return jacobian;
    }

private:
    void limit(Bytes& from) {
        Given& g = given;
        if (from.one_in(2)) g.most = numbers(from, g.count, 1.0);
        for (double& v : g.most) v = std::abs(v) * 20.0 + 0.1;
        if (from.one_in(2)) g.least = numbers(from, g.count, 0.1);
        for (double& v : g.least) v = wild ? v : std::abs(v);
        if (!from.one_in(2)) return;
        g.joints = from.whole(1, from.one_in(4) ? 3 * g.count : 4);
        g.jacobian.resize(std::size_t(from.one_in(2) ? 3 : 6) * g.count * g.joints);
        g.jacobian = move(from);
        for (int j = 0; j < g.joints; ++j)
            g.torque.push_back(wild && from.one_in(16) ? from.number(1.0) : from.one_in(8) ? infinity : from.decades(1e-3, 10.0));
        g.bias = numbers(from, g.joints, 0.05);
    }
    void learn(Bytes& from);
};

Model small_model(Bytes& from, int count) {
    Model model;
    const int outputs = std::max(3 * count - 6, 1), sizes[] = {PLAIN_FEATURES + 2, 3, outputs}, pairs[] = {6, 4};
    const auto floats = [&](std::size_t many) {
        std::vector<float> out(many);
        for (float& v : out) v = from.left() ? float(from.signed_fraction()) : 0.1f;
        return out;
    };
    model.network = Network(sizes, floats(Network::numbers(sizes)).data()),
    model.pairs = Network(pairs, floats(Network::numbers(pairs)).data());
    model.normalisation = {0.2, 0.05, 0.5, 1.3, 0.4, 0.12};
    model.friction = 0.4;
    for (int k = 0; k < 3 * count * outputs; ++k) model.null_space.push_back(k % 7 == 0 ? 0.5 : 0.0);
    return model;
}

void Made::learn(Bytes& from) {
    const std::string bytes = ModelFile::write(small_model(from, given.count));
    std::string body = bytes.substr(16);
    for (int k = from.whole(0, 4); k > 0; --k) {
        const std::size_t at = (256 * from.whole(0, 255) + from.whole(0, 255)) % body.size();
        body[at] = char(from.whole(0, 255));
    }
    const std::optional<Model> model = ModelFile::body(body);
    if (!model || !model->fits(given.count)) return;
    if (ModelFile::write(*model).substr(16) != body) std::abort();
    options.model = std::make_shared<const Model>(*model);
    if (options.method != Method::conic && from.one_in(2)) options.start = Start::learned;
}

struct Load {
    double w[6];
    explicit Load(Bytes& from) {
        const double size = from.one_in(4) ? from.decades(1e-12, 1e9) : 5.0;
        for (int r = 0; r < 6; ++r) w[r] = from.number(r < 3 ? size : 0.05 * size);
    }
};

// Contacts and limits of a call, and what `Changes` has of them.
struct Moved {
    Given given;
    Changes now;
    bool torn = false;  // numbers of another size: refused

    Moved(Bytes& from, const Made& made, const Given& home, bool some) : given(home) {
        Given& g = given;
        if (from.one_in(2)) {
            for (double& v : g.positions) v += from.number(from.one_in(8) ? 0.05 : 1e-3);
            now.positions = g.positions;
        }
        if (from.one_in(3)) {
            for (int i = 0; i < g.count; ++i) Made::tilt(from, &g.normals[3 * i], 0.1);
            now.normals = g.normals;
        }
        if (from.one_in(6)) {
            auto other = made.set_friction(from);
            const auto of = [&](int i, int axis) {
                const std::size_t n = g.count;
                return other.size() == 1 ? other[0] : other.size() == n ? other[i] : other[2 * i + axis];
            };
            rubbed_ = other, now.friction = rubbed_;
            std::vector<double> each;  // those without any keep none
            for (int i = 0; i < g.count; ++i)
                for (int axis = 0; axis < 2; ++axis) each.push_back(home.slippery(i) ? 0.0 : of(i, axis));
            g.friction = each;
        }
        if (g.joints && from.one_in(3)) g.jacobian = made.move(from), now.jacobian = g.jacobian;
        if (g.joints && from.one_in(3)) g.bias = numbers(from, g.joints, 0.05), now.torque_bias = g.bias;
        if (some && from.one_in(3)) {
            now.contacts = 0;
            for (int i = 0; i < g.count; ++i) now.contacts |= std::uint64_t(!from.one_in(4)) << i;
            g.contacts = now.contacts;
        }
        if (from.wild && from.one_in(32) && !now.positions.empty())
            torn = true, now.positions = now.positions.first(3 * (g.count - 1));
    }
    Moved(const Moved&) = delete;

private:
    std::vector<double> rubbed_;
};

void run(Bytes& from) {
    if (from.whole(0, 15) == 15) {
        const std::string_view bytes(reinterpret_cast<const char*>(from.data()), from.left());
        if (ModelFile::read(bytes)) std::abort();  // one in 2^64 hashes
        if (ModelFile::body(bytes) && bytes.size() < 14 * sizeof(double)) std::abort();
        if (TreeFile::read(bytes)) std::abort();
        if (const auto tree = TreeFile::body(bytes); tree && !TreeFile::read(TreeFile::write(*tree))) std::abort();
        return;
    }
    const Made made(from);
    const Options& options = made.options;
    Given home = made.given;
    const Contacts contacts = Contacts::from(home.positions, home.normals, home.friction, home.objective, home.along, home.gamma);
    std::optional<ForceOptimizer> on;
    on.emplace(Problem{contacts, home.limits()}, options);
    const int size = on->size();
    std::vector<double> row(size), other(size);
    for (int round = from.whole(1, 4); round > 0; --round) {
        if (from.one_in(8)) {
            const Moved moved(from, made, home, false);
            asked = "update";
            if (on->update(moved.now)) {
                home = moved.given;
                if (moved.torn) std::abort();
            } else if (!made.wild) std::abort();
        }
        if (from.one_in(8)) {
            ForceOptimizer copy(*std::as_const(on));
            on.emplace(std::move(copy));
        }
        const Load load(from);
        const Moved moved(from, made, home, true);
        Request ask{.wrench = load.w, .now = moved.now};
        if (from.one_in(2)) ask.start = Start(from.whole(0, int(Start::learned)));
        std::vector<double> force;
        if (ask.start == Start::given || ask.start == Start::guess) {
            force = numbers(from, 3 * home.count, 5.0);
            if (on->previous() && from.one_in(2)) std::copy_n(on->previous()->force(), 3 * home.count, force.begin());
            ask.force = force;
        }
        asked = "solve";
        const Record record = on->solve(ask);
        check(moved.given, load.w, options, record);
        if (moved.torn && record.code() != REFUSED) fail("other sizes are not refused", record, 0.0);
        if (record.code() == REFUSED && !made.wild && ask.start != Start::given) fail("refused", record, 0.0);
        if (from.one_in(4)) {  // another start, another solver, the same problem
            ForceOptimizer copy(*std::as_const(on));
            Request again = ask;
            again.start = Start(from.whole(0, int(Start::phase_one)));
            asked = "again";
            copy.solve(again, other.data());
            check(moved.given, load.w, options, Record(other.data()));
            if (moved.given.has_digits()) compare(record, Record(other.data()));
            on->solve(again, row.data());
            if (std::memcmp(row.data(), other.data(), size * sizeof(double)) != 0)
                fail("other bits the second time", Record(row.data()), 0.0);
        }
        if (from.one_in(8)) {
            asked = "start";
            on->start(ask, row.data());
            check(moved.given, load.w, options, Record(row.data()), false);
        }
        if (from.one_in(8)) {
            std::vector<double> loads, rows;
            const int many = from.whole(0, 20);
            for (int k = 0; k < many; ++k) {
                const Load one(from);
                loads.insert(loads.end(), one.w, one.w + 6);
            }
            rows.resize(std::size_t(many) * size);
            asked = "solve_many";
            on->solve_many(loads, rows);
            for (int k = 0; k < many; ++k) check(home, &loads[6 * k], options, Record(&rows[std::size_t(k) * size]));
        }
        if (from.one_in(8)) on->forget();
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
        bytes.resize(2000);
        for (std::uint8_t& byte : bytes)
            state = state * 6364136223846793005u + 1442695040888963407u, byte = std::uint8_t(state >> 56);
        std::FILE* last = std::getenv("GRASP_FUZZ_LAST") ? std::fopen(std::getenv("GRASP_FUZZ_LAST"), "wb") : nullptr;
        if (last) std::fwrite(bytes.data(), 1, bytes.size(), last), std::fclose(last);
        LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
    }
    std::printf("%ld\n", count);
}
#endif
