// Limits of a hand on its contact forces: smallest and largest normal forces, joint torques |J^T f
// + tau_0| <= tau_max. They appear as rows a . f <= b, and as rows of length one on one contact's
// force for `LimitTerms`.
#pragma once
#include <span>
#include <grasp/limits/terms.hpp>

namespace grasp {

// Empty members mean no limit, as does inf. The caller owns the numbers. The Jacobian is in the
// frame of the positions; `rows` and `LimitTable` take one in contact frames.
struct ForceLimits {
  std::span<const double> min_normal{};  // (N,) >= 0 [N]
  std::span<const double> max_normal{};  // (N,) [N]
  std::span<const double> jacobian{};  // (N, 3, J) joint speeds -> velocities of the contact points
                                       // [m]; (N, 6, J): and of turning [1]
  std::span<const double> torque_limit{};  // (J,) > 0 [N m]
  std::span<const double> torque_bias{};  // (J,) tau_0: torques in addition to the grasp's, such as
                                          // the hand's weight [N m]

  // Number of finite limits, counted as rows.
  int many() const {
    const auto count = [](std::span<const double> limits, auto& is) {
      return int(std::count_if(limits.begin(), limits.end(), is));
    };
    return count(min_normal, limits_normal) + count(max_normal, limits_normal) +
           2 * count(torque_limit, limits_torque);
  }
  // Call f(row, b, limit) for smallest normal forces above 0, largest normal forces, then the upper
  // and the lower torque of each joint. row: (N, each) work space; each = 3, or 4 if the Jacobian
  // has a row for the torsion.
  template <class F> void rows(int count, int each, std::span<double> row, F&& f) const {
    const auto normal = [&](std::span<const double> limits, double sign) {
      for (int i = 0; i < int(limits.size()); ++i) {
        if (!limits_normal(limits[i])) continue;
        std::fill(row.begin(), row.end(), 0.0);
        row[each * i] = sign;
        f(row, sign * limits[i], limits[i]);
      }
    };
    normal(min_normal, -1.0);
    normal(max_normal, 1.0);
    const int joints = int(torque_limit.size());
    for (int j = 0; j < joints; ++j) {
      if (!limits_torque(torque_limit[j])) continue;
      for (double sign : {1.0, -1.0}) {
        for (int k = 0; k < each * count; ++k) row[k] = sign * jacobian[joints * k + j];
        f(row, torque_limit[j] - sign * (torque_bias.empty() ? 0.0 : torque_bias[j]),
          torque_limit[j]);
      }
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
  // as in `LimitRows`; sizes: (M,) divisors of the rows
  std::vector<double> normals, bounds, shares, weights, sizes;
  std::vector<int> owners;

  // Fill the table. Return false if a row acts on several contacts, or if numbers are not finite or
  // too large for the solvers. The Jacobian is (N, each, J) in contact frames.
  bool fill(const Contacts& contacts, const ForceLimits& limits, int each = 3) {
    const int count = contacts.count;
    clear();
    reserve(limits.many());  // includes rows that are not reached now
    row_.resize(each * count);
    bool good = true;
    limits.rows(count, each, row_, [&](std::span<const double> row, double bound, double limit) {
      good = good && add(count, row.data(), contacts.divisor.data(), contacts.lambda.data(), bound,
                         limit, each);
    });
    return good;
  }
  // Add a row (N, each) on forces that acts on at most one contact. limit: growth of b if the limit
  // grows by all of itself.
  bool add(int count, const double* row, const double* divisor, const double* lambda, double bound,
           double limit, int each = 3) {
    int owner = -1;
    double mean = 0.0;
    for (int i = 0; i < count; ++i) {
      mean += lambda[i] / count;
      if (row[each * i] == 0.0 && row[each * i + 1] == 0.0 && row[each * i + 2] == 0.0) continue;
      const Point a = over(row + each * i, divisor + 3 * i);
      if (a.u == 0.0 && a.o == 0.0 && a.t == 0.0) continue;
      if (owner >= 0) return false;
      owner = i;
    }
    const int at = std::max(owner, 0);
    Point a = over(row + each * at, divisor + 3 * at);
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
    sizes.push_back(size);
    owners.push_back(at);
    weights.push_back(owner < 0 ? mean : lambda[at]);
    return std::count(owners.begin(), owners.end(), at) <= MOST_ROWS;
  }
  void clear() {
    normals.clear();
    bounds.clear();
    shares.clear();
    weights.clear();
    sizes.clear();
    owners.clear();
  }

  LimitRows rows() const {
    return {int(bounds.size()), normals.data(), bounds.data(),
            shares.data(),      weights.data(), owners.data()};
  }

 private:
  static constexpr double MOST_FORCE = 1e20;  // [N]
  std::vector<double> row_;

  void reserve(int rows) {
    normals.reserve(3 * rows);
    owners.reserve(rows);
    for (auto* each : {&bounds, &shares, &weights, &sizes}) each->reserve(rows);
  }

  static Point over(const double* row, const double* divisor) {
    return {row[0] / divisor[0], row[1] / divisor[1], row[2] / divisor[2]};
  }
};

}  // namespace grasp
