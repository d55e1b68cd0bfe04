// Surfaces of convex objects: the point nearest to a given one. A spherical fingertip of radius r whose centre is at distance d touches
// where d = r, at the point nearest to the centre. Body frame; the axis of cylinders and capsules is y.
#pragma once
#include <memory>
#include <utility>
#include <variant>
#include <grasp/contacts/geometry.hpp>

namespace grasp {

// Where several points are as near, as at the centre of a ball, it is one of them; on edges the normal is the direction to them.
struct Nearest {
    Point point, inward;  // [m] and unit normal
    double distance;  // [m], below 0 inside
};

struct Cuboid {
    Point half;  // sides [m]

    Nearest nearest(const Point& center) const {
        constexpr double LOST = 1e-280;  // a squared length below it has lost its digits
        Point point, normal{0.0, 0.0, 0.0};
        double depth = -infinity;
        int axis = 0;
        for (int k = 0; k < 3; ++k) {
            const double beyond = std::abs(center[k]) - half[k];
            if (beyond > depth) depth = beyond, axis = k;
            point[k] = std::min(std::max(center[k], -half[k]), half[k]);
        }
        const Point way = point - center;
        const double distance = length(way);
        if (distance * distance > LOST) return {point, way / distance, distance};
        const double side = std::copysign(1.0, center[axis]);
        point[axis] = side * half[axis], normal[axis] = -side;
        return {point, normal, depth};
    }
};

struct Cylinder {
    double radius, half;  // [m], of its height

    Nearest nearest(const Point& center) const {
        const Point across{center[0], 0.0, center[2]};
        const double away = length(across), height = std::abs(center[1]), side = std::copysign(1.0, center[1]);
        const double beyond = away - radius, above = height - half;
        const Point from_axis = away > 0.0 ? across / away : Point{1.0, 0.0, 0.0}, along{0.0, side, 0.0};
        const auto at = [&](double r, double h) { return r * from_axis + h * along; };
        if (beyond > 0.0 || above > 0.0) {
            const double out = std::max(beyond, 0.0), up = std::max(above, 0.0), distance = std::sqrt(out * out + up * up);
            const Point point = at(std::min(away, radius), std::min(height, half));
            if (distance > 0.0) return {point, at(-out / distance, -up / distance), distance};
            return {point, beyond > above ? -from_axis : -along, 0.0};
        }
        if (beyond >= above) return {at(radius, height), -from_axis, beyond};
        return {at(away, half), -along, above};
    }
};

// Also a ball, whose axis has no length.
struct Capsule {
    double radius, half;  // [m], of its axis

    Nearest nearest(const Point& center) const {
        const Point axis{0.0, std::min(std::max(center[1], -half), half), 0.0}, arm = center - axis;
        const double away = length(arm);
        const Point outward = away > 0.0 ? arm / away : Point{1.0, 0.0, 0.0};
        return {axis + radius * outward, -outward, away - radius};
    }
};

// A face of a mesh, seen from outside counterclockwise.
struct Face {
    Point corner, b, c;  // [m], and the edges to the other two corners
    Point normal;  // outward, unit

    // Of a point over its plane.
    double height(const Point& center) const { return dot(normal, center - corner); }

    // Its point nearest to another, and whether that is inside, by the regions of corners and edges (Ericson 2005, 5.1.5).
    std::pair<Point, bool> nearest(const Point& center) const {
        const Point arm = center - corner;
        const double d1 = dot(b, arm), d2 = dot(c, arm);
        if (d1 <= 0.0 && d2 <= 0.0) return {corner, false};
        const double bb = dot(b, b), bc = dot(b, c), cc = dot(c, c);
        const double d3 = d1 - bb, d4 = d2 - bc;
        if (d3 >= 0.0 && d4 <= d3) return {corner + b, false};
        const double d5 = d1 - bc, d6 = d2 - cc;
        if (d6 >= 0.0 && d5 <= d6) return {corner + c, false};
        const double on_ab = d1 * d4 - d3 * d2;
        if (on_ab <= 0.0 && d1 >= 0.0 && d3 <= 0.0) return {corner + (d1 / bb) * b, false};
        const double on_ac = d5 * d2 - d1 * d6;
        if (on_ac <= 0.0 && d2 >= 0.0 && d6 <= 0.0) return {corner + (d2 / cc) * c, false};
        const double on_bc = d3 * d6 - d5 * d4, up = d4 - d3, down = d5 - d6;
        if (on_bc <= 0.0 && up >= 0.0 && down >= 0.0) return {corner + b + (up / (up + down)) * (c - b), false};
        const double total = on_ab + on_ac + on_bc;
        return {corner + (on_ac / total) * b + (on_ab / total) * c, true};
    }
};

struct Mesh {
    std::vector<Face> faces;  // of a closed convex mesh, the origin inside
    std::shared_ptr<const std::vector<Point>> corners;  // of all faces [m], each once

    // The nearest point lies on a face that the centre is outside of, if there is one.
    Nearest nearest(const Point& center) const {
        constexpr double SHARP = 1e-9;  // [m]; nearer to an edge than this, rounding decides the direction
        double highest = -infinity;
        const Face *above = faces.data(), *closest = above;
        for (const Face& face : faces)
            if (const double height = face.height(center); height > highest) highest = height, above = &face;
        if (highest <= 0.0) return {center - highest * above->normal, -above->normal, highest};
        double best = infinity;
        bool flat = false;
        Point point = center;
        const auto look = [&](const Face& face) {
            const double height = face.height(center);
            if (height <= 0.0 || height * height >= best) return;
            const auto [there, inner] = face.nearest(center);
            const Point way = there - center;
            const double square = inner ? height * height : dot(way, way);
            if (square < best) best = square, closest = &face, flat = inner, point = there;
        };
        look(*above);  // the highest face first: mostly it is the one, and no other can be nearer then
        for (const Face& face : faces)
            if (&face != above) look(face);
        const double distance = std::sqrt(best);
        const bool edge = !flat && distance > SHARP;
        return {point, edge ? (point - center) / distance : -closest->normal, distance};
    }
};

struct Surface {
    std::variant<Cuboid, Cylinder, Capsule, Mesh> shape;

    // 10 ns for the simple shapes, 0.8 us for 400 faces; the centre must be finite.
    Nearest nearest(const Point& center) const {
        return std::visit([&](const auto& kind) { return kind.nearest(center); }, shape);
    }
};

}  // namespace grasp
