// Contacts that move near the loss of force closure: a solver that remembers ends as one that does
// not.
//
//     previous SEED COUNT    problems; prints how many ended with a force, with a proof, and with
//     neither
#include <grasp/optimizer.hpp>

#include <cstdio>
#include <cstdlib>
#include <random>

namespace {

using namespace grasp;

struct Drawn {
  std::vector<double> positions, normals, friction, gamma;
  double size = 1.0;
  int count() const { return int(positions.size()) / 3; }
  Contacts contacts(double part = 1.0) const {
    std::vector<double> mu = friction;
    for (double& value : mu) value *= part;
    return Contacts::from(positions, normals, mu, {}, {}, gamma);
  }
};

class Random {
 public:
  explicit Random(std::uint64_t seed) : engine_(seed) {}
  double uniform(double low, double high) {
    return low + (high - low) * std::uniform_real_distribution<>()(engine_);
  }
  double decades(double low, double high) { return std::pow(10.0, uniform(low, high)); }
  double normal() { return std::normal_distribution<>()(engine_); }
  bool chance(double part) { return uniform(0.0, 1.0) < part; }
  int whole(int low, int high) { return std::uniform_int_distribution<>(low, high)(engine_); }

 private:
  std::mt19937_64 engine_;
};

void shift(Random& random, std::vector<double>& vectors, double by, bool to_length_one) {
  for (double& value : vectors) value += by * random.normal();
  for (std::size_t i = 0; to_length_one && i < vectors.size(); i += 3) {
    const double per = 1.0 / length(point(&vectors[i]));
    for (int a = 0; a < 3; ++a) vectors[i + a] *= per;
  }
}

bool closes(const Drawn& drawn, double part) {
  try {
    const std::array<double, 6> nothing{};
    std::vector<double> force(3 * drawn.count());
    std::vector<double> torsion(drawn.count());
    return ForceOptimizer({drawn.contacts(part)}).deepest(nothing, force, torsion).code ==
           CONVERGED;
  } catch (const std::invalid_argument&) {  // rank lost
    return false;
  }
}

// Contacts on an ellipsoid, with friction near the least that closes. Return false if none does.
bool draw(Random& random, Drawn& out) {
  const int count = random.whole(3, 8);
  const double axes[3] = {random.uniform(0.4, 1.0), random.uniform(0.4, 1.0),
                          random.uniform(0.4, 1.0)};
  out = {};
  out.size = random.decades(-2.5, -0.5);
  for (int i = 0; i < count; ++i) {
    std::vector<double> on{random.normal(), random.normal(), random.normal()};
    shift(random, on, 0.0, true);
    std::vector<double> normal{-on[0] / axes[0], -on[1] / axes[1], -on[2] / axes[2]};
    shift(random, normal, 0.0, true);
    shift(random, normal, 0.1, true);
    for (int a = 0; a < 3; ++a) {
      out.positions.push_back(out.size * on[a] * axes[a]);
      out.normals.push_back(normal[a]);
    }
    out.friction.push_back(random.uniform(0.2, 1.2));
  }
  if (random.chance(0.2))
    for (int i = 0; i < count; ++i)
      out.gamma.push_back(random.chance(0.5) ? out.size * random.decades(-3.0, 0.0) : 0.0);
  double low = 1e-3, high = 30.0;
  if (!closes(out, high)) return false;
  for (int round = 0; round < 22; ++round) {
    const double middle = std::sqrt(low * high);
    (closes(out, middle) ? high : low) = middle;
  }
  const double part = random.chance(0.8) ? high * (1.0 + random.decades(-6.0, -0.5))
                                         : low * (1.0 - random.decades(-6.0, -1.0));
  for (double& mu : out.friction) mu *= part;
  return true;
}

// Balance residual of a solution, its moments about the contacts' centre and divided by their
// spread, computed from forces on the object.
double missed(const Drawn& at, const double* wrench, const Record& record) {
  const UnitFrame unit(at.positions.data(), at.count());
  Point force = point(wrench);
  Point moment = point(wrench + 3) - cross(unit.centre, force);
  for (int i = 0; i < at.count(); ++i) {
    double f[3];
    record.object_force(i, f);
    force += point(f);
    moment += cross(point(&at.positions[3 * i]) - unit.centre, point(f)) +
              record.torsion()[i] * point(&at.normals[3 * i]);
  }
  return std::max(length(force), length(moment) / unit.length);
}

void compare(const Drawn& at, const double* wrench, const Record& cold, const Record& warm,
             const char* where) {
  const auto fail = [&](const char* what) {
    std::fprintf(
        stderr, "%s: %s: cold code %d, objective %.17g; previous code %d, objective %.17g\n", where,
        what, cold.code(), cold.summary().objective, warm.code(), warm.summary().objective);
    std::exit(1);
  };
  if (cold.code() != warm.code()) fail("another outcome");
  for (const Record* record : {&cold, &warm}) {
    if (!record->has_force()) continue;
    double most = 0.0;
    for (int j = 0; j < 3 * at.count(); ++j) most = std::max(most, std::abs(record->force()[j]));
    const double load = size(UnitFrame(at.positions.data(), at.count()).of(wrench));
    if (!(missed(at, wrench, *record) <= 1e-8 * std::max(load, std::min(most, 1.0)) + 1e-13 * most))
      fail("not balanced");
    if (!(record->summary().margin >= 0.0 && record->summary().objective < infinity))
      fail("outside");
  }
  const Summary& a = cold.summary();
  const Summary& b = warm.summary();
  if (cold.code() == CONVERGED &&
      std::max(a.lower_bound, b.lower_bound) > (1.0 + 1e-9) * std::min(a.objective, b.objective))
    fail("bounds and objectives disagree");
}

}  // namespace

int main(int count, char** given) {
  const std::uint64_t seed = count > 1 ? std::strtoull(given[1], nullptr, 10) : 0;
  const int problems = count > 2 ? std::atoi(given[2]) : 1000;
  int ended[3] = {}, done = 0;
  for (std::uint64_t index = 0; done < problems; ++index) {
    Random random(1000003 * seed + index);
    Drawn home;
    if (!draw(random, home)) continue;
    const double load = random.decades(-1.0, 2.5);
    const double step = random.decades(-4.0, -1.0);
    const std::vector<double> most(home.count(), load * random.decades(0.0, 3.0));
    const bool limited = random.chance(0.2);
    const Options options{.tolerance = random.chance(0.3) ? 1e-6 : 0.0,
                          .elastic = limited && random.chance(0.3)};
    Options remembering = options;
    remembering.start = Start::previous;
    const Problem problem{home.contacts(), {.max_normal = limited ? Doubles(most) : Doubles{}}};
    ForceOptimizer cold(problem, options);
    ForceOptimizer warm(problem, remembering);
    Drawn at = home;
    for (int k = 0; k < 8; ++k, ++done) {
      const double turn = home.size * (random.chance(0.3) ? 0.0 : random.chance(0.5) ? 0.1 : 1.0);
      double wrench[6];
      for (int r = 0; r < 6; ++r) wrench[r] = load * (r < 3 ? 1.0 : turn) * random.normal();
      const Changes now{.positions = at.positions, .normals = at.normals};
      const Record alone = cold.solve(Wrench(wrench), now);
      const Record again = warm.solve(Wrench(wrench), now);
      char where[64];
      std::snprintf(where, sizeof where, "grasp %d, step %d", int(index), k);
      compare(at, wrench, alone, again, where);
      ++ended[alone.has_force() ? 0 : alone.code() == INFEASIBLE ? 1 : 2];
      at = home;
      shift(random, at.positions, step * home.size, false);
      shift(random, at.normals, step, true);
    }
  }
  std::printf("%d %d %d\n", ended[0], ended[1], ended[2]);
}
