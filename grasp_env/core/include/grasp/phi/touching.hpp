// The contacts that touch, up to 64 of them, and the wrenches of their forces.
#pragma once
#include <grasp/contacts/contacts.hpp>
#include <grasp/math/vec.hpp>

namespace grasp {

class Touching {
 public:
  int count = 0, index[64];                  // numbers of the contacts that touch
  UnitFrame unit;                            // of these
  std::vector<std::array<Vec6, 4>> columns;  // (count,) of G in cone coordinates, unit frame

  explicit Touching(int most) : columns(most) {}

  // contacts: gives the cones. touching: bits. The current places are positions (N, 3) [m] and
  // frames (N, 3, 3) with columns (n, o, t), in one frame.
  void gather(const Contacts& contacts, std::uint64_t touching, const double* positions,
              const double* frames) {
    count = 0;
    for (int i = 0; i < contacts.count; ++i)
      if (touching >> i & 1) index[count++] = i;
    unit = UnitFrame(count, [&](int k) { return point(positions + 3 * index[k]); });
    for (int k = 0; k < count; ++k) place(contacts, k, positions, frames);
  }
  Vec6 wrench_of(int k, const Vec<double, 4>& x) const {
    Vec6 out{};
    for (int a = 0; a < 4; ++a) out = out + x[a] * columns[k][a];
    return out;
  }

 private:
  void place(const Contacts& contacts, int k, const double* positions, const double* frames) {
    const int i = index[k];
    const Point arm = unit.scale() * (point(positions + 3 * i) - unit.centre);
    const double* frame = frames + 9 * i;
    for (int a = 0; a < 3; ++a)
      columns[k][a] = (1.0 / contacts.divisor[3 * i + a]) *
                      unit_wrench(arm, Point{frame[a], frame[3 + a], frame[6 + a]});
    const double per = unit.scale() / divisor_of(contacts.torsion_scale(i));
    columns[k][3] = {0.0, 0.0, 0.0, per * frame[0], per * frame[3], per * frame[6]};
  }
};

}  // namespace grasp
