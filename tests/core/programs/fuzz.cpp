// Random bytes become contacts, limits, options and calls of `ForceOptimizer`. It must not crash or
// hang, and a force that it returns must be finite, inside the cones and balanced.
//
//     clang++ -fsanitize=fuzzer,address,undefined ... fuzz.cpp   with libFuzzer
//     g++ -DGRASP_SEEDED ... fuzz.cpp; fuzz SEED COUNT           random bytes
#include <grasp/optimizer.hpp>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <utility>

namespace {

using namespace grasp;

class Bytes {
 public:
  bool wild = false;

  Bytes(const std::uint8_t* data, std::size_t size) : data_(data), left_(size) {}
  int whole(int least, int most) { return least + next() % (most - least + 1); }
  bool one_in(int many) { return whole(1, many) == many; }
  double fraction() { return (next() + 256.0 * next()) / 65535.0; }
  double decades(double least, double most) { return least * std::pow(most / least, fraction()); }
  // of this size; in a wild input now and then an odd number
  double number(double size) {
    constexpr double odd[] = {0.0,    infinity, -infinity, NAN,    1e308,  -1e308,
                              5e-324, 1e-310,   1e12,      1.1e12, 1e-200, 1e20};
    return wild && one_in(32) ? odd[whole(0, int(std::size(odd)) - 1)]
                              : size * (2.0 * fraction() - 1.0);
  }
  std::vector<double> numbers(int count, double size) {
    std::vector<double> out(count);
    for (double& value : out) value = number(size);
    return out;
  }

 private:
  const std::uint8_t* data_;
  std::size_t left_;

  int next() { return left_ ? --left_, *data_++ : 0; }
};

// The contacts and limits of a call.
struct Case {
  int count = 0, joints = 0, moves = 0;  // moves: rows of the Jacobian, 3 or 6
  std::vector<double> positions, normals, friction, along, gamma, least, most, jacobian, torque,
      bias;
  Objective objective;
  double share = 1.0;           // of the friction, for the margin
  std::vector<double> preload;  // (N,) [N]
  std::uint64_t contacts = ~std::uint64_t(0);

  bool touches(int i) const { return contacts >> i & 1; }
  double mu(int i, int axis) const {
    const std::size_t size = friction.size();
    const std::size_t n = std::size_t(count);
    return size == 1 ? friction[0] : size == n ? friction[i] : friction[2 * i + axis];
  }
  bool slippery(int i) const { return !(mu(i, 0) > 0.0 && mu(i, 1) > 0.0); }
  double torsion(int i) const { return gamma.empty() ? 0.0 : gamma[i]; }
  Point place(int i) const { return point(&positions[3 * i]); }
  // Centre and spread of the contacts that touch.
  std::pair<Point, double> around() const {
    Point centre{};
    double touching = 0.0, spread = 0.0;
    for (int i = 0; i < count; ++i)
      if (touches(i)) {
        centre += place(i);
        touching += 1.0;
      }
    centre = centre / std::max(touching, 1.0);
    for (int i = 0; i < count; ++i)
      if (touches(i)) spread = std::max(spread, length(place(i) - centre));
    return {centre, spread};
  }
  ForceLimits limits() const { return {least, most, jacobian, torque, bias}; }
  Margin margin() const { return {share, preload}; }
};

const char* call = "";  // the call under test

void require(bool good, const char* what, const Record& record, double value) {
  if (good) return;
  const auto& s = record.summary();
  std::fprintf(stderr,
               "%s: %s (%g); code %g, start %g, objective %.17g, bound %.17g, margin %g, residual "
               "%g, excess %g\n",
               call, what, value, s.code, s.start, s.objective, s.lower_bound, s.margin, s.residual,
               s.limit_excess);
  std::abort();
}

// part of wrench and forces; contacts nearly on a line have fewer digits than others
constexpr double BALANCED = 1e-6;
// part of a force by which rounding may take conic forces out of their cones
constexpr double INSIDE = 1e-9;

// Compares a record with its case; tests/force/test_trial.py judges optima, bounds and
// proofs.
void check(const Case& g, const double* wrench, const Options& options, const Record& record) {
  const Summary& s = record.summary();
  const Code code = record.code();
  const int n = g.count;
  const bool inner = options.method != Method::conic;  // the method stays strictly inside the cones
  require(s.code >= double(CONVERGED) && s.code <= double(STARTED), "no code", record, s.code);
  require(record.contacts() == n && int(s.joints) == g.joints, "sizes", record, s.contacts);
  const double* end = record.limit_multipliers() + int(s.limits);
  const double* used = record.friction_used();
  if (!record.has_force() && code != STARTED) {
    for (const double* v = record.force();
         v < (code == INFEASIBLE ? record.limit_multipliers() : end);
         ++v)  // a proof has multipliers
      require(*v == 0.0, "no force, but numbers", record, *v);
    return;
  }
  for (const double* v = record.force(); v < end; ++v)
    require(std::abs(*v) < infinity || (v >= used && v < used + n), "no number", record, *v);
  for (const double* v = record.limit_multipliers(); v < end; ++v)
    require(*v >= 0.0, "a negative multiplier", record, *v);

  const auto [centre, spread] = g.around();
  double most = 0.0;
  for (int j = 0; j < 3 * n; ++j) most = std::max(most, std::abs(record.force()[j]));
  Point force = point(wrench);
  Point moment = point(wrench + 3) - cross(centre, force);
  double size = length(force) + length(moment) / spread;
  for (int i = 0; i < n; ++i) {
    const double* f = record.force() + 3 * i;
    const double* frame = record.frames() + 9 * i;
    const double turn = record.torsion()[i];
    if (!g.touches(i)) {
      require(f[0] == 0.0 && f[1] == 0.0 && f[2] == 0.0 && turn == 0.0,
              "a force of a finger in the air", record, i);
      require(std::isnan(used[i]), "a finger in the air uses friction", record, used[i]);
      continue;
    }
    double v[3];
    record.object_force(i, v);
    const Point normal = point(&g.normals[3 * i]);
    const Point arm = g.place(i) - centre;
    require(length(Point{frame[0], frame[3], frame[6]} - normal) < 4e-6, "a frame's normal", record,
            frame[0]);
    force += point(v);
    moment += cross(arm, point(v)) + turn * normal;
    size += length(point(v)) * (1.0 + length(arm) / spread) + std::abs(turn) / spread;

    const bool slips = g.slippery(i);
    require(!slips || (f[1] == 0.0 && f[2] == 0.0), "a tangential force without friction", record,
            f[1]);
    const double side = slips ? 0.0 : std::hypot(f[1] / g.mu(i, 0), f[2] / g.mu(i, 1));
    const double gamma = g.torsion(i);
    require(gamma > 0.0 || turn == 0.0, "torsion of a hard contact", record, turn);
    const double needed = std::hypot(side, gamma > 0.0 ? turn / gamma : 0.0);
    const double room = f[0] - g.preload[i] - needed / g.share;
    require(room >= (inner ? -1e-14 * f[0] : -INSIDE * std::max(f[0], most)), "outside a cone",
            record, room);
    require(f[0] <= 0.0 || std::abs(used[i] - needed / f[0]) <= 1e-9 * used[i], "friction used",
            record, used[i]);
  }
  const double missed = length(force) + length(moment) / spread;
  require(spread >= 1e6 || missed <= BALANCED * size, "not balanced", record,
          missed);  // [m]: beyond, balance has no digits
}

std::vector<double> friction_of(Bytes& from, int count) {
  const int sizes[] = {1, 1, count, 2 * count};
  std::vector<double> friction(sizes[from.whole(0, 3)]);
  for (double& mu : friction)
    mu = from.wild && from.one_in(8) ? std::abs(from.number(1.0))
         : from.one_in(16)           ? 0.0
                                     : from.decades(0.05, 3.0);
  return friction;
}
void tilt(Bytes& from, double* normal, double by) {
  normal[0] += by * (2.0 * from.fraction() - 1.0);
  const double size = length(point(normal));
  for (int a = 0; a < 3; ++a) normal[a] /= size > 0.0 ? size : 1.0;
}
// A Jacobian of joints of one finger each, with a shared one among them, or of joints that all
// fingers share.
std::vector<double> jacobian_of(Bytes& from, const Case& g) {
  std::vector<double> jacobian(std::size_t(g.moves) * g.count * g.joints);
  const int mixed = from.whole(0, 3);
  for (int i = 0; i < g.count; ++i)
    for (int r = 0; r < g.moves; ++r)
      for (int j = 0; j < g.joints; ++j)
        if (mixed == 0 || j % g.count == i || (mixed == 1 && j == 0))
          jacobian[(g.moves * i + r) * g.joints + j] = from.number(r < 3 ? 0.06 : 1.0);
  return jacobian;
}

// Preloads stay below the smallest limit of normal forces.
void margin_of(Bytes& from, Case& g) {
  g.share = from.one_in(2) ? 1.0 : 0.1 + 0.9 * from.fraction();
  const bool some = from.one_in(2);
  const double most = g.most.empty() ? 10.0 : 0.1;
  for (double& preload : g.preload)
    preload = some && from.one_in(2) ? most * from.fraction() * from.fraction() : 0.0;
}

Case contacts_of(Bytes& from) {
  Case g;
  g.count = from.whole(2, from.one_in(4) ? 18 : 6);
  from.wild = from.one_in(2);
  const double far = from.one_in(4) ? 1.0 : 0.0;
  const double thin = from.one_in(4) ? from.decades(1e-6, 1.0) : 1.0;
  for (int i = 0; i < g.count; ++i) {
    Point at;
    for (int a = 0; a < 3; ++a) at[a] = 2.0 * from.fraction() - 1.0;
    at = at / (length(at) + 1e-9);
    for (int a = 0; a < 3; ++a) {
      g.positions.push_back(far + 0.05 * at[a] * (a == 1 ? thin : 1.0) + from.number(1e-4));
      g.normals.push_back(-at[a]);
    }
    tilt(from, &g.normals[3 * i], 0.3);
  }
  g.friction = friction_of(from, g.count);
  if (from.one_in(3))
    for (int i = 0; i < g.count; ++i)
      g.gamma.push_back(from.one_in(2) ? 0.0 : from.decades(1e-3, 0.1));
  if (from.one_in(4)) g.along = from.numbers(3 * g.count, 1.0);
  if (from.one_in(4)) g.objective = {from.decades(1e-4, 1e4), from.decades(1e-16, 1e6)};
  g.preload.resize(g.count);
  return g;
}
void limit(Bytes& from, Case& g) {
  if (from.one_in(2)) g.most = from.numbers(g.count, 1.0);
  for (double& v : g.most) v = std::abs(v) * 20.0 + 0.1;
  if (from.one_in(2)) g.least = from.numbers(g.count, 0.1);
  for (double& v : g.least) v = from.wild ? v : std::abs(v);
  if (!from.one_in(2)) return;
  g.joints = from.whole(1, from.one_in(4) ? 3 * g.count : 4);
  g.moves = from.one_in(2) ? 3 : 6;
  g.jacobian = jacobian_of(from, g);
  g.bias = from.numbers(g.joints, 0.05);
  for (int j = 0; j < g.joints; ++j)
    g.torque.push_back(from.one_in(8) ? infinity : from.decades(1e-3, 10.0));
}
Options options_of(Bytes& from, Case& g) {
  constexpr Method methods[] = {Method::newton, Method::newton,       Method::conic,
                                Method::conic,  Method::reduced_flow, Method::full_flow};
  Options options{.method = methods[from.whole(0, 5)]};
  const bool flow = options.method == Method::reduced_flow || options.method == Method::full_flow;
  if (flow) {
    g.gamma.clear();
    options.limit = from.whole(0, 250);
    options.step_rule.kind = from.whole(0, StepRule::EXACT);
  } else if (from.one_in(2))
    limit(from, g);
  if (options.step_rule.kind == StepRule::EXACT) options.step_rule.decrease = 0.1;
  if (options.method == Method::conic && from.one_in(3)) options.criterion = Criterion::largest;
  if (from.one_in(3)) options.start = Start(from.whole(0, int(Start::previous)));
  if (from.one_in(4)) options.tolerance = from.decades(1e-14, 1.0);
  if (from.one_in(8)) options.limit = from.whole(0, 200);
  if (!g.least.empty() || !g.most.empty() || g.joints) options.elastic = from.one_in(2);
  return options;
}
std::array<double, 6> load_of(Bytes& from) {
  const double size = from.one_in(4) ? from.decades(1e-12, 1e9) : 5.0;
  std::array<double, 6> w;
  for (int r = 0; r < 6; ++r) w[r] = from.number(r < 3 ? size : 0.05 * size);
  return w;
}
// Contacts and limits of a call, of which `now` holds what has changed; g becomes all of them.
Changes moved(Bytes& from, Case& g, bool some, std::vector<double>& friction) {
  Changes now;
  if (from.one_in(2)) {
    for (double& v : g.positions) v += from.number(from.one_in(8) ? 0.05 : 1e-3);
    now.positions = g.positions;
  }
  if (from.one_in(3)) {
    for (int i = 0; i < g.count; ++i) tilt(from, &g.normals[3 * i], 0.1);
    now.normals = g.normals;
  }
  if (from.one_in(6)) {
    Case other = g;
    other.friction = friction = friction_of(from, g.count);
    now.friction = friction;
    std::vector<double> values;  // frictionless contacts stay frictionless
    for (int k = 0; k < 2 * g.count; ++k)
      values.push_back(g.slippery(k / 2) ? 0.0 : other.mu(k / 2, k % 2));
    g.friction = values;
  }
  if (g.joints && from.one_in(3)) {
    g.jacobian = jacobian_of(from, g);
    now.jacobian = g.jacobian;
  }
  if (g.joints && from.one_in(3)) {
    g.bias = from.numbers(g.joints, 0.05);
    now.torque_bias = g.bias;
  }
  if (from.one_in(4)) {
    margin_of(from, g);
    now.margin = g.margin();
  }
  if (some && from.one_in(3)) {
    g.contacts = 0;
    for (int i = 0; i < g.count; ++i) g.contacts |= std::uint64_t(!from.one_in(4)) << i;
    now.contacts = g.contacts;
  }
  return now;
}

void run_calls(Bytes& from) {
  Case home = contacts_of(from);
  const Options options = options_of(from, home);
  const Contacts contacts = Contacts::from(home.positions, home.normals, home.friction,
                                           home.objective, home.along, home.gamma);
  if (from.one_in(2)) margin_of(from, home);
  ForceOptimizer on({contacts, home.limits(), home.margin()}, options);
  std::vector<double> row(on.size());
  std::vector<double> other(on.size());
  std::vector<double> friction;
  for (int round = from.whole(1, 4); round > 0; --round) {
    if (from.one_in(8)) {
      Case there = home;
      call = "update";
      const bool updated = on.update(moved(from, there, false, friction));
      if (updated)
        home = there;
      else if (!from.wild)
        std::abort();
    }
    const auto w = load_of(from);
    Case there = home;
    const Changes now = moved(from, there, true, friction);
    Request request{.wrench = w.data(), .now = now};
    if (from.one_in(2)) request.start = Start(from.whole(0, int(Start::learned)));
    std::vector<double> force;
    if (request.start == Start::given || request.start == Start::guess) {
      force = from.numbers(3 * home.count, 5.0);
      if (on.previous() && from.one_in(2))
        std::copy_n(on.previous()->force(), 3 * home.count, force.begin());
      request.force = force;
    }
    call = "solve";
    const Record record = on.solve(request);
    check(there, w.data(), options, record);
    require(record.code() != REFUSED || from.wild || request.start == Start::given, "refused",
            record, 0.0);
    if (from.one_in(4)) {  // the same problem from another start, by a copy and again
      ForceOptimizer copy(std::as_const(on));
      Request again = request;
      again.start = Start(from.whole(0, int(Start::phase_one)));
      call = "again";
      copy.solve(again, other.data());
      on.solve(again, row.data());
      const Record copied(other.data());
      check(there, w.data(), options, copied);
      require(std::memcmp(row.data(), other.data(), row.size() * sizeof(double)) == 0, "other bits",
              copied, 0.0);
    }
    if (from.one_in(8)) {
      call = "start";
      on.start(request, row.data());
      check(there, w.data(), options, Record(row.data()));
    }
    if (from.one_in(8)) {
      std::vector<double> loads, rows;
      for (int many = from.whole(0, 20); many > 0; --many)
        for (const double v : load_of(from)) loads.push_back(v);
      rows.resize(loads.size() / 6 * on.size());
      call = "solve_many";
      on.solve_many(loads, rows);
      for (std::size_t k = 0; 6 * k < loads.size(); ++k)
        check(home, &loads[6 * k], options, Record(&rows[k * on.size()]));
    }
    if (from.one_in(8)) on.forget();
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  Bytes from(data, size);
  try {
    run_calls(from);
  } catch (const std::invalid_argument&) {  // set-up has named what is wrong
  }
  return 0;
}

#ifdef GRASP_SEEDED
int main(int argc, char** arguments) {
  if (argc != 3) return 2;
  std::uint64_t state = std::strtoull(arguments[1], nullptr, 10) * 2 + 1;
  const long count = std::atol(arguments[2]);
  std::vector<std::uint8_t> bytes(2000);
  for (long k = 0; k < count; ++k) {
    for (std::uint8_t& byte : bytes) {
      state = state * 6364136223846793005u + 1442695040888963407u;
      byte = std::uint8_t(state >> 56);
    }
    LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
  }
  std::printf("%ld\n", count);
  return 0;
}
#endif
