// Surfaces of objects and their point nearest to another, such as the centre of a spherical tip.
// Body frame; the axis of cylinders and capsules is y.
#pragma once
#include <variant>
#include <grasp/hand/mesh.hpp>

namespace grasp {

struct Cuboid {
  Point half;  // half the side lengths [m]

  Nearest nearest(const Point& center) const {
    constexpr double LOST = 1e-280;  // a smaller squared length has lost its digits
    Point point;
    Point normal{0.0, 0.0, 0.0};
    double depth = -infinity;
    int axis = 0;
    for (int k = 0; k < 3; ++k) {
      const double beyond = std::abs(center[k]) - half[k];
      if (beyond > depth) {
        depth = beyond;
        axis = k;
      }
      point[k] = std::min(std::max(center[k], -half[k]), half[k]);
    }
    const Point way = point - center;
    const double distance = length(way);
    if (distance * distance > LOST) return {point, way / distance, distance};
    const double side = std::copysign(1.0, center[axis]);
    point[axis] = side * half[axis];
    normal[axis] = -side;
    return {point, normal, depth};
  }
};

struct Cylinder {
  double radius, half;  // [m], half its height

  Nearest nearest(const Point& center) const {
    const Point across{center[0], 0.0, center[2]};
    const double away = length(across);
    const double height = std::abs(center[1]);
    const double side = std::copysign(1.0, center[1]);
    const double beyond = away - radius;
    const double above = height - half;
    const Point from_axis = away > 0.0 ? across / away : Point{1.0, 0.0, 0.0};
    const Point along{0.0, side, 0.0};
    const auto at = [&](double r, double h) { return r * from_axis + h * along; };
    if (beyond > 0.0 || above > 0.0) {
      const double out = std::max(beyond, 0.0);
      const double up = std::max(above, 0.0);
      const double distance = std::sqrt(out * out + up * up);
      const Point point = at(std::min(away, radius), std::min(height, half));
      if (distance > 0.0) return {point, at(-out / distance, -up / distance), distance};
      return {point, beyond > above ? -from_axis : -along, 0.0};
    }
    if (beyond >= above) return {at(radius, height), -from_axis, beyond};
    return {at(away, half), -along, above};
  }
};

// Also a ball, with an axis of length zero.
struct Capsule {
  double radius, half;  // [m], half the length of its axis

  Nearest nearest(const Point& center) const {
    const Point axis{0.0, std::min(std::max(center[1], -half), half), 0.0};
    const Point arm = center - axis;
    const double away = length(arm);
    const Point outward = away > 0.0 ? arm / away : Point{1.0, 0.0, 0.0};
    return {axis + radius * outward, -outward, away - radius};
  }
};

// A mesh, shared by copies of a surface.
struct Faces {
  std::shared_ptr<const Mesh> mesh;

  Nearest nearest(const Point& center) const { return mesh->nearest(center); }
};

struct Surface {
  std::variant<Cuboid, Cylinder, Capsule, Faces> shape;

  // The centre must be finite.
  Nearest nearest(const Point& center) const {
    return std::visit([&](const auto& kind) { return kind.nearest(center); }, shape);
  }
  // The mesh; null for the simple shapes.
  const Mesh* mesh() const {
    const Faces* faces = std::get_if<Faces>(&shape);
    return faces ? faces->mesh.get() : nullptr;
  }
};

}  // namespace grasp
