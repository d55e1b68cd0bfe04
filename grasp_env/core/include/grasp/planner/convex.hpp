// Convex solids: distance and overlap of two of them.
//
// A solid is all points within a radius of its core: a box (also a line or a point), a cylinder or
// the hull of corners. The distance of two cores is that of the origin from their difference {a -
// b}: Gilbert, Johnson and Keerthi's descent over simplices if they are apart, an expanding
// polytope if they overlap.
#pragma once
#include <array>
#include <memory>
#include <grasp/hand/rotation.hpp>
#include <grasp/hand/surface.hpp>

namespace grasp {

struct Segment {
  Point start, end;  // [m]

  Point at(double part) const { return start + part * (end - start); }
};

struct Solid {
  enum class Core { box, cylinder, hull };
  using Corners = std::shared_ptr<const std::vector<Point>>;  // relative to a point inside

  Core core = Core::box;
  // [m] half the core's sides; for a cylinder about z: radius, radius, half its height
  Point half{};
  double radius = 0.0;          // [m] around the core
  Point center{0.0, 0.0, 0.0};  // of the core [m]
  Rotation frame;               // rotation of the core relative to the solid's frame
  Corners corners;              // of a hull [m], relative to its centre, which is inside
  double size = 0.0;            // [m] largest distance of a core's point from its centre
  Segment axis;                 // [m] if the core is a line

  // half: see above; a line along z if the first two are 0.
  static Solid of(Core core, const Point& half, double radius, const Point& center,
                  const Rotation& frame) {
    Solid out{core, half, radius, center, frame, nullptr, 0.0, {}};
    out.size = core == Core::box ? length(half) : std::hypot(half[0], half[2]);
    out.axis = {center - half[2] * frame.column(2), center + half[2] * frame.column(2)};
    return out;
  }
  static Solid hull(Corners corners, const Point& center, const Rotation& frame) {
    Solid out{Core::hull, {}, 0.0, center, frame, std::move(corners), 0.0, {}};
    for (const Point& corner : *out.corners) out.size = std::max(out.size, length(corner));
    return out;
  }
  static Solid of(const Segment& axis, double radius) {
    Solid out{Core::box, {0.0, 0.0, 0.5 * length(axis.end - axis.start)},
              radius,    axis.at(0.5),
              {},        nullptr,
              0.0,       axis};
    out.size = out.half[2];
    return out;
  }
  // Convex solids whose union is an object, which has its axis along y instead of z.
  static std::vector<Solid> of(const Surface& surface) {
    static constexpr double FROM_Z[9] = {1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0};
    const Point middle{0.0, 0.0, 0.0};
    if (const auto* box = std::get_if<Cuboid>(&surface.shape))
      return {of(Core::box, box->half, 0.0, middle, {})};
    if (const auto* can = std::get_if<Cylinder>(&surface.shape))
      return {of(Core::cylinder, {can->radius, can->radius, can->half}, 0.0, middle,
                 Rotation::from(FROM_Z))};
    if (const auto* rod = std::get_if<Capsule>(&surface.shape))
      return {of({{0.0, -rod->half, 0.0}, {0.0, rod->half, 0.0}}, rod->radius)};
    std::vector<Solid> out;
    for (const Piece& piece : surface.mesh()->pieces)
      out.push_back(hull(piece.corners, piece.center, {}));
    return out;
  }

  // Rotated about the origin, then shifted [m].
  Solid moved(const Rotation& turn, const Point& shift) const {
    Solid out = *this;
    out.center = shift + turn * center;
    out.frame = turn * frame;
    out.axis = {shift + turn * axis.start, shift + turn * axis.end};
    return out;
  }

  bool is_line() const { return core == Core::box && half[0] == 0.0 && half[1] == 0.0; }
};

struct Placed {
  const Solid* solid;
  Segment axis;    // if it is a line [m]
  Point center;    // of the core [m]
  Rotation frame;  // of the core; unused for a line

  // origin [m] and rotation of the frame that the solid is fixed to
  Placed(const Solid& solid, const Point& origin, const Rotation& from) : solid(&solid) {
    if (solid.is_line()) {
      axis = {origin + from * solid.axis.start, origin + from * solid.axis.end};
      center = axis.at(0.5);
    } else {
      center = origin + from * solid.center;
      frame = from * solid.frame;
    }
  }
  explicit Placed(const Solid& solid)
      : solid(&solid), axis(solid.axis), center(solid.center), frame(solid.frame) {}

  // The point of the core furthest along a direction.
  Point support(const Point& along) const {
    if (solid->is_line()) return dot(along, axis.end - axis.start) > 0.0 ? axis.end : axis.start;
    const Point way = frame.transposed(along);
    const Point& half = solid->half;
    if (solid->core == Solid::Core::hull) {
      const Point* best = solid->corners->data();
      double most = -infinity;
      for (const Point& corner : *solid->corners)
        if (const double reach = dot(corner, way); reach > most) {
          most = reach;
          best = &corner;
        }
      return center + frame * *best;
    }
    Point at{std::copysign(half[0], way[0]), std::copysign(half[1], way[1]),
             std::copysign(half[2], way[2])};
    if (solid->core == Solid::Core::cylinder) {
      const double across = std::hypot(way[0], way[1]);
      at[0] = across > 0.0 ? half[0] * way[0] / across : half[0];
      at[1] = across > 0.0 ? half[0] * way[1] / across : 0.0;
    }
    return center + frame * at;
  }
};

// Distance of two segments [m] (Ericson 2005, 5.1.9).
inline double gap(const Segment& a, const Segment& b) {
  constexpr double PARALLEL = 1e-12;  // of the squared sine between them
  const auto within = [](double part) { return std::min(std::max(part, 0.0), 1.0); };
  const Point u = a.end - a.start;
  const Point v = b.end - b.start;
  const Point r = a.start - b.start;
  const double uu = dot(u, u);
  const double vv = dot(v, v);
  const double uv = dot(u, v);
  const double ur = dot(u, r);
  const double vr = dot(v, r);
  double s = 0.0, t = 0.0;
  if (uu > 0.0) {
    if (const double across = uu * vv - uv * uv; across > PARALLEL * uu * vv)
      s = within((uv * vr - ur * vv) / across);
    t = vv > 0.0 ? (uv * s + vr) / vv : -1.0;
    if (t < 0.0 || t > 1.0) {
      t = within(t);
      s = within((t * uv - ur) / uu);
    }
  } else if (vv > 0.0) {
    t = within(vr / vv);
  }
  return length(r + s * u - t * v);
}

// Signed distance of a segment from a simple surface [m], by golden sections; stops once it is
// certainly above `enough`.
inline double gap(const Surface& surface, const Segment& a, double enough = infinity) {
  constexpr double GOLDEN = 0.6180339887498949;
  constexpr int SECTIONS = 14;  // leave a thousandth of the segment
  const auto at = [&](double part) { return surface.nearest(a.at(part)).distance; };
  const double size = length(a.end - a.start);
  double low = 0.0;
  double high = 1.0;
  double left = 1.0 - GOLDEN;
  double right = GOLDEN;
  double at_left = at(left);
  double at_right = at(right);
  // no point of the bracket is further from either of the two than the bracket's length
  for (int k = 1;
       k < SECTIONS && size > 0.0 && !(std::min(at_left, at_right) - (high - low) * size > enough);
       ++k) {
    if (at_left < at_right) {
      high = right;
      right = left;
      at_right = at_left;
      at_left = at(left = high - GOLDEN * (high - low));
    } else {
      low = left;
      left = right;
      at_left = at_right;
      at_right = at(right = low + GOLDEN * (high - low));
    }
  }
  return std::min(at_left, at_right);
}

// Up to four points of the difference of two cores.
struct Simplex {
  std::array<Point, 4> at;
  int count = 0;

  // Find the point of the hull nearest to the origin; keep only the points that span it, the last
  // one among them. Return false if the origin is inside all four.
  bool nearest(Point& best) {
    constexpr double FLAT = 1e-24;  // [m^2, m^4] below which there is no edge, no triangle
    const int last = count - 1;
    double least = infinity;
    std::array<int, 3> kept{};
    int keeps = 0;
    const auto take = [&](const Point& next, int members, std::array<int, 3> these) {
      if (const double square = dot(next, next); square < least) {
        least = square;
        best = next;
        keeps = members;
        kept = these;
      }
    };
    take(at[last], 1, {last});
    for (int i = 0; i < last; ++i) {
      const Point way = at[i] - at[last];
      const double size = dot(way, way);
      const double part = -dot(at[last], way);
      if (part > 0.0 && part < size && size > FLAT)
        take(at[last] + (part / size) * way, 2, {last, i});
    }
    int inward = 0;
    for (int i = 0; i < last; ++i)
      for (int j = i + 1; j < last; ++j) {
        const Point& a = at[last];
        const Point& b = at[i];
        const Point& c = at[j];
        const Point normal = cross(b - a, c - a);
        const double area = dot(normal, normal);
        if (!(area > FLAT * FLAT)) continue;
        const double height = dot(normal, a);
        if (count == 4 && height * dot(normal, at[3 - i - j] - a) < 0.0) ++inward;
        const Point foot = (height / area) * normal;
        if (dot(cross(b - foot, c - foot), normal) >= 0.0 &&
            dot(cross(c - foot, a - foot), normal) >= 0.0 &&
            dot(cross(a - foot, b - foot), normal) >= 0.0)
          take(foot, 3, {last, i, j});
      }
    if (count == 4) {
      const Point normal = cross(at[1] - at[0], at[2] - at[0]);
      const double height = dot(normal, at[0]);
      if (inward == 3 && height * dot(normal, at[3] - at[0]) < 0.0) return false;
    }
    std::array<Point, 4> left;
    for (int k = 0; k < keeps; ++k) left[k] = at[kept[k]];
    at = left;
    count = keeps;
    return true;
  }
};

// Distance of two cores [m], 0 if they overlap; above `enough`, a lower bound.
inline double separation(const Placed& a, const Placed& b, double enough = infinity) {
  constexpr double TOUCHING = 1e-10, EXACT = 1e-9;  // [m]; of the squared distance
  constexpr int STEPS = 64;
  Point away = a.center - b.center;
  Simplex simplex;
  double square = infinity;
  for (int step = 0; step < STEPS; ++step) {
    const Point next = a.support(-away) - b.support(away);
    const double now = dot(away, away);
    const double along = dot(away, next);
    if (now <= TOUCHING * TOUCHING) return 0.0;
    if (along > 0.0 && along * along > enough * enough * now) return along / std::sqrt(now);
    if (step > 0 && (now - along <= EXACT * now || now >= square)) return std::sqrt(now);
    square = step > 0 ? now : infinity;  // the first is no point of a simplex
    simplex.at[simplex.count++] = next;
    if (!simplex.nearest(away)) return 0.0;
  }
  return length(away);
}

// Shortest translation that separates two overlapping cores [m], to 1 um; negative: minus their
// distance.
inline double overlap(const Placed& a, const Placed& b) {
  constexpr double EXACT = 1e-6, FLAT = 1e-12;  // [m], [m^2]
  constexpr int MOST = 120;
  struct Side {
    int a, b, c;
    Point normal;   // outward
    double height;  // of the plane above the origin
  };
  const auto support = [&](const Point& along) { return a.support(along) - b.support(-along); };
  double least = infinity;  // height above the origin of a plane that bounds the difference
  const auto bound = [&](const Point& normal) {
    const Point corner = support(normal);
    least = std::min(least, dot(corner, normal));
    return corner;
  };
  std::vector<Point> corners;
  std::vector<Side> sides;
  std::vector<std::pair<int, int>> edges;
  Point across{0.0, 0.0, 0.0};
  for (int k = 0; k < 3; ++k) {  // the two points furthest apart
    Point axis{0.0, 0.0, 0.0};
    axis[k] = 1.0;
    const Point high = bound(axis);
    const Point low = bound(-axis);
    if (corners.empty() || dot(high - low, high - low) > dot(across, across)) {
      across = high - low;
      corners = {low, high};
    }
  }
  const auto furthest = [&](const Point& normal) {  // from the first corner, either way
    const Point high = bound(normal);
    const Point low = bound(-normal);
    return dot(high - corners[0], normal) > dot(corners[0] - low, normal) ? high : low;
  };
  if (!(length(across) > 0.0)) return least;
  const Frame around(normalised(across), nullptr);
  for (const Point& way : {around.o, around.t}) {
    const Point corner = furthest(way);
    const Point area = cross(across, corner - corners[0]);
    if (corners.size() == 2 && length(area) > FLAT) corners.push_back(corner);
  }
  if (corners.size() < 3) return least;
  Point normal = normalised(cross(across, corners[2] - corners[0]));
  corners.push_back(furthest(normal));
  if (dot(corners[3] - corners[0], normal) > 0.0) {
    std::swap(corners[1], corners[2]);
    normal = -normal;
  }
  const auto add = [&](int i, int j, int k) {
    const Point out = cross(corners[j] - corners[i], corners[k] - corners[i]);
    const double area = length(out);
    if (!(area > FLAT * FLAT)) return false;
    sides.push_back({i, j, k, out / area, dot(out, corners[i]) / area});
    return true;
  };
  if (!add(0, 1, 2) || !add(0, 3, 1) || !add(1, 3, 2) || !add(2, 3, 0)) return least;
  for (int step = 0; step < MOST; ++step) {
    const Side nearest =
        *std::min_element(sides.begin(), sides.end(),
                          [](const Side& x, const Side& y) { return x.height < y.height; });
    const Point next = bound(nearest.normal);
    if (least - nearest.height <= EXACT) return least;
    edges.clear();
    for (std::size_t s = 0; s < sides.size();) {
      const Side side = sides[s];
      if (dot(side.normal, next) <= side.height + 1e-12) {
        ++s;
        continue;
      }
      for (const auto& edge :
           {std::pair{side.a, side.b}, std::pair{side.b, side.c}, std::pair{side.c, side.a}}) {
        const auto back = std::find(edges.begin(), edges.end(), std::pair{edge.second, edge.first});
        if (back == edges.end())
          edges.push_back(edge);
        else
          edges.erase(back);
      }
      sides[s] = sides.back();
      sides.pop_back();
    }
    corners.push_back(next);
    for (const auto& [from, to] : edges)
      if (!add(from, to, int(corners.size()) - 1)) return least;
    if (sides.empty()) return least;
  }
  return least;
}

// Distance of two solids [m], negative the depth of their overlap; above `enough`, a lower bound.
inline double gap(const Placed& a, const Placed& b, double enough = infinity) {
  const double around = a.solid->radius + b.solid->radius;
  if (a.solid->is_line() && b.solid->is_line()) return gap(a.axis, b.axis) - around;
  const double far = length(a.center - b.center) - a.solid->size - b.solid->size;
  if (far - around > enough) return far - around;
  const double apart = separation(a, b, enough + around);
  return (apart > 0.0 ? apart : -overlap(a, b)) - around;
}

// True if two solids are closer than `distance` [m].
inline bool is_closer(const Placed& a, const Placed& b, double distance) {
  const double needed = distance + a.solid->radius + b.solid->radius;
  if (length(a.center - b.center) - a.solid->size - b.solid->size > needed) return false;
  return needed > 0.0 ? separation(a, b, needed) < needed : gap(a, b, distance) < distance;
}

}  // namespace grasp
