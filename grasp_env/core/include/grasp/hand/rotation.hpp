// Rotations in space.
#pragma once
#include <algorithm>
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

  // Write the unit quaternion (x, y, z, w), w >= 0.
  void quaternion(double* q) const {
    // the largest of the four squares, 4 x^2 .. 4 w^2, keeps the others' digits
    const double trace = rows[0].u + rows[1].o + rows[2].t;
    double squares[4] = {1.0 + 2.0 * rows[0].u - trace, 1.0 + 2.0 * rows[1].o - trace,
                         1.0 + 2.0 * rows[2].t - trace, 1.0 + trace};
    const int k = int(std::max_element(squares, squares + 4) - squares);
    const auto sum = [&](int a, int b) { return rows[a][b] + rows[b][a]; };
    const double turns[3] = {rows[2].o - rows[1].t, rows[0].t - rows[2].u, rows[1].u - rows[0].o};
    for (int a = 0; a < 4; ++a) {
      if (a == k)
        q[a] = squares[k];
      else if (a == 3 || k == 3)
        q[a] = turns[std::min(a, k)];
      else
        q[a] = sum(a, k);
    }
    const double scale = std::copysign(0.5 / std::sqrt(squares[k]), q[3]);
    for (int a = 0; a < 4; ++a) q[a] *= scale;
  }
};

// Pose and velocity of a body.
struct BodyRow {
  Point position{0.0, 0.0, 0.0};                // of its centre [m]
  double quaternion[4] = {0.0, 0.0, 0.0, 1.0};  // unit (x, y, z, w)
  Point linear{0.0, 0.0, 0.0};                  // [m/s]
  Point angular{0.0, 0.0, 0.0};                 // [rad/s]

  // Velocity of a point that moves with the body [m/s].
  Point velocity(const Point& place) const { return linear + cross(angular, place - position); }
};

}  // namespace grasp
