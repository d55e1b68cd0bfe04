// The optimum of Phi as a smooth function of all inputs, W problems side by side: Newton's system
// with torsion and limits, the last step of a solve, the elastic force if no force exists, and
// gradients by the adjoint system. system.hpp, stiff.hpp, optima.hpp and gradients.hpp hold the
// longer functions.
//
// Variables of a contact are z = (u, o, t) in cone coordinates, or (u, o, t, v) if the batch has
// torsional friction. The optimum satisfies
//     grad E(z) + A^T y = 0,    A z + w - softness y = 0,
// with E = Phi plus the barriers of limits, A the map from z to the wrench in the unit frame, and
// softness 0 unless balance is a penalty. For a loss with derivatives g by z and h by y, the
// adjoint system
//     H p + A^T q = g,    A p - softness q = h
// has the matrix of Newton's step, and d loss / d theta = -(p . d_theta (grad E + A^T y) + q .
// d_theta (A z + w - softness y)).
#pragma once
#include <grasp/layer/batch.hpp>
#include <grasp/many/grasps.hpp>
#include <grasp/math/any_ldl.hpp>
#include <grasp/math/pivoted_qr.hpp>

namespace grasp {

// The problem whose optimum a force is: the problem itself; with limits that may be exceeded; with
// balance that may be missed as well; the problem itself, with contacts that cannot balance all
// wrenches.
enum class Regime { none, optimum, exceeding, unbalanced, within_reach };
inline bool is_optimum(Regime regime) {
  return regime == Regime::optimum || regime == Regime::within_reach;
}

// fraction of sqrt(lambda / omega): smaller slacks have a quadratic barrier
inline constexpr double ELASTIC_EDGE = 0.1;
// [N^2] per unit of Phi: missed balance costs |missed|^2 / (2 softness)
inline constexpr double ELASTIC_SOFTNESS = 1e-2;

// D: variables of a contact, see `Cones`.
template <int W, int D> class SmoothLanes {
 public:
  using V = Each<W>;
  using Mask = typename V::Mask;
  using X = Vec<V, D>;
  using Field = typename Cones<V, 0, D>::Field;
  V residual{}, iterations{};  // balance residual of the last `polish` [N]; of the last descent
  Mask converged{};            // of the stiff lanes of the last `polish`

  explicit SmoothLanes(const ForceBatch& batch)
      : x_(batch.contacts),
        batch_(batch),
        joints_(batch.torque_limit ? batch.joints : 0),
        cones_(batch.contacts),
        placed_(batch.contacts),
        rest_(batch.contacts),
        at_(batch.contacts),
        rows_(joints_),
        columns_(std::size_t(joints_ * batch.contacts)),
        scaled_(columns_.size()),
        step_(batch.contacts),
        back_(batch.contacts),
        pull_(batch.contacts),
        along_(joints_) {}

  // Load problem k into a lane; `place` still reads `posed`.
  void load(int lane, std::ptrdiff_t k, const PosedProblem& posed, Regime regime);
  // Choose the optimum of a lane. posed: its contacts, as loaded.
  void choose(int lane, Regime regime, const PosedProblem& posed) {
    set(softness_, lane, regime == Regime::unbalanced ? ELASTIC_SOFTNESS : 0.0);
    set(last_, lane, is_optimum(regime) ? 0.0 : ELASTIC_EDGE);
    reach_[lane] =
        regime == Regime::within_reach ? posed.placed(batch_, number(lane)).reach : WrenchSpace{};
  }
  // Compute frames, columns and rows. Return a mask of the problems without degenerate contacts.
  Mask place() {
    const Mask good = placed_.place(problems_, cones_);
    w_ = cones_.unit.of(wrench_);
    for (int i = 0; i < count(); ++i) {
      Contact& c = at_[i];
      const FrameOf<V> frame(c.frame[0], c.along);
      for (int a = 0; a < 3; ++a) c.frame[a] = frame[a];
      c.arm = c.arm - cones_.unit.centre;
    }
    shared_ = false;
    for (int j = 0; j < joints_; ++j) place_row(j);
    edge_ = last_;
    place_edges();
    return good;
  }

  // --- start of a descent

  // Start from an internal force. Return the problems that have one.
  Mask begin() {
    const Mask closes = placed_.internal_force(cones_, rest_);
    const V scale = best_scale(cones_, rest_);
    for (auto& x : rest_) x = scale * x;
    grasp::begin(cones_, rest_, w_, x_);
    return closes & (cones_.phi(x_) < infinity);
  }
  // Replace the start by forces (N, 3) [N] in contact frames (null: none) if they, once balanced,
  // have less Phi.
  void take_starts(const double* const (&starts)[W]) {
    if (std::none_of(starts, starts + W, [](const double* start) { return start; })) return;
    rest_ = x_;
    for (int lane = 0; lane < W; ++lane)
      if (starts[lane]) cones_.load_force(starts[lane], rest_, lane);
    cones_.balance(rest_, w_);
    copy_where(cones_.phi(rest_) < cones_.phi(x_), rest_, x_);
  }
  // Start from a force (N, 3) [N] in contact frames with its torsion (N,) [N m] and multipliers
  // (6,) nu of the given wrench.
  void begin(int lane, const double* force, const double* torsion, const Vec6& nu) {
    cones_.load_force(force, x_, lane, torsion);
    const auto& unit = cones_.unit;
    const Point turn{nu[3], nu[4], nu[5]};
    const Point centre{get(unit.centre.u, lane), get(unit.centre.o, lane),
                       get(unit.centre.t, lane)};
    const Point move = Point{nu[0], nu[1], nu[2]} + cross(turn, centre);
    for (int a = 0; a < 3; ++a) {
      set(y_[a], lane, -move[a]);
      set(y_[3 + a], lane, -turn[a] * get(unit.length, lane));
    }
  }
  void begin(int lane) {
    for (int i = 0; i < count(); ++i)
      for (int a = 0; a < D; ++a) set(x_[i][a], lane, a == 0 ? get(at_[i].unit, lane) : 0.0);
    for (V& y : y_) set(y, lane, 0.0);
  }
  // The state of a problem: z (N, 4), zero beyond D, and the multipliers in the unit frame.
  void save(int lane, double* state) const {
    for (int i = 0; i < count(); ++i)
      for (int a = 0; a < 4; ++a) state[4 * i + a] = a < D ? get(x_[i][a], lane) : 0.0;
    for (int r = 0; r < 6; ++r) state[4 * count() + r] = get(y_[r], lane);
  }
  void restore(int lane, const double* state) {
    for (int i = 0; i < count(); ++i)
      for (int a = 0; a < D; ++a) set(x_[i][a], lane, state[4 * i + a]);
    for (int r = 0; r < 6; ++r) set(y_[r], lane, state[4 * count() + r]);
  }

  // --- optima

  // Damped Newton for the live ordinary lanes, in at most `most` steps. Return the lanes close to
  // their optimum.
  Mask descend(Mask live, int most);
  // Take full Newton steps to the last digits of an optimum, as long as they do not raise E. Solve
  // elastic lanes, and finish those that are stiff.
  void polish(const Mask& which);
  // (E - bound) / bound, where bound is the dual value at the multipliers. inf: no bound.
  V gap() const;
  Mask balanced() const { return cones_.balanced(x_, w_, residual); }

  // Write forces (N, 3) [N] in the frame of the positions, torsion (N,) [N m], and multipliers (6,)
  // nu = -y.
  void write(int lane, double* force, double* torsion, double* multipliers) const;

  // Gradients of a loss at the restored and placed problems, for those that are chosen.
  void gradients(Mask chosen, const BatchLosses& losses, const BatchGradients& to);

 private:
  // One limit a . z <= bound, with the barrier weight / slack of its normalised slack, quadratic
  // below `edge`. weight 0: no limit.
  struct Limit {
    V bound, weight, price, bend;

    V barrier(const V& along, const V& edge) const {
      const V slack = bound - along;
      const V c = max(slack, edge);
      const V i = 1.0 / c;
      const V e = (slack - c) * i;
      return weight * i * (1.0 - e + e * e);
    }
    V room(const V& along, const V& edge) const {
      return select(edge > 0.0, V(infinity), bound - along);
    }
    void bind(const V& along, const V& edge) {
      const V slack = bound - along;
      const V c = max(slack, edge);
      const V i = 1.0 / c;
      const V first = weight * i * i;
      bend = 2.0 * first * i;
      price = first - bend * (slack - c);
    }
    // d price / d edge at a fixed slack.
    V by_edge(const V& along, const V& edge) const {
      const V below = min(bound - along - edge, V(0.0));
      const V i = 1.0 / max(edge, V(1e-100));
      return select((edge > 0.0) & (below < 0.0), 6.0 * weight * below * i * i * i * i, V(0.0));
    }
  };
  struct Contact {
    // direction of o; (n, o, t); position relative to the contacts' centre [m]
    Vec3<V> along, frame[3], arm;
    Limit low, high;  // limits of u
    V lambda;         // of limits; that of the cone is `fitted`
    V unit, edge;     // sqrt(lambda / omega); slack below which the barrier is quadratic
    // at z: inverse Hessian with the contact's own rows, and the gradient of all terms
    Sym<V, D> inverse;
    X gradient;
  };
  struct Row {
    Limit low, high;
    V size, unit, edge, along, price;
    V touches, lambda, omega;  // number of contacts it acts on, and their means
    V empty, own;              // 1: no force changes it; it acts on at most one contact
    V bend, root;              // bend of an own row; square root of that of a shared row
  };
  struct Column {
    X c;
    V touched;
    bool any;  // true if it is non-zero in any lane
  };
  // fraction of E: largest value of a step's balance residual
  static constexpr double ROUNDED = 1e-13;
  // fraction of E: largest rise by a full step
  static constexpr double RAISED = 1e-11;
  // first edge of a descent, and its factor
  static constexpr double LARGEST_EDGE = 8.0, EDGE_FACTOR = 1.0 / 16.0;
  static constexpr double ELASTIC_FACTOR = 0.5;  // that of an elastic one
  // below it the problem is nearly infeasible, for another solver
  static constexpr double LEAST_EDGE = 1e-6;
  // squared decrement, as a fraction of E, below which the edge is lowered
  static constexpr double CLOSE = 0.03;
  static constexpr double SETTLED = 1e-9;  // the same, below which `polish` takes over
  // allowed residual, as a fraction of an adjoint force and of its right-hand side
  static constexpr double MISSES = 1e-13;
  static constexpr double LONG = 0.95;  // fraction of the way to the boundary
  static constexpr int HALVINGS = 40, REFINEMENTS = 2, WHOLE_STEPS = 2;
  // slack over sqrt(lambda / omega), |y| over omega: further are stiff
  static constexpr double TIGHT = 0.1, DEAR = 100.0;
  // relative steps of forces and of their distances from the cones: of a force with all digits; the
  // largest of a converged one; below which steps are whole, and one not a quarter of the one
  // before is rounding; that which ends a stage
  static constexpr double LEAST = 1e-13, ROUGH = 1e-6, SHORT = 1e-4, STAGE = 0.25;
  static constexpr double NOISE = 1e-14;  // rounding of E, relative
  static constexpr int STIFF_STEPS = 300;

  Field x_;     // z
  Six<V> y_{};  // multipliers of balance, unit frame
  const ForceBatch& batch_;
  int joints_;
  Cones<V, 0, D> cones_;
  PlacedLanes<W, D> placed_;
  Field rest_;
  std::vector<Contact> at_;
  std::vector<Row> rows_;
  // rows divided by their length; shared rows times their roots
  std::vector<Column> columns_, scaled_;
  bool shared_ = false;  // true if any row is shared
  Field step_, back_, pull_;
  std::vector<V> both_;
  mutable std::vector<V> along_;
  AnyLdl<V> schur_;
  PivotedQr stiff_;
  std::vector<std::array<Vec<double, D>, D>> axes_;
  std::vector<double> nearest_, multipliers_;
  Six<V> wrench_{}, w_{};
  // edges in units of the limits; smallest slack at the last system
  V softness_{}, last_{}, edge_{}, tightest_{};
  LaneProblem problems_[W] = {};
  WrenchSpace reach_[W];  // the wrenches that contacts make: all, except for `Regime::within_reach`

  int count() const { return batch_.contacts; }
  std::ptrdiff_t number(int lane) const { return problems_[lane].number; }
  int shared_rows() const { return shared_ ? joints_ : 0; }
  Column& column(int i, int j) { return columns_[std::size_t(joints_ * i + j)]; }
  const Column& column(int i, int j) const { return columns_[std::size_t(joints_ * i + j)]; }
  V along(int i, int j, const X& x) const { return dot(column(i, j).c, x); }
  static Vec<double, D> of(const X& x, int lane) {
    Vec<double, D> out;
    for (int a = 0; a < D; ++a) out[a] = get(x[a], lane);
    return out;
  }
  static Weights<double, D> of(const Weights<V, D>& weights, int lane) {
    Weights<double, D> out;
    out.omega = get(weights.omega, lane);
    out.lambda = get(weights.lambda, lane);
    if constexpr (D == 4) out.axial = get(weights.axial, lane);
    return out;
  }
  static void load_side(Limit& side, int lane, bool there, double bound, double weight) {
    set(side.bound, lane, there ? bound : UNBOUNDED);
    set(side.weight, lane, there ? weight : 0.0);
  }
  // The force of z in the frame of the positions, and its moment along the normal.
  Vec3<V> object_force(int i, const X& z) const {
    const Contact& c = at_[i];
    const X& divisor = cones_.blocks[i].divisor;
    return (z.u / divisor.u) * c.frame[0] + (z.o / divisor.o) * c.frame[1] +
           (z.t / divisor.t) * c.frame[2];
  }
  V moment(int i, const X& z) const {
    if constexpr (D == 4)
      return z.v / cones_.blocks[i].divisor.v;
    else
      return V{};
  }
  // Motion (3,) of contact i per speed of joint j, from row `from` of the Jacobian on.
  Vec3<V> motion(int i, int j, int from) const {
    Vec3<V> moves{};
    for (int lane = 0; lane < W; ++lane)
      for (int a = 0; a < 3; ++a)
        set(moves[a], lane,
            batch_
                .jacobian[number(lane)][(i * batch_.jacobian_rows + from + a) * batch_.joints + j]);
    return moves;
  }

  void place_row(int j);
  void place_edges() {
    for (Contact& c : at_) c.edge = edge_ * c.unit;
    for (Row& row : rows_) row.edge = edge_ * row.unit;
  }

  // E with the penalty of missed balance; +inf unless strictly inside. at(i): z of contact i.
  template <class F> V energy_at(F&& at) const {
    V total{}, room = infinity;
    Six<V> missed = w_;
    std::fill(along_.begin(), along_.end(), V{});
    for (int i = 0; i < count(); ++i) {
      const Contact& c = at_[i];
      const X here = at(i);
      total += phi(here, cones_.blocks[i].weights);
      room = min(room, min(here.u, lorentz(here, here)));
      if (batch_.min_normal || batch_.max_normal) {
        total += c.low.barrier(-here.u, c.edge) + c.high.barrier(here.u, c.edge);
        room = min(room, min(c.low.room(-here.u, c.edge), c.high.room(here.u, c.edge)));
      }
      for (int r = 0; r < 6; ++r) missed[r] += dot(cones_.blocks[i].g[r], here);
      for (int j = 0; j < joints_; ++j) along_[j] += along(i, j, here);
    }
    for (int j = 0; j < joints_; ++j) {
      const Row& row = rows_[j];
      total += row.high.barrier(along_[j], row.edge) + row.low.barrier(-along_[j], row.edge);
      room = min(room, min(row.high.room(along_[j], row.edge), row.low.room(-along_[j], row.edge)));
    }
    total += select(softness_ > 0.0, 0.5 * dot(missed, missed) / softness_, V(0.0));
    return select((room > 0.0) & (total == total), total, V(infinity));
  }
  V energy() const {
    return energy_at([&](int i) { return x_[i]; });
  }
  V energy_along(const V& alpha) const {
    return energy_at([&](int i) { return x_[i] + alpha * step_[i]; });
  }
  Six<V> missed() const {  // A z + w
    Six<V> wrench = w_;
    for (int i = 0; i < count(); ++i)
      for (int r = 0; r < 6; ++r) wrench[r] += dot(cones_.blocks[i].g[r], x_[i]);
    return wrench;
  }

  void assemble();
  void bind();
  void bind(int i);
  Mask rank_lost() const {
    Mask lost{};
    for (int lane = 0; lane < W; ++lane) lost[lane] = reach_[lane].full() ? 0 : -1;
    return lost;
  }
  // stiff.hpp: lanes where `solve` loses digits; its version for one lane; Newton's method with it
  Mask stiff() const;
  bool solve_stiff(int lane, const Six<V>& h, Six<V>& q);
  V relative_step() const;
  Mask finish(Mask open);
  const Column& scaled(int i, int r) const { return scaled_[joints_ * i + r - 6]; }

  // (inverse^-1 + bend a a^T)^-1
  static void subtract_rank_one(Sym<V, D>& inverse, const V& bend, const X& a) {
    const X h = inverse * a;
    inverse.subtract(bend / (1.0 + bend * dot(h, a)), h);
  }

  // Solve H p + A^T q = g, A p - softness q = h, with H of all terms; g is overwritten. Stiff
  // barriers cost digits, so the system also removes the residual of p in h. allowed(q): largest
  // residual of h.
  template <class F> Six<V> solve(Field& g, const Six<V>& h, Field& p, F&& allowed) {
    Six<V> q = solve_once(g, h, p);
    for (int round = 0; round < REFINEMENTS; ++round) {
      Six<V> left = h + softness_ * q;
      for (int i = 0; i < count(); ++i)
        for (int r = 0; r < 6; ++r) left[r] -= dot(cones_.blocks[i].g[r], p[i]);
      const Mask rough = size(left) > allowed(q);
      if (!any(rough)) break;
      std::fill(g.begin(), g.end(), X{});
      q = q + solve_once(g, select(rough, left, Six<V>{}), back_);
      for (int i = 0; i < count(); ++i) p[i] += back_[i];
    }
    return q;
  }
  Six<V> solve_once(Field& g, const Six<V>& h, Field& p) {
    for (int r = 0; r < 6 + shared_rows(); ++r) both_[r] = r < 6 ? -h[r] : V{};
    for (int i = 0; i < count(); ++i) {
      p[i] = at_[i].inverse * g[i];
      for (int r = 0; r < 6; ++r) both_[r] += dot(cones_.blocks[i].g[r], p[i]);
      for (int r = 6; r < 6 + shared_rows(); ++r) both_[r] += dot(scaled(i, r).c, p[i]);
    }
    schur_.solve(both_);
    for (int i = 0; i < count(); ++i) {
      for (int r = 0; r < 6; ++r) g[i] -= both_[r] * cones_.blocks[i].g[r];
      for (int r = 6; r < 6 + shared_rows(); ++r) g[i] -= both_[r] * scaled(i, r).c;
      p[i] = at_[i].inverse * g[i];
    }
    Six<V> q;
    for (int r = 0; r < 6; ++r) q[r] = both_[r];
    return q;
  }
  // Newton step into step_. Return the new multipliers.
  Six<V> newton_step(const V& value) {
    assemble();
    for (int i = 0; i < count(); ++i) pull_[i] = -at_[i].gradient;
    Six<V> left = missed();
    for (V& component : left) component = -component;
    return solve(pull_, left, step_, [&](const Six<V>& y) { return ROUNDED * value / size(y); });
  }
  // Squared decrement of the step, and 1 / (largest step inside the cones).
  struct Progress {
    V decrement, reach;
  };
  Progress judged_step() const {
    Progress step{V{}, V(1e-300)};
    const Six<V> pull = (1.0 / select(softness_ > 0.0, softness_, V(infinity))) * missed();
    for (int i = 0; i < count(); ++i) {
      step.decrement -= dot(at_[i].gradient + cones_.blocks[i].transposed(pull), step_[i]);
      step.reach = max(step.reach, Boundary(x_[i]).per(step_[i]));
    }
    return step;
  }
};

}  // namespace grasp
