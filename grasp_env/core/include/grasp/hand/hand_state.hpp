// What a hand and its sensors know at an update: the input of `HandController`.
#pragma once
#include <algorithm>
#include <cmath>
#include <span>
#include <vector>
#include <grasp/contacts/contacts.hpp>
#include <grasp/hand/rotation.hpp>

namespace grasp {

// The parts of a `HandState`, in their order.
enum HandPart {
  ANGLES,     // (M,) [rad]
  RATES,      // (M,) [rad/s]
  TOUCHING,   // (N,) 1: the fingertip touches the object, 0: it does not
  POSITIONS,  // (N, 3) contact points [m], object frame; not read where a fingertip does not touch
  NORMALS,    // (N, 3) unit normals into the object, likewise
  WRENCH,   // (6,) wrench to balance: the object's weight, feedback on its pose [N, N m], likewise
  GRAVITY,  // (3,) [m/s^2], base frame: the hand may be on an arm
  OBJECT,   // `BodyRow`: the object frame in the base frame
  TARGET,   // `BodyRow`: where it should be
  AGES,     // (3,) of the joints, of the contacts and of the wrench [s]
  PARTS
};

// A hand of M joints and N fingertips. Where the object's pose is not known, leave OBJECT as it is:
// then its frame is that of the hand's base.
class HandState {
 public:
  static constexpr struct {
    const char *name, *unit;
    int per_joint, per_tip, more;  // how many numbers it has
  } TABLE[PARTS] = {
      {"angles", "rad", 1, 0, 0},
      {"rates", "rad/s", 1, 0, 0},
      {"touching", "1", 0, 1, 0},
      {"positions", "m", 0, 3, 0},
      {"normals", "1", 0, 3, 0},
      {"wrench", "N; N m", 0, 0, 6},
      {"gravity", "m/s^2", 0, 0, 3},
      {"object", "m; 1; m/s; rad/s", 0, 0, 13},
      {"target", "m; 1; m/s; rad/s", 0, 0, 13},
      {"ages", "s", 0, 0, 3},
  };

  explicit HandState(int joints = 0, int fingers = 0) {
    int end = 0;
    for (int part = 0; part < PARTS; ++part) {
      first_[part] = end;
      const auto& of = TABLE[part];
      end += of.per_joint * joints + of.per_tip * fingers + of.more;
    }
    first_[PARTS] = end;
    numbers_.resize(end);
    object() = target() = BodyRow{};
  }

  std::span<double> operator[](HandPart part) {
    return std::span(numbers_).subspan(first_[part], first_[part + 1] - first_[part]);
  }
  std::span<const double> operator[](HandPart part) const {
    return std::span(numbers_).subspan(first_[part], first_[part + 1] - first_[part]);
  }
  BodyRow& object() { return *reinterpret_cast<BodyRow*>((*this)[OBJECT].data()); }
  BodyRow& target() { return *reinterpret_cast<BodyRow*>((*this)[TARGET].data()); }
  const BodyRow& object() const {
    return *reinterpret_cast<const BodyRow*>((*this)[OBJECT].data());
  }
  const BodyRow& target() const {
    return *reinterpret_cast<const BodyRow*>((*this)[TARGET].data());
  }
  Point position(int i) const { return point(&(*this)[POSITIONS][3 * i]); }
  Point normal(int i) const { return point(&(*this)[NORMALS][3 * i]); }
  Vec6 wrench() const {
    const std::span<const double> w = (*this)[WRENCH];
    return {w[0], w[1], w[2], w[3], w[4], w[5]};
  }
  bool touches(int i) const { return (*this)[TOUCHING][i] != 0.0; }
  // All parts in one row, for messages and recordings.
  std::span<double> numbers() { return numbers_; }
  std::span<const double> numbers() const { return numbers_; }

  // True for a state of as many joints and fingertips.
  bool is_like(const HandState& other) const { return std::ranges::equal(first_, other.first_); }
  // True if all numbers that are read are finite, and normals and quaternions have length 1.
  bool is_sound() const {
    const auto finite = [](double number) { return std::abs(number) <= LARGEST; };
    for (HandPart part : {ANGLES, RATES, TOUCHING, WRENCH, GRAVITY, OBJECT, TARGET})
      if (!std::ranges::all_of((*this)[part], finite)) return false;
    for (const BodyRow* body : {&object(), &target()})
      if (!is_unit(body->quaternion)) return false;
    for (int i = 0; i < int((*this)[TOUCHING].size()); ++i)
      if (touches(i) && !(std::ranges::all_of((*this)[POSITIONS].subspan(3 * i, 3), finite) &&
                          is_unit((*this)[NORMALS].subspan(3 * i, 3))))
        return false;
    return std::ranges::none_of((*this)[AGES], [](double age) { return std::isnan(age); });
  }
  // Take a sound state of the same hand, with normals and quaternions of exact length. A fingertip
  // without contact keeps its last contact.
  void take(const HandState& state) {
    for (HandPart part : {ANGLES, RATES, TOUCHING, WRENCH, GRAVITY, OBJECT, TARGET})
      std::ranges::copy(state[part], (*this)[part].begin());
    for (int k = 0; k < 3; ++k) (*this)[AGES][k] = std::max(state[AGES][k], 0.0);
    for (BodyRow* body : {&object(), &target()}) make_unit(body->quaternion);
    for (int i = 0; i < int((*this)[TOUCHING].size()); ++i)
      if (touches(i)) {
        for (HandPart part : {POSITIONS, NORMALS})
          std::copy_n(&state[part][3 * i], 3, &(*this)[part][3 * i]);
        make_unit((*this)[NORMALS].subspan(3 * i, 3));
      }
  }

  // True for a normal or a quaternion of length 1, as far as messages are exact.
  static bool is_unit(std::span<const double> vector) {
    return std::abs(length_of(vector) - 1.0) <= UNIT_TOLERANCE;
  }
  static void make_unit(std::span<double> vector) {
    constexpr double ROUNDING = 1e-12;  // exact ones stay as they are, bit by bit
    const double length = length_of(vector);
    if (std::abs(length - 1.0) <= ROUNDING) return;
    for (double& number : vector) number /= length;
  }

 private:
  static double length_of(std::span<const double> vector) {
    double square = 0.0;
    for (double number : vector) square += number * number;
    return std::sqrt(square);
  }
  int first_[PARTS + 1];
  std::vector<double> numbers_;
};

}  // namespace grasp
