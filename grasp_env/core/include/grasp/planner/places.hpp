// Places on an object that one finger of a hand can touch on its own.
//
// A finger whose tip can go anywhere reaches them by inverse kinematics. For others, one joint
// closes from a drawn posture until the tip touches. Joints that move several fingers stay fixed,
// unless a finger has no others, such as jaws with one motor: then the motor of its last joint
// closes it.
#pragma once
#include <utility>
#include <grasp/planner/place.hpp>
#include <grasp/hand/reach.hpp>

namespace grasp {

// One finger of a hand: its joints as a tree of their own, and the limbs that they carry.
class Finger {
 public:
  std::vector<int> joints;   // indices in the hand
  std::vector<int> carried;  // indices of its limbs in the hand
  std::vector<Limb> limbs;   // links indexed as in the finger
  bool free = false;         // its tip can go anywhere nearby
  int closer = -1;  // motor in the hand that closes it, and others, if it has none of its own

  // home: (M,) [rad] start of the inverse kinematics
  Finger(const Tree& hand, int number, const std::vector<Limb>& all, const double* home,
         const std::vector<int>& fingers_per_motor)
      : tree_(make_tree(hand, number, home, fingers_per_motor)), reach_(tree_), posture_(tree_) {
    for (int j : joints) home_.push_back(home[j]);
    for (std::size_t c = 0; c < all.size(); ++c) {
      const auto at = std::find(joints.begin(), joints.end(), all[c].link);
      if (at == joints.end()) continue;
      carried.push_back(int(c));
      limbs.push_back(all[c]);
      limbs.back().link = int(at - joints.begin());
    }
    angles_ = home_;
    free = own_joints_.size() >= 3 && is_spatial();
    posture_.trace(home_.data());
    const Point tip = posture_.tip(0);
    direction_ = (1.0 / std::max(length(tip), 1e-9)) * tip;
  }

  bool carries(int limb) const { return std::binary_search(carried.begin(), carried.end(), limb); }

  // The angle of `closer` for angles of the finger's joints.
  double closed(const std::vector<double>& angles) const {
    const Link& link = tree_->links[own_joints_[0]];
    return (angles[own_joints_[0]] - link.shift) / link.ratio;
  }

  // Find up to `most` places that the finger reaches with its links clear of the object.
  void find(const Obstacle& object, const Demand& demand, const std::vector<Ray>& rays,
            const Margins& margins, std::size_t most, std::vector<Place>& places, Misses& misses) {
    places.clear();
    // one joint meets the object in few ways, two along lines
    const std::size_t tries = free || own_joints_.size() > 2 ? rays.size()
                              : own_joints_.size() == 2      ? 40
                                                             : 4;
    for (std::size_t r = 0; r < std::min(rays.size(), tries); ++r) {
      const Ray& ray = rays[r];
      if (places.size() == most) return;
      Nearest nearest;
      Place place;
      if (free) {
        const Mesh* mesh = object.surface.mesh();
        if (!(mesh ? touch_mesh(*mesh, ray, nearest)
                   : walk_to_surface(object.surface, ray, nearest)))
          continue;
        if (!is_flat(object.surface, nearest, margins.flat)) {
          ++misses.edge;
          continue;
        }
        if (!solve_reach(nearest, margins.joints, misses)) continue;
      } else if (!close_joint(object.surface, demand, ray.draws, r % 2 == 0 ? AROUND : 1.0, margins,
                              nearest, place.start, misses)) {
        continue;
      }
      if (!pieces_agree(object, nearest, margins.pieces)) {
        ++misses.edge;
        continue;
      }
      if (!keeps_clear(object, margins.clearance, place.limbs)) {
        ++misses.touching;
        continue;
      }
      place.point = nearest.point;
      place.normal = nearest.inward;
      place.angles = angles_;
      write_efforts(demand, place.efforts);
      places.push_back(std::move(place));
    }
  }

  // Find the joint angles with the tip `away` from a place [m]. Return false if the tip cannot be
  // there, or the object is on that side as well.
  bool stand_off(const Surface& surface, const Place& place, double away,
                 std::vector<double>& angles) {
    if (!free) {
      angles = place.start;
      return true;
    }
    const double radius = tree_->tips[0].radius;
    const Point tip = place.point - (radius + away) * place.normal;
    angles = place.angles;
    if (surface.mesh() && surface.nearest(tip).distance < radius + 0.5 * away) return false;
    double missed;
    for (const std::vector<double>* from : {&std::as_const(home_), &place.angles}) {
      reach_.solve(&tip, from->data(), 1, angles_.data(), &missed);
      angles = angles_;
      if (missed <= REACHED) return true;
    }
    return false;
  }

 private:
  static constexpr double AROUND = 0.15;  // fraction of the joints' ranges, around the rest posture
  std::vector<int> own_joints_;           // in the finger, with a motor of its own or `closer`
  std::shared_ptr<const Tree> tree_;
  Reach reach_;
  Posture posture_;
  std::vector<double> home_, angles_;
  Point direction_;  // from the object to the finger

  std::shared_ptr<const Tree> make_tree(const Tree& hand, int number, const double* home,
                                        const std::vector<int>& fingers_per_motor) {
    auto out = std::make_shared<Tree>(hand.chain(number, joints));
    const auto motor = [&](int k) { return hand.mover(joints[k]); };
    const auto alone = [&](int k) {
      return !hand.links[joints[k]].coupled() && fingers_per_motor[motor(k)] == 1;
    };
    const int count = int(joints.size());
    for (int k = 0; k < count; ++k)
      if (alone(k)) own_joints_.push_back(k);
    if (own_joints_.empty()) closer = motor(count - 1);
    for (int k = 0; k < count; ++k) {
      Link& link = out->links[k];
      if (link.coupled() || alone(k)) continue;
      if (motor(k) == closer) {
        own_joints_.push_back(k);
        link.torque_limit /= fingers_per_motor[closer];
      } else
        link.lower = link.upper = home[joints[k]];
    }
    for (Link& link : out->links)
      if (link.coupled() && out->links[link.driver].lower == out->links[link.driver].upper)
        link.lower = link.upper = link.ratio * out->links[link.driver].lower + link.shift;
    return out;
  }

  double low(int joint) const { return std::max(tree_->links[joint].lower, -PI); }
  double high(int joint) const { return std::min(tree_->links[joint].upper, PI); }
  void trace() {
    tree_->couple(angles_.data());
    posture_.trace(angles_.data());
  }

  // True if the tip can move in all directions in one of several postures.
  bool is_spatial() {
    // determinant of J J^T over the cube of its mean eigenvalue
    constexpr double LEAST = 1e-4;
    const int count = int(joints.size());
    std::vector<double> jacobian(3 * count);
    double best = 0.0;
    for (double part : {-1.0, 0.35, 0.5, 0.65}) {
      for (int j : own_joints_)
        angles_[j] = part < 0.0 ? home_[j] : low(j) + part * (high(j) - low(j));
      trace();
      posture_.jacobian(count - 1, posture_.tip(0), jacobian.data());
      Point rows[3] = {{0, 0, 0}, {0, 0, 0}, {0, 0, 0}};
      for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
          for (int j : own_joints_) rows[r][c] += jacobian[count * r + j] * jacobian[count * c + j];
      const double mean = (rows[0][0] + rows[1][1] + rows[2][2]) / 3.0;
      if (mean > 0.0)
        best = std::max(best, dot(rows[0], cross(rows[1], rows[2])) / (mean * mean * mean));
    }
    angles_ = home_;
    return best > LEAST;
  }

  // Walk from inside along a ray to the surface. Return false if the start is not inside.
  bool walk_to_surface(const Surface& surface, const Ray& ray, Nearest& place) const {
    constexpr int STEPS = 8;  // the exact direction does not matter
    const Point way = direction_ + ray.aside;
    const double size = length(way);
    Point center = ray.start;
    place = surface.nearest(center);
    if (place.distance >= 0.0 || size < 0.1) return false;
    for (int step = 0; step < STEPS; ++step) {
      center -= (place.distance / size) * way;
      place = surface.nearest(center);
      if (place.distance > -1e-4) break;
    }
    return true;
  }

  // Find where the tip touches a mesh near a drawn point that faces the finger. Return false if it
  // fits nowhere.
  bool touch_mesh(const Mesh& mesh, const Ray& ray, Nearest& place) const {
    constexpr double FACING = 0.1, FITS = 1e-6;  // smallest cosine; [m] of the tip in the object
    constexpr int STEPS = 6;
    const auto [from, outward] = mesh.sample(ray.draws[0], ray.draws[1], ray.draws[2]);
    const Point way = direction_ + ray.aside;
    if (!(dot(outward, way) > FACING * length(way))) return false;
    const double radius = tree_->tips[0].radius;
    place = {from, -outward, 0.0};
    for (int step = 0; step < STEPS; ++step) {
      place = mesh.nearest(place.point - radius * place.inward);
      if (place.distance > radius - FITS) return true;
    }
    return false;
  }

  // True if the convex pieces of a mesh are as near to the tip as the mesh, and face it alike.
  bool pieces_agree(const Obstacle& object, const Nearest& place, double most) const {
    constexpr double ASIDE = 3e-3;  // [m] over which their slope may deviate by `most`
    if (!object.surface.mesh() || object.solids.size() == 1) return true;
    const double radius = tree_->tips[0].radius;
    const auto above = [&](const Point& aside) {
      const Point center = place.point - radius * place.inward + aside;
      return gap(object, Placed(Solid::of(Segment{center, center}, radius)), ASIDE + most);
    };
    const auto [side, other] = tangents(place.inward);
    return std::abs(above({0.0, 0.0, 0.0})) < most &&
           std::abs(above(ASIDE * side) - above(-ASIDE * side)) < 2.0 * most &&
           std::abs(above(ASIDE * other) - above(-ASIDE * other)) < 2.0 * most;
  }

  // Two unit vectors orthogonal to a unit normal.
  static std::pair<Point, Point> tangents(const Point& n) {
    int least = 0;
    for (int k = 1; k < 3; ++k)
      if (std::abs(n[k]) < std::abs(n[least])) least = k;
    Point side = -n[least] * n;
    side[least] += 1.0;
    side = side / length(side);
    return {side, cross(n, side)};
  }

  // True if the normal turns by less than 20 degrees up to `size` away. On rough meshes, it is that
  // of a ball of this size.
  static bool is_flat(const Surface& surface, const Nearest& place, double size) {
    const double above = (surface.mesh() ? 1.0 : 0.1) * size;
    const Point& n = place.inward;
    const auto [side, other] = tangents(n);
    for (const Point& step : {size * side, size * other, -size * side, -size * other})
      if (dot(surface.nearest(place.point + step - above * n).inward, n) < 0.94) return false;
    return true;
  }

  static bool miss(int& count) {
    ++count;
    return false;
  }
  bool solve_reach(const Nearest& place, double margin, Misses& misses) {
    const Point tip = place.point - tree_->tips[0].radius * place.inward;
    double missed;
    reach_.solve(&tip, home_.data(), 1, angles_.data(), &missed);
    if (missed > REACHED) return miss(misses.far);
    for (int j : own_joints_)
      if (angles_[j] < tree_->links[j].lower + margin ||
          angles_[j] > tree_->links[j].upper - margin)
        return miss(misses.limit);
    return true;
  }

  // Close one joint from a drawn posture until the tip touches, in `angles_`; `start` has the tip
  // clear. spread: range of the drawn postures around the rest posture, as a fraction of the
  // joints' ranges.
  bool close_joint(const Surface& surface, const Demand& demand, const Vec6& draws, double spread,
                   const Margins& margins, Nearest& place, std::vector<double>& start,
                   Misses& misses) {
    constexpr int STEPS = 24, HALVES = 40;
    constexpr double PUSH = 0.4;  // of the tip's largest motion: smallest part along the normal
    if (own_joints_.empty()) return miss(misses.far);
    const int count = int(own_joints_.size());
    for (int k = 0; k < count; ++k) {
      const double from = low(own_joints_[k]) + margins.joints;
      const double to = high(own_joints_[k]) - margins.joints;
      const double middle = std::min(std::max(home_[own_joints_[k]], from), to);
      const double least = std::max(from, middle - spread * (to - from));
      const double most = std::min(to, middle + spread * (to - from));
      angles_[own_joints_[k]] = least + draws[k % 5] * (most - least);
    }
    const int joint = own_joints_[std::min(int(draws[5] * count), count - 1)];
    const double radius = tree_->tips[0].radius;
    const double first = low(joint);
    const double size = high(joint) - first;
    const auto distance = [&](double part) {
      angles_[joint] = first + part * size;
      trace();
      place = surface.nearest(posture_.tip(0));
      return place.distance - radius;
    };
    // bisect between a part of the range where the tip is more than `away` off, and one where it is
    // closer
    const auto between = [&](double off, double on, double away) {
      for (int k = 0; k < HALVES; ++k)
        (distance(0.5 * (off + on)) > away ? off : on) = 0.5 * (off + on);
      return off;
    };
    std::array<double, STEPS + 1> away;
    for (int k = 0; k <= STEPS; ++k) away[k] = distance(double(k) / STEPS);
    // k > 0: the tip meets the object on the way up to step k; k < 0: down to step -k - 1
    std::array<int, 2 * STEPS> meets;
    int ways = 0;
    for (int k = 1; k <= STEPS; ++k) {
      if (away[k - 1] > 0.0 && away[k] <= 0.0) meets[ways++] = k;
      if (away[k] > 0.0 && away[k - 1] <= 0.0) meets[ways++] = -k;
    }
    if (ways == 0) return miss(misses.far);
    const int meet = meets[std::min(int(draws[(count - 1) % 5] * ways), ways - 1)];
    const int back = meet > 0 ? -1 : 1;
    const int inside = meet > 0 ? meet : -meet - 1;
    const double touching = between(double(inside + back) / STEPS, double(inside) / STEPS, 0.0);
    int clear = inside + back;
    while (clear >= 0 && clear <= STEPS && away[clear] < demand.start) clear += back;
    if (clear < 0 || clear > STEPS) return miss(misses.start);
    if (demand.start > 0.0) {
      const double near = clear == inside + back ? touching : double(clear - back) / STEPS;
      distance(between(double(clear) / STEPS, near, demand.start));
    } else {
      distance(touching);
    }
    start = angles_;
    distance(touching);
    if (!is_flat(surface, place, margins.flat)) return miss(misses.edge);
    const double at = angles_[joint];
    const double margin = std::min(margins.joints, 0.1 * size);
    if (at < first + margin || at > first + size - margin) return miss(misses.limit);
    std::vector<Point> moves(joints.size(), Point{0.0, 0.0, 0.0});
    posture_.each_moving_joint(int(joints.size()) - 1, posture_.tip(0),
                               [&](int j, const Point& along) { moves[j] += along; });
    double push = 0.0, most = 0.0;
    for (int j : own_joints_) {
      push = std::max(push, std::abs(dot(moves[j], place.inward)));
      most = std::max(most, length(moves[j]));
    }
    return push < PUSH * most ? miss(misses.weak) : true;
  }

  // True if the limbs are `margin` away from the object at `angles_`; writes their positions.
  bool keeps_clear(const Obstacle& object, double margin, std::vector<Placed>& there) {
    posture_.trace(angles_.data());
    for (const Limb& limb : limbs) {
      there.push_back(limb.at(posture_));
      if (limb.is_sphere_of_tip()) continue;
      if (is_closer(object, there.back(), limb.tip ? std::min(margin, TIP_CLEARANCE) : margin))
        return false;
    }
    return true;
  }

  // Write the fractions of the torques, after the links' weight, that forces on the tip use, for
  // joints that may reach their limit.
  void write_efforts(const Demand& demand, std::vector<Point>& efforts) const {
    constexpr double LEAST = 0.05;  // fraction of its limit that a torque keeps at least
    const int count = int(joints.size());
    std::vector<double> weight(count);
    std::vector<Point> moves(count, Point{0.0, 0.0, 0.0});
    posture_.support(demand.gravity, weight.data());
    posture_.each_moving_joint(count - 1, posture_.tip(0),
                               [&](int j, const Point& along) { moves[j] += along; });
    // ratio of a force to its normal component
    const double largest = std::sqrt(1.0 + demand.friction * demand.friction);
    for (int j = 0; j < count; ++j) {
      const double limit = tree_->links[j].torque_limit;
      const Point effort =
          (FORCE_AT_LIMIT / std::max(limit - std::abs(weight[j]), LEAST * limit)) * moves[j];
      if (length(effort) * largest > 1.0) efforts.push_back(effort);
    }
  }
};

}  // namespace grasp
