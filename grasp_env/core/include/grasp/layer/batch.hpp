// Many problems as arrays, one row of each per problem, and one of them in the form of solvers.
#pragma once
#include <span>
#include <vector>
#include <grasp/contacts/contacts.hpp>
#include <grasp/limits/force_limits.hpp>

namespace grasp {

// The rows of an array, one per problem. step: numbers between rows; 0: one row for all.
struct Slices {
  const double* data = nullptr;  // null: the array is not given
  std::ptrdiff_t step = 0;

  const double* operator[](std::ptrdiff_t k) const { return data ? data + step * k : nullptr; }
  explicit operator bool() const { return data; }
};

// All quantities share one frame. Positions, normals, friction, wrenches and weights are required.
// By default contacts are hard, without limits, with the tangents of the default rule.
struct ForceBatch {
  std::ptrdiff_t size = 0;
  int contacts = 0, joints = 0;
  int jacobian_rows = 3;  // 3, or 6 with the angular velocities of the fingertips
  // (N, 3) [m], (N, 3) inward, of any length, (N, 2) along o and t
  Slices positions, normals, friction;
  Slices tangents;                             // (N, 3) directions of o, of any length
  Slices torsion;                              // (N,) torsional friction [m], 0: hard
  Slices wrench;                               // (6,) external, on the object [N, N m]
  Slices jacobian, torque_limit, torque_bias;  // (N, rows, J), (J,) [N m], (J,) [N m]
  Slices min_normal, max_normal;               // (N,) [N]
  Slices force_weight, barrier_weight;         // (N,) omega, lambda
  Slices start;                                // (N, 3) forces to start from [N]

  bool limited() const { return torque_limit || min_normal || max_normal; }
  ForceBatch part(std::ptrdiff_t from, std::ptrdiff_t to) const;
};

// The arrays in the order in which programs pass them.
inline constexpr Slices ForceBatch::* FORCE_INPUTS[] = {
    &ForceBatch::positions,      &ForceBatch::normals,      &ForceBatch::friction,
    &ForceBatch::tangents,       &ForceBatch::torsion,      &ForceBatch::wrench,
    &ForceBatch::jacobian,       &ForceBatch::torque_limit, &ForceBatch::torque_bias,
    &ForceBatch::min_normal,     &ForceBatch::max_normal,   &ForceBatch::force_weight,
    &ForceBatch::barrier_weight, &ForceBatch::start};

inline ForceBatch ForceBatch::part(std::ptrdiff_t from, std::ptrdiff_t to) const {
  ForceBatch part = *this;
  part.size = to - from;
  for (const auto input : FORCE_INPUTS)
    if (part.*input) (part.*input).data += (part.*input).step * from;
  return part;
}

// The contacts of one problem of a batch: unit directions, scales and weights.
struct PosedProblem {
  // (N, 3), (N, 3), (N, 3), (N, 2) omega and lambda, (N,) of the normals
  std::vector<double> normals, tangents, scale, weights, lengths;
  std::vector<double> start;  // (N, 3) [N], contact frames

  explicit PosedProblem(int count = 0)
      : normals(3 * count),
        tangents(3 * count),
        scale(3 * count),
        weights(2 * count),
        lengths(count),
        start(3 * count) {}

  // Load problem k. Return false if its numbers are impossible.
  bool take(const ForceBatch& batch, std::ptrdiff_t k) {
    const int count = batch.contacts;
    const auto within = [](const double* from, int many, double low, double high) {
      return !from ||
             std::all_of(from, from + many, [&](double v) { return v >= low && v <= high; });
    };
    const int motions = count * batch.jacobian_rows * batch.joints;
    if (!within(batch.positions[k], 3 * count, -LARGEST, LARGEST) ||
        !within(batch.friction[k], 2 * count, 0.0, LARGEST) ||
        !within(batch.wrench[k], 6, -LARGEST, LARGEST) ||
        !within(batch.torsion[k], count, 0.0, LARGEST) ||
        !within(batch.jacobian[k], motions, -LARGEST, LARGEST) ||
        !within(batch.torque_bias[k], batch.joints, -LARGEST, LARGEST) ||
        !within(batch.torque_limit[k], batch.joints, 0.0, infinity) ||
        !within(batch.min_normal[k], count, 0.0, LARGEST) ||
        !within(batch.max_normal[k], count, 0.0, infinity) ||
        !within(batch.force_weight[k], count, LEAST, LARGEST) ||
        !within(batch.barrier_weight[k], count, LEAST, LARGEST))
      return false;
    for (int i = 0; i < count; ++i) {
      const Point inward = point(batch.normals[k] + 3 * i);
      const double size = lengths[i] = length(inward);
      if (!(size > LEAST && size < LARGEST)) return false;
      const Point normal = normalised((1.0 / size) * inward);
      Point along =
          std::abs(normal.u) > TANGENT_SWITCH ? Point{0.0, 1.0, 0.0} : Point{1.0, 0.0, 0.0};
      if (batch.tangents) {
        const Point tangent = point(batch.tangents[k] + 3 * i);
        const double reach = length(tangent);
        if (!(reach > LEAST && reach < LARGEST)) return false;
        along = (1.0 / reach) * tangent;
        if (!(length(along - dot(along, normal) * normal) > ALONG)) return false;
      }
      const double* mu = batch.friction[k] + 2 * i;
      const Point scales = cone_scale(mu[0], mu[1]);
      for (int a = 0; a < 3; ++a) {
        normals[3 * i + a] = normal[a];
        tangents[3 * i + a] = along[a];
        scale[3 * i + a] = scales[a];
      }
      weights[2 * i] = batch.force_weight[k][i];
      weights[2 * i + 1] = batch.barrier_weight[k][i];
    }
    return true;
  }
  Contacts placed(const ForceBatch& batch, std::ptrdiff_t k) const {
    Contacts contacts(batch.contacts, scale.data(), weights.data(), tangents.data(),
                      batch.torsion[k]);
    contacts.place(batch.positions[k], normals.data());
    return contacts;
  }
  // Load the start. Return false if there is none or its numbers are not finite.
  bool take_start(const ForceBatch& batch, std::ptrdiff_t k) {
    if (!batch.start) return false;
    double total = 0.0;
    for (int i = 0; i < batch.contacts; ++i) {
      const Frame frame(point(&normals[3 * i]), &tangents[3 * i]);
      for (int a = 0; a < 3; ++a) {
        start[3 * i + a] = dot(frame[a], point(batch.start[k] + 3 * i));
        total += std::abs(start[3 * i + a]);
      }
    }
    return total < LARGEST;
  }

 private:
  static constexpr double LEAST = 1e-150;  // smallest length or weight
  static constexpr double ALONG = 1e-6;    // sine of the angle between a tangent and its normal
};

// The derivatives of a loss by force (N, 3), torsion (N,) and multipliers (6,), one row per
// problem; null: zero.
struct BatchLosses {
  const double *force, *torsion, *multipliers;
};

// Gradients for every array of a batch, one row per problem; null: not wanted.
struct BatchGradients {
  double *positions, *normals, *friction, *tangents, *torsion, *wrench, *jacobian, *torque_limit,
      *torque_bias, *min_normal, *max_normal, *force_weight, *barrier_weight;
};
// In the order of `FORCE_INPUTS`, of which a start has no gradient.
inline constexpr double* BatchGradients::* FORCE_GRADIENTS[] = {
    &BatchGradients::positions,     &BatchGradients::normals,      &BatchGradients::friction,
    &BatchGradients::tangents,      &BatchGradients::torsion,      &BatchGradients::wrench,
    &BatchGradients::jacobian,      &BatchGradients::torque_limit, &BatchGradients::torque_bias,
    &BatchGradients::min_normal,    &BatchGradients::max_normal,   &BatchGradients::force_weight,
    &BatchGradients::barrier_weight};

}  // namespace grasp
