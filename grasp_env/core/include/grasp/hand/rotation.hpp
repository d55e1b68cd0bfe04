// Rotations in space.
#pragma once
#include <grasp/contacts/geometry.hpp>

namespace grasp {

struct Rotation {
  Point rows[3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};

  static Rotation from(const double* matrix) {
    return {{point(matrix), point(matrix + 3), point(matrix + 6)}};
  }
  // quaternion: unit (x, y, z, w)
  static Rotation of_quaternion(const double* q) {
    const double x = q[0];
    const double y = q[1];
    const double z = q[2];
    const double w = q[3];
    return {{{1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)},
             {2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)},
             {2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)}}};
  }

  Point operator*(const Point& a) const {
    return {dot(rows[0], a), dot(rows[1], a), dot(rows[2], a)};
  }
  Point transposed(const Point& a) const { return a.u * rows[0] + a.o * rows[1] + a.t * rows[2]; }
  Rotation operator*(const Rotation& b) const {
    return {{b.transposed(rows[0]), b.transposed(rows[1]), b.transposed(rows[2])}};
  }
  Rotation transposed() const { return {{column(0), column(1), column(2)}}; }
  Point column(int a) const { return {rows[0][a], rows[1][a], rows[2][a]}; }

  // This rotation after a turn by an angle [rad] about a unit axis in its own frame (Rodrigues).
  Rotation turned(const Point& axis, double angle) const {
    const double sine = std::sin(angle);
    const double cosine = std::cos(angle);
    const double rest = 1.0 - cosine;
    Rotation out;
    for (int k = 0; k < 3; ++k)
      out.rows[k] =
          cosine * rows[k] + sine * cross(rows[k], axis) + (rest * dot(rows[k], axis)) * axis;
    return out;
  }

  // Axis times angle [rad], exact below pi.
  Point vector() const {
    const Point twice{rows[2].o - rows[1].t, rows[0].t - rows[2].u, rows[1].u - rows[0].o};
    const double sine = 0.5 * length(twice);
    const double cosine = 0.5 * (rows[0].u + rows[1].o + rows[2].t - 1.0);
    return 0.5 * (sine > 1e-9 ? std::atan2(sine, cosine) / sine : 1.0) * twice;
  }
};

}  // namespace grasp
