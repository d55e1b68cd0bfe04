// Limits of a hand on its contact forces: normal forces, joint torques |J^T f + tau_0| <= tau_max,
// as rows a . f <= b, and as rows of length one on one contact's force for `RaisedLimits`.
#pragma once
#include <span>
#include <grasp/contacts/margin.hpp>
#include <grasp/limits/normal_bound.hpp>

namespace grasp {

// Empty members and inf mean no limit. The caller owns the numbers. The Jacobian is in the frame of
// the positions; `rows` and `LimitTable` take one in contact frames.
struct ForceLimits {
  std::span<const double> min_normal{};  // (N,) >= 0 [N]
  std::span<const double> max_normal{};  // (N,) [N]
  // (N, 3, J) joint speeds -> velocities of the contact points [m]; (N, 6, J): and of turning [1]
  std::span<const double> jacobian{};
  std::span<const double> torque_limit{};  // (J,) > 0 [N m]
  std::span<const double>
      torque_bias{};  // (J,) tau_0: further torques, as of the hand's weight [N m]

  // Number of finite limits, counted as rows.
  int many() const {
    const auto count = [](std::span<const double> limits, auto& is) {
      return int(std::count_if(limits.begin(), limits.end(), is));
    };
    return count(min_normal, limits_normal) + count(max_normal, limits_normal) +
           2 * count(torque_limit, limits_torque);
  }
  // Call f(row, b, limit) for smallest normal forces above 0, largest ones, then the upper and the
  // lower torque of each joint. row: (N, width) work space; width = 3, or 4 if the Jacobian has a
  // row for the torsion. With a preload, the rows limit the forces in addition to it.
  template <class F>
  void rows(int count, int width, std::span<double> row, F&& f, const Preload& preload = {}) const {
    const auto limit_row = [&](double bound, double limit) {
      f(row, bound - preload.cost(count, [&](int i) { return row[width * i]; }), limit);
    };
    const auto normal = [&](std::span<const double> limits, double sign) {
      for (int i = 0; i < int(limits.size()); ++i) {
        if (!limits_normal(limits[i])) continue;
        std::fill(row.begin(), row.end(), 0.0);
        row[width * i] = sign;
        limit_row(sign * limits[i], limits[i]);
      }
    };
    normal(min_normal, -1.0);
    normal(max_normal, 1.0);
    const int joints = int(torque_limit.size());
    for (int j = 0; j < joints; ++j) {
      if (!limits_torque(torque_limit[j])) continue;
      for (double sign : {1.0, -1.0}) {
        for (int k = 0; k < width * count; ++k) row[k] = sign * jacobian[joints * k + j];
        limit_row(torque_limit[j] - sign * (torque_bias.empty() ? 0.0 : torque_bias[j]),
                  torque_limit[j]);
      }
    }
  }
  // Call f(row, bias) for the torque of each joint, row . f + bias, as `rows` with width 4.
  template <class F>
  void torques(int count, std::span<double> row, F&& f, const Preload& preload) const {
    const int joints = int(torque_limit.size());
    for (int j = 0; j < joints; ++j) {
      for (int k = 0; k < 4 * count; ++k) row[k] = jacobian[joints * k + j];
      f(row, (torque_bias.empty() ? 0.0 : torque_bias[j]) +
                 preload.cost(count, [&](int i) { return row[4 * i]; }));
    }
  }

 private:
  static bool limits_normal(double limit) { return limit > 0.0 && limit < infinity; }
  static bool limits_torque(double limit) { return limit < infinity; }
};

// Rows that each act on one contact's force, in cone coordinates. Refilling does not allocate.
class LimitTable {
 public:
  static constexpr int MOST_ROWS = 64;  // on one contact
  // as in `LimitRows`
  std::vector<double> normals, bounds, shares;
  std::vector<int> owners;

  // Fill the table; the Jacobian is (N, width, J). Return false if a row acts on several contacts,
  // or if numbers are not finite or too large.
  bool fill(const Contacts& contacts, const ForceLimits& limits, int width = 3,
            const Preload& preload = {}) {
    const int count = contacts.count;
    clear();
    reserve(limits.many());  // includes rows that are not reached now
    row_.resize(width * count);
    bool good = true;
    limits.rows(
        count, width, row_,
        [&](std::span<const double> row, double bound, double limit) {
          good = good && add(count, row.data(), contacts.divisor.data(), bound, limit, width);
        },
        preload);
    return good;
  }
  // Add a row (N, width) on at most one contact. limit: growth of b if the limit doubles.
  bool add(int count, const double* row, const double* divisor, double bound, double limit,
           int width = 3) {
    int owner = -1;
    for (int i = 0; i < count; ++i) {
      if (row[width * i] == 0.0 && row[width * i + 1] == 0.0 && row[width * i + 2] == 0.0) continue;
      const Point a = over(row + width * i, divisor + 3 * i);
      if (a.u == 0.0 && a.o == 0.0 && a.t == 0.0) continue;
      if (owner >= 0) return false;
      owner = i;
    }
    const int at = std::max(owner, 0);
    Point a = over(row + width * at, divisor + 3 * at);
    double size = length(a);
    if (size == 0.0) size = 1.0;
    a = {a.u / size, a.o / size, a.t / size};
    const double b = bound / size;
    const double share = limit / size;
    if (!(length(a) < infinity && std::abs(b) <= MOST_FORCE && std::abs(share) <= MOST_FORCE))
      return false;
    for (int r = 0; r < 3; ++r) normals.push_back(a[r]);
    bounds.push_back(b);
    shares.push_back(share);
    owners.push_back(at);
    return std::count(owners.begin(), owners.end(), at) <= MOST_ROWS;
  }
  void clear() {
    normals.clear();
    bounds.clear();
    shares.clear();
    owners.clear();
  }

  LimitRows rows() const {
    return {int(bounds.size()), normals.data(), bounds.data(), shares.data(), owners.data()};
  }

 private:
  static constexpr double MOST_FORCE = 1e20;  // [N]
  std::vector<double> row_;

  void reserve(int rows) {
    normals.reserve(3 * rows);
    owners.reserve(rows);
    for (auto* column : {&bounds, &shares}) column->reserve(rows);
  }

  static Point over(const double* row, const double* divisor) {
    return {row[0] / divisor[0], row[1] / divisor[1], row[2] / divisor[2]};
  }
};

}  // namespace grasp
