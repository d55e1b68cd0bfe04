// Closed triangle meshes: the nearest point of the surface, and the side of it on which a point
// lies.
//
// A tree of boxes finds the face (about 1 us for 16,000 of them). The side follows from the normal
// there; on edges and corners, from the sum of the faces' normals, weighted by their angles on
// corners (Baerentzen and Aanaes 2005).
#pragma once
#include <algorithm>
#include <array>
#include <memory>
#include <numeric>
#include <stdexcept>
#include <vector>
#include <grasp/contacts/geometry.hpp>

namespace grasp {

// If several points are equally near, one of them. On edges the normal is the direction to the
// point.
struct Nearest {
  Point point, inward;  // [m], unit normal
  double distance;      // [m], negative inside
};

// A convex piece of a solid: corners [m] relative to a point inside.
struct Piece {
  Point center;
  std::shared_ptr<const std::vector<Point>> corners;
};

class Mesh {
 public:
  using Corners = std::array<int, 3>;
  std::vector<Piece> pieces;  // their union is the solid

  // faces: corners, counterclockwise from outside. Throws std::invalid_argument.
  Mesh(std::vector<Point> corners, std::vector<Corners> faces, std::vector<Piece> parts)
      : pieces(std::move(parts)), corners_(std::move(corners)), faces_(std::move(faces)) {
    if (faces_.empty() || pieces.empty())
      throw std::invalid_argument("a mesh needs faces and pieces");
    for (const Corners& face : faces_)
      for (int k : face)
        if (k < 0 || k >= int(corners_.size()))
          throw std::invalid_argument("a corner of a face does not exist");
    compute_faces();
    compute_edge_normals();
    compute_corner_normals();
    std::vector<int> order(faces_.size());
    std::iota(order.begin(), order.end(), 0);
    triangles_.reserve(order.size());
    root_ = build(order.data(), int(order.size()));
  }

  Nearest nearest(const Point& center) const {
    constexpr double SHARP = 1e-9;  // [m]; closer to an edge, rounding decides the direction
    const Hit hit = find(center);
    const Point way = hit.point - center;
    const double distance = length(way);
    const Point& out = hit.feature == INNER ? normals_[hit.face]
                       : hit.feature < 3    ? corner_normals_[faces_[hit.face][hit.feature]]
                                            : edge_normals_[3 * hit.face + hit.feature - 3];
    const double side = dot(way, out) > 0.0 ? -1.0 : 1.0;
    if (hit.feature != INNER && distance > SHARP)
      return {hit.point, (side / distance) * way, side * distance};
    return {hit.point, -out, side * distance};
  }

  // A point of the surface, uniform by area, and its outward normal, from numbers in [0, 1).
  std::pair<Point, Point> sample(double which, double u, double v) const {
    const auto at = std::upper_bound(areas_.begin(), areas_.end(), which * areas_.back());
    const int face = int(std::min<std::ptrdiff_t>(at - areas_.begin(), faces_.size() - 1));
    if (u + v > 1.0) {
      u = 1.0 - u;
      v = 1.0 - v;
    }
    const auto [a, b, c] = points(face);
    return {a + u * (b - a) + v * (c - a), normals_[face]};
  }

 private:
  // features: corners of a face, edges from each to the next, interior
  static constexpr int INNER = 6;
  static constexpr int LEAF = 4;  // triangles

  struct Triangle {
    Point corner, b, c;  // [m]; edges to the other two corners
    Point to_b, to_c;    // gradients of a point's coordinates along b and c
    // inverse squared lengths of the edges
    std::array<double, 3> shorter;
    int face;
  };
  struct Box {
    Point low{infinity, infinity, infinity}, high{-infinity, -infinity, -infinity};

    double square(const Point& center) const {
      double out = 0.0;
      for (int k = 0; k < 3; ++k) {
        const double away = std::max(std::max(low[k] - center[k], center[k] - high[k]), 0.0);
        out += away * away;
      }
      return out;
    }
    void include(const Point& p) {
      for (int k = 0; k < 3; ++k) {
        low[k] = std::min(low[k], p[k]);
        high[k] = std::max(high[k], p[k]);
      }
    }
  };
  struct Branch {
    Box box;
    int first = 0, count = 0;  // of its triangles; if it has none, index of its node
  };
  using Node = std::array<Branch, 2>;
  struct Hit {
    Point point;
    double square = infinity;
    int face = 0, feature = INNER;
  };

  std::vector<Point> corners_;
  std::vector<Corners> faces_;
  std::vector<Point> normals_;  // (F,) outward unit normals; 0 for faces without area
  std::vector<double> areas_;   // (F,) cumulative double areas of the faces
  // (F, 3) normals on the edges from each corner to the next; (V,) on corners
  std::vector<Point> edge_normals_, corner_normals_;
  std::vector<Triangle> triangles_;  // in the order of the leaves
  std::vector<Node> nodes_;
  Branch root_;

  std::array<Point, 3> points(int face) const {
    const Corners& at = faces_[face];
    return {corners_[at[0]], corners_[at[1]], corners_[at[2]]};
  }

  // --- the nearest point

  Hit find(const Point& center) const {
    struct Open {
      const Branch* branch;
      double square;
    };
    std::array<Open, 64> open;
    int count = 0;
    open[count++] = {&root_, 0.0};
    Hit best;
    while (count > 0) {
      const Open next = open[--count];
      if (next.square >= best.square) continue;
      if (next.branch->count > 0) {
        for (int k = 0; k < next.branch->count; ++k)
          test_triangle(triangles_[next.branch->first + k], center, best);
        continue;
      }
      const Node& node = nodes_[next.branch->first];
      const Open one{&node[0], node[0].box.square(center)};
      const Open other{&node[1], node[1].box.square(center)};
      const bool first = one.square <= other.square;
      open[count++] = first ? other : one;
      open[count++] = first ? one : other;
    }
    return best;
  }

  static void test_triangle(const Triangle& t, const Point& center, Hit& best) {
    const Point arm = center - t.corner;
    const double v = dot(arm, t.to_b);
    const double w = dot(arm, t.to_c);
    const double u = 1.0 - v - w;
    const auto take = [&](const Point& from_corner, int feature) {
      const Point away = from_corner - arm;
      if (const double square = dot(away, away); square < best.square)
        best = {t.corner + from_corner, square, t.face, feature};
    };
    if (u >= 0.0 && v >= 0.0 && w >= 0.0) return take(v * t.b + w * t.c, INNER);
    // on an edge that the point is beyond; on any for a face without area
    const auto edge = [&](const Point& from, const Point& way, int k) {
      const double part = dot(arm - from, way) * t.shorter[k];
      if (part <= 0.0)
        take(from, k);
      else if (part >= 1.0)
        take(from + way, (k + 1) % 3);
      else
        take(from + part * way, 3 + k);
    };
    if (!(w >= 0.0)) edge({0.0, 0.0, 0.0}, t.b, 0);
    if (!(u >= 0.0)) edge(t.b, t.c - t.b, 1);
    if (!(v >= 0.0)) edge(t.c, -t.c, 2);
  }

  // --- set up

  void compute_faces() {
    double total = 0.0;
    for (int f = 0; f < int(faces_.size()); ++f) {
      const auto [a, b, c] = points(f);
      const Point across = cross(b - a, c - a);
      const double area = length(across);
      normals_.push_back(is_degenerate(f, area) ? Point{0.0, 0.0, 0.0} : across / area);
      areas_.push_back(total += area);
    }
    if (!(total > 0.0)) throw std::invalid_argument("the faces of a mesh must have area");
  }
  // True if a face with this double area is degenerate.
  bool is_degenerate(int face, double area) const {
    constexpr double THIN = 1e-10;  // of the square of its longest edge
    const int k = longest(face);
    const auto p = points(face);
    const Point way = p[(k + 1) % 3] - p[k];
    return area <= THIN * dot(way, way);
  }
  bool is_degenerate(int face) const { return dot(normals_[face], normals_[face]) == 0.0; }
  int longest(int face) const {
    const auto p = points(face);
    int best = 0;
    double most = -1.0;
    for (int k = 0; k < 3; ++k) {
      const Point way = p[(k + 1) % 3] - p[k];
      if (const double size = dot(way, way); size > most) {
        most = size;
        best = k;
      }
    }
    return best;
  }

  // Sides of faces, sorted by edge: the sides of one edge are adjacent.
  struct Side {
    int low, high, face, edge;
    bool same(const Side& other) const { return low == other.low && high == other.high; }
  };
  std::vector<Side> sides_;  // used while the normals are computed
  // (F, 3) first side of the edge, and first side of the next edge
  std::vector<std::pair<int, int>> group_;

  void compute_edge_normals() {
    for (int f = 0; f < int(faces_.size()); ++f)
      for (int k = 0; k < 3; ++k) {
        const int i = faces_[f][k];
        const int j = faces_[f][(k + 1) % 3];
        sides_.push_back({std::min(i, j), std::max(i, j), f, k});
      }
    std::sort(sides_.begin(), sides_.end(), [](const Side& a, const Side& b) {
      return std::array{a.low, a.high, a.face, a.edge} < std::array{b.low, b.high, b.face, b.edge};
    });
    group_.resize(sides_.size());
    for (int first = 0, last = 0; first < int(sides_.size()); first = last) {
      while (last < int(sides_.size()) && sides_[last].same(sides_[first])) ++last;
      for (int s = first; s < last; ++s)
        group_[3 * sides_[s].face + sides_[s].edge] = {first, last};
    }
    edge_normals_.resize(sides_.size());
    for (const Side& side : sides_) {
      Point sum{0.0, 0.0, 0.0};
      const auto [first, last] = group_[3 * side.face + side.edge];
      for (int s = first; s < last; ++s)
        sum += normal_seen_from(sides_[s].face, sides_[s].edge, MAX_FOLDS);
      edge_normals_[3 * side.face + side.edge] = normal_or_default(sum, side.face);
    }
  }
  static constexpr int MAX_FOLDS = 6;  // largest number of adjacent faces without area

  // The normal of a face as seen from one of its edges. A face without area is a fold: from its
  // longest edge one sees the normals across the others, and vice versa, if an edge has two faces.
  Point normal_seen_from(int face, int edge, int deep) const {
    if (!is_degenerate(face) || deep == 0) return normals_[face];
    Point sum{0.0, 0.0, 0.0};
    const int through = longest(face);
    for (int k = 0; k < 3; ++k) {
      if ((k == through) == (edge == through)) continue;
      const auto [first, last] = group_[3 * face + k];
      for (int s = first; s < last && last - first == 2; ++s)
        if (sides_[s].face != face)
          sum += normal_seen_from(sides_[s].face, sides_[s].edge, deep - 1);
    }
    const double size = length(sum);
    return size > 0.0 ? sum / size : sum;
  }
  void compute_corner_normals() {
    corner_normals_.assign(corners_.size(), Point{0.0, 0.0, 0.0});
    std::vector<int> faces(corners_.size(), 0);
    for (int f = 0; f < int(faces_.size()); ++f) {
      const auto p = points(f);
      const Point normal = normal_seen_from(f, (longest(f) + 1) % 3, MAX_FOLDS);
      for (int k = 0; k < 3; ++k) {
        const Point one = p[(k + 1) % 3] - p[k];
        const Point other = p[(k + 2) % 3] - p[k];
        corner_normals_[faces_[f][k]] +=
            std::atan2(length(cross(one, other)), dot(one, other)) * normal;
        if (!is_degenerate(f)) faces[faces_[f][k]] = f;
      }
    }
    for (std::size_t v = 0; v < corner_normals_.size(); ++v)
      corner_normals_[v] = normal_or_default(corner_normals_[v], faces[v]);
    sides_ = {};
    group_ = {};
  }
  Point normal_or_default(const Point& sum, int face) const {
    const double size = length(sum);
    if (size > 1e-9) return sum / size;
    return is_degenerate(face) ? Point{1.0, 0.0, 0.0} : normals_[face];  // faces back to back
  }

  Triangle triangle(int face) const {
    const auto [a, second, third] = points(face);
    const Point b = second - a;
    const Point c = third - a;
    const Point across = cross(b, c);
    Triangle out{a, b, c, {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, {}, face};
    const double area = dot(across, across);
    const double none = std::numeric_limits<double>::quiet_NaN();
    out.to_b = is_degenerate(face) ? Point{none, none, none} : cross(c, across) / area;
    out.to_c = is_degenerate(face) ? Point{none, none, none} : cross(across, b) / area;
    const Point ways[] = {b, c - b, c};
    for (int k = 0; k < 3; ++k) {
      const double square = dot(ways[k], ways[k]);
      out.shorter[k] = square > 0.0 ? 1.0 / square : 0.0;
    }
    return out;
  }

  // Halve the faces by their centres along the axis of largest spread.
  Branch build(int* order, int count) {
    Branch out;
    Box middles;
    const auto middle = [&](int face, int axis) {
      const Corners& at = faces_[face];
      return corners_[at[0]][axis] + corners_[at[1]][axis] + corners_[at[2]][axis];
    };
    for (int k = 0; k < count; ++k) {
      for (const Point& p : points(order[k])) out.box.include(p);
      middles.include({middle(order[k], 0), middle(order[k], 1), middle(order[k], 2)});
    }
    if (count <= LEAF) {
      out.first = int(triangles_.size());
      out.count = count;
      for (int k = 0; k < count; ++k) triangles_.push_back(triangle(order[k]));
      return out;
    }
    const Point spread = middles.high - middles.low;
    const int axis = int(std::max_element(&spread.u, &spread.u + 3) - &spread.u);
    std::nth_element(order, order + count / 2, order + count, [&](int one, int other) {
      const double a = middle(one, axis);
      const double b = middle(other, axis);
      return a < b || (a == b && one < other);
    });
    out.first = int(nodes_.size());
    nodes_.emplace_back();
    const Branch low = build(order, count / 2);
    const Branch high = build(order + count / 2, count - count / 2);
    nodes_[out.first] = {low, high};
    return out;
  }
};

}  // namespace grasp
