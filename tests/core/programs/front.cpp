// For test_front.py: `front MODEL CALLS` prints, a line each, how calls of optimizer.hpp end and
// how often they allocate.
#include <grasp/optimizer.hpp>

#include <cstdio>

#include "../bindings/counting.hpp"

namespace {

using namespace grasp;

const double positions[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
const double normals[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1},
             wrench[] = {1, 0.5, -0.6, -0.1, 0.2, 0};
const double upward[] = {0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1}, press[] = {0.1, 0, -5, 0, 0, 0},
             lift[] = {0, 0, 5, 0, 0, 0};
const double none = std::numeric_limits<double>::quiet_NaN();

// Code, start, whether it was replaced, objective, excess; forces, torsions, torques.
void print(const char* name, const Record& record) {
  const Summary& s = record.summary();
  std::printf("%s: %d %g %g %.12g %g", name, record.code(), s.start, s.replaced, s.objective,
              s.limit_excess);
  for (int i = 0; i < 12; ++i) std::printf(" %.9g", record.force()[i]);
  for (int i = 0; i < 4; ++i) std::printf(" %.9g", record.torsion()[i]);
  for (int j = 0; j < int(s.joints); ++j) std::printf(" %.9g", record.torques()[j]);
  std::printf("\n");
}
// Codes of calls without a force; "!": a number behind the summary is not zero (a proof has
// multipliers).
class Ends {
 public:
  explicit Ends(const char* name) { std::printf("%s:", name); }
  ~Ends() { std::printf("\n"); }
  void operator()(const Record& record) const {
    const Summary& s = record.summary();
    const double* from = record.force();
    const double* to = record.limit_multipliers();
    const bool zeros = std::all_of(from, to, [](double v) { return v == 0.0; });
    std::printf(" %d%s", record.code(),
                record.has_force() || (zeros && s.margin == 0.0) ? "" : "!");
  }
};
template <class F> void refused(const char* name, F&& setup) {
  try {
    setup();
    std::printf("%s: no error\n", name);
  } catch (const std::invalid_argument& error) {
    std::printf("%s: %s\n", name, error.what());
  }
}
// call(k): true if it ended as it should
template <class F> void counted(const char* name, int calls, F&& call) {
  int wrong = 0;
  const long allocated = ::counted([&] {
    for (int k = 0; k < calls; ++k) wrong += !call(k);
  });
  std::printf("allocations of %s: %ld, wrong: %d\n", name, allocated, wrong);
}

}  // namespace

int main(int argc, char** arguments) {
  if (argc < 3) return 2;
  const int calls = std::atoi(arguments[2]);
  const auto model = std::make_shared<const Model>(ModelFile::load(arguments[1]));
  const Contacts contacts = Contacts::from(positions, normals, 0.4);
  const double two[] = {0.4, 0.6, 0.4, 0.6, 0.4, 0.6, 0.4, 0.6};
  const double slippery[] = {0.4, 0.6, 0.4, 0.6, 0.4, 0.6, 0.0, 0.0};
  const double gamma[] = {0.02, 0.0, 0.01, 0.01};
  const double rubber[] = {0.5, 0.5, 0.7, 0.5};
  const auto on = [](Doubles friction, Doubles torsion = {}, Objective weights = {}) {
    return Contacts::from(positions, normals, friction, weights, {}, torsion);
  };
  const Contacts soft = on(rubber, gamma);
  const Contacts open = Contacts::from(positions, upward, 0.4);

  // velocities of the contact points by three joints of each finger; by four that all fingers
  // share and that also turn the tips
  std::vector<double> separate(12 * 12);
  std::vector<double> shared(24 * 4);
  for (int i = 0; i < 4; ++i)
    for (int a = 0; a < 3; ++a)
      for (int j = 0; j < 3; ++j)
        separate[(3 * i + a) * 12 + 3 * i + j] = 0.02 + 0.01 * ((a + 2 * j) % 3);
  for (int k = 0; k < 96; ++k)
    shared[k] = k / 4 % 6 < 3 ? 0.01 * ((k * 7) % 5 - 2) : 0.5 * ((k * 3) % 4 - 1);
  const std::vector<double> most(4, 6.0);
  const std::vector<double> least(4, 0.5);
  const std::vector<double> torques(12, 0.25);
  const std::vector<double> little(12, 0.1);
  const std::vector<double> four(4, 0.15);
  const std::vector<double> bias{0.01, -0.02, 0.0, 0.03};
  const ForceLimits limits{
      .min_normal = least, .max_normal = most, .jacobian = separate, .torque_limit = torques};
  const ForceLimits tight{.jacobian = separate, .torque_limit = little};
  std::vector<double> both = separate;  // its first joint moves two fingers
  both[9 * 12] = 0.02;
  const ForceLimits pair{
      .min_normal = least, .max_normal = most, .jacobian = both, .torque_limit = torques};
  const std::vector<double> zeros(144);  // the Jacobian comes with the calls
  const ForceLimits unmoved{.jacobian = zeros, .torque_limit = torques};
  const ForceLimits common{.jacobian = shared, .torque_limit = four, .torque_bias = bias};

  const double exact = 1e-12;
  const Options newton{.tolerance = exact};
  const Options flow{.method = Method::reduced_flow};
  const Options full{.method = Method::full_flow};
  const Options least_sum{.method = Method::conic};
  const Options least_largest{.method = Method::conic, .criterion = Criterion::largest};
  const Options elastic{.elastic = true};
  const Options learning{.start = Start::learned, .tolerance = exact, .model = model};
  struct Case {
    const char* name;
    Problem problem;
    Options options;
    const double* load = wrench;
  };
  const Case cases[] = {
      {"newton", {contacts}, newton},
      {"reduced flow", {contacts}, flow},
      {"full flow", {contacts}, full},
      {"conic", {contacts}, least_sum},
      {"largest", {contacts}, least_largest},
      {"elliptic", {on(slippery, {}, {2.0, 0.02})}, newton},
      {"soft", {soft}, newton},
      {"limited", {contacts, limits}, newton},
      {"shared", {contacts, common}, newton},
      {"shared conic", {contacts, common}, least_sum},
      {"soft shared", {soft, common}, newton},
      {"pair", {contacts, pair}, newton},
      {"unmoved", {contacts, unmoved}, elastic},
      {"elastic", {contacts, tight}, elastic},
      {"learned", {contacts}, learning},
      {"open", {open}, newton, press},
  };
  for (const Case& test : cases)
    print(test.name,
          ForceOptimizer(test.problem, test.options).solve(std::span(test.load, 6).first<6>()));

  // starts of a call
  ForceOptimizer solver({contacts}, newton);
  const std::vector<double> best = [&] {
    const double* force = solver.solve(wrench).force();
    return std::vector<double>(force, force + 12);
  }();
  print("given", solver.solve({.wrench = wrench, .start = Start::given, .force = best}));
  print("again", solver.solve({.wrench = wrench, .start = Start::previous}));
  solver.forget();
  print("forgotten", solver.solve({.wrench = wrench, .start = Start::previous}));
  {  // a row of the caller comes before the last solution
    ForceOptimizer other({contacts}, newton);
    std::vector<double> row(other.size());
    other.solve({.wrench = wrench}, row.data());
    other.solve(std::span(press).first<6>());
    const Record& record =
        other.solve(Request{.wrench = wrench, .start = Start::previous, .previous = row.data()});
    std::printf("own previous: %g\n", record.summary().iterations);
  }
  print("no model",
        ForceOptimizer({contacts}, {.start = Start::learned, .tolerance = exact}).solve(wrench));

  // contacts of a call, from then on, and some of them
  const auto point = [](int k) {
    std::array<double, 12> out;
    for (int j = 0; j < 12; ++j) out[j] = positions[j] + 0.0005 * std::sin(0.01 * k + j);
    return out;
  };
  const auto turned = [](int k) {
    std::array<double, 12> out;
    for (int i = 0; i < 4; ++i) {
      const double tilt = 0.05 * std::sin(0.02 * k + i);
      out[3 * i] = std::sin(tilt);
      out[3 * i + 1] = 0.0;
      out[3 * i + 2] = normals[3 * i + 2] * std::cos(tilt);
    }
    return out;
  };
  const auto lever = [&](int k) {
    std::array<double, 144> out;
    for (int j = 0; j < 144; ++j) out[j] = separate[j] * (1.0 + 0.1 * std::sin(0.01 * k + j));
    return out;
  };
  const std::vector<double> weight(12, 0.01);
  const auto points = point(50);
  const auto directions = turned(50);
  const auto levers = lever(50);
  const Changes there{.positions = points,
                      .normals = directions,
                      .friction = two,
                      .jacobian = levers,
                      .torque_bias = weight};
  ForceLimits limits_there = limits;
  limits_there.jacobian = levers;
  limits_there.torque_bias = weight;
  ForceOptimizer limited({contacts, limits}, newton);
  print("moved", limited.solve(wrench, there));
  {  // numbers of a contact that does not touch
    std::vector<double> broken_points(points.begin(), points.end());
    std::vector<double> broken_directions(directions.begin(), directions.end());
    std::vector<double> broken_friction(std::begin(two), std::end(two));
    std::vector<double> broken_levers(levers.begin(), levers.end());
    for (auto* numbers : {&broken_points, &broken_directions, &broken_friction, &broken_levers})
      std::fill(numbers->end() - numbers->size() / 4, numbers->end(), none);
    print("three touch", limited.solve(wrench, {points, directions, two, levers, weight, 0b0111}));
    print("three touch, one broken",
          limited.solve(wrench, {broken_points, broken_directions, broken_friction, broken_levers,
                                 weight, 0b0111}));
  }
  print("made there",
        ForceOptimizer({Contacts::from(points, directions, two), limits_there}, newton)
            .solve(wrench));
  print("as before", limited.solve(wrench));
  ForceOptimizer copy = [&] {  // which outlives what it is a copy of
    ForceOptimizer gone({contacts, limits}, newton);
    gone.solve(wrench, there);
    return ForceOptimizer(static_cast<const ForceOptimizer&>(gone));
  }();
  print("copied", copy.solve(wrench));
  {  // a copy remembers; after the shorter row of a solver without limits it has room for its own
    ForceOptimizer remembering({contacts, limits}, newton);
    const double pull[] = {2, 0, 0, 0, 0, 0};  // its forces keep the limits
    remembering.remember(solver.solve(pull));
    ForceOptimizer heir(remembering);
    const auto follows = [&](int) {
      return heir.solve({.wrench = pull, .start = Start::previous}).summary().start ==
             double(Start::previous);
    };
    counted("copies", 5, follows);
    const Record kept = *heir.previous();
    heir.forget();
    const bool taken = heir.remember(kept);
    std::printf("remembered again: %d%d\n", taken, heir.previous().has_value());
  }
  std::printf("updated: %d\n", copy.update(there));
  print("updated there", copy.solve(wrench));
  print("not updated", limited.solve(wrench));
  {
    const double loads[] = {1, 0.5, -0.6, -0.1, 0.2, 0, none, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0};
    std::vector<double> rows(3 * solver.size());
    solver.solve_many(loads, rows);
    print("of many", Record(rows.data()));
    std::vector<double> several(6 * 40);
    std::vector<double> before(40 * solver.size());
    std::vector<double> after = before;
    for (int k = 0; k < 240; ++k) several[k] = (k % 6 < 3 ? 1.0 : 0.02) * std::sin(0.7 * k);
    ForceOptimizer fresh({contacts}, newton);
    fresh.solve_many(several, before);
    fresh.solve(wrench, {.positions = points});
    fresh.solve_many(several, after);
    std::printf("many after a call elsewhere: %d\n", before == after);
    const Ends ends("many");
    for (int k = 0; k < 3; ++k) ends(Record(rows.data() + solver.size() * k));
  }

  // no force: the record says why, and the last solution stays
  const double wrong[] = {1, 0, 0, 0, none, 0};
  const double huge[] = {1e13, 0, 0, 0, 0, 0};
  std::vector<double> flat(normals, normals + 12);
  std::vector<double> far(positions, positions + 12);
  std::vector<double> bad(12, none);
  std::vector<double> outside(12, 1.0);
  flat[2] = none;
  far[5] = 1e300;
  const std::span<const double> all(positions);
  const std::span<const double> up(normals);
  const std::vector<double> kept(solver.previous()->force(), solver.previous()->force() + 12);
  {
    const Ends ends("numbers");
    ends(solver.solve(wrong));
    ends(solver.solve(huge));
    ends(solver.solve(wrench, {.positions = far, .normals = flat}));
    ends(solver.solve(wrench, {.friction = bad}));
    ends(limited.solve(wrench, {.jacobian = std::vector<double>(144, none)}));
    ends(limited.solve(wrench, {.torque_bias = bad}));
  }
  {
    const Ends ends("sizes");
    ends(solver.solve(wrench, {.positions = all.first(9)}));
    ends(solver.solve(wrench, {.normals = up.first(9)}));
    ends(solver.solve(wrench, {.friction = up.first(3)}));
    ends(solver.solve(wrench, {.jacobian = separate}));
    ends(limited.solve(wrench, {.jacobian = shared}));
    ends(limited.solve(wrench, {.torque_bias = four}));
    ends(solver.solve({.wrench = wrench, .start = Start::given, .force = all.first(9)}));
    ends(solver.solve(wrench, {.positions = std::vector<double>(12, 0.1)}));
  }
  {
    const Ends ends("starts");
    ends(solver.solve({.wrench = wrench, .start = Start::given, .force = outside}));
    for (const Case& one : cases)
      if (one.options.method != Method::conic)
        ends(ForceOptimizer(one.problem, one.options)
                 .solve({.wrench = wrench, .start = Start::given, .force = outside}));
  }
  {
    const Ends ends("rank");
    ends(solver.solve(wrench, {.contacts = 0}));
    ends(ForceOptimizer({contacts}, flow).solve(wrench, {.contacts = 0b0011}));
  }
  {
    const Ends ends("infeasible");
    // two contacts, and a moment about the line through them
    ends(solver.solve(wrench, {.contacts = 0b0011}));
    for (const Options& options : {newton, flow, least_sum, least_largest})
      ends(ForceOptimizer({open}, options).solve(lift));
    ends(ForceOptimizer({contacts, tight}, newton).solve(wrench));
    ends(ForceOptimizer({soft, tight}, newton).solve(std::array{50.0, 0.0, 0.0, 0.0, 0.0, 0.0}));
  }
  std::printf("kept: %d\n", std::equal(kept.begin(), kept.end(), solver.previous()->force()));
  std::printf("no update: %d %d %d\n", limited.update({.normals = flat}),
              limited.update({.jacobian = shared}), limited.update({.contacts = 0b0111}));
  print("after", limited.solve(wrench));

  refused("one point", [&] { Contacts::from(std::vector<double>(12, 0.1), up, 0.4); });
  refused("two contacts, flow",
          [&] { ForceOptimizer({Contacts::from(all.first(6), up.first(6), 0.4)}, flow); });
  refused("normals", [&] { Contacts::from(all, up.first(9), 0.4); });
  refused("length", [&] { Contacts::from(all, std::vector<double>(12, 1.0), 0.4); });
  refused("nan", [&] { Contacts::from(all, flat, 0.4); });
  refused("friction", [&] { Contacts::from(all, up, -0.4); });
  refused("weights", [&] { Contacts::from(all, up, 0.4, {.force_weight = 0.0}); });
  refused("nothing", [&] { Contacts::from({}, {}, 0.4); });
  refused("not placed", [&] { ForceOptimizer({}); });
  refused("jacobian",
          [&] { ForceOptimizer({contacts, {.jacobian = separate, .torque_limit = four}}); });
  refused("bias", [&] {
    ForceOptimizer(
        {contacts, {.jacobian = separate, .torque_limit = torques, .torque_bias = four}});
  });
  refused("limits", [&] { ForceOptimizer({contacts, {.max_normal = torques}}); });
  refused("no limit", [&] { ForceOptimizer({contacts, {.max_normal = std::span(bad).first(4)}}); });
  refused("no jacobian", [&] {
    ForceOptimizer(
        {contacts, {.jacobian = std::vector<double>(144, none), .torque_limit = torques}});
  });
  refused("soft flow", [&] { ForceOptimizer({soft}, flow); });
  refused("limited flow", [&] { ForceOptimizer({contacts, limits}, flow); });
  refused("elastic alone", [&] { ForceOptimizer({contacts}, elastic); });
  refused("tolerance", [&] { ForceOptimizer({contacts}, {.tolerance = 2.0}); });
  refused("criterion", [&] { ForceOptimizer({contacts}, {.criterion = Criterion::largest}); });
  refused("file", [&] { ModelFile::load("nowhere"); });
  refused("model for three",
          [&] { ForceOptimizer({Contacts::from(all.first(9), up.first(9), 0.4)}, learning); });

  // allocations of every case with all starts and with contacts of the call
  const auto load = [](int k) {
    const double turn = 0.01 * k;
    return std::array<double, 6>{
        std::sin(turn), std::cos(turn), -1.0, 0.02 * std::cos(turn), 0.0, 0.01};
  };
  const Start starts[] = {Start::standard,           Start::previous,     Start::internal_force,
                          Start::linear_combination, Start::single_value, Start::lagrange,
                          Start::phase_one,          Start::learned};
  std::vector<double> row(1000);
  for (const Case& one : cases) {
    ForceOptimizer first(one.problem, one.options);
    first.solve(wrench, {.contacts = 0b0111});  // a copy still has room for all contacts
    ForceOptimizer mine = first;
    const bool joints = mine.size() > record_size(4, 0, int(one.problem.limits.many()));
    const bool many_rows = joints && one.problem.limits.jacobian.size() == 144;
    counted(one.name, calls, [&](int k) {
      const auto at = point(k);
      const auto inward = turned(k);
      const auto now = load(k);
      const auto arms = lever(k);
      Changes changes{.contacts = k % 7 == 3 ? 0b0111u : k % 7 == 5 ? 0b1011u : ~0ull};
      if (k % 3 > 0) changes.positions = at;
      if (k % 3 > 1 && one.load != press) changes.normals = inward;
      if (k % 5 == 1) changes.friction = two;
      if (many_rows && k % 4 == 1) changes.jacobian = arms;
      if (many_rows && k % 4 == 2) changes.torque_bias = weight;
      const Record& record = mine.solve(Request{
          .wrench = k % 11 == 10 ? one.load : now.data(), .now = changes, .start = starts[k % 8]});
      const bool ended =
          record.has_force() || record.code() == INFEASIBLE || record.code() == UNDECIDED;
      if (k % 13 == 0) mine.start({.wrench = one.load, .now = changes}, row.data());
      if (k % 50 == 49) {
        mine.solve(wrong);
        mine.solve(wrench, {.contacts = 1});
        mine.forget();
      }
      return ended;
    });
  }
  counted("set-up", 1,
          [&](int) { return ForceOptimizer({contacts}).solve(wrench).code() == CONVERGED; });
}
