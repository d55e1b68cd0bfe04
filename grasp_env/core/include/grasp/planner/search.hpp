// Search for the contacts with which a hand holds an object best.
//
// Every finger has candidate places that it reaches on its own. A choice of one per finger is rated
// by the largest force that any of the wrenches needs: the total normal force, or its use of the
// joints' torques if that is more. This rating is a maximum over directions y in wrench space,
//
//     max_y  max_w (-w . y) / h(y),  h(y) = max_i max {f . v_i(y) : f in cone i, cost 1},
//
// to which each place contributes separately. Its contribution to h, its reply, is tabulated for a
// few hundred y, so that rating a choice takes a microsecond. The best choices are solved exactly
// by linear programming, with rays of the round cones as columns when needed. The multipliers of
// these programs become further directions y.
#pragma once
#include <grasp/planner/hand_limbs.hpp>

namespace grasp {

// Largest work along y of a contact force of cost 1, and the wrench of that force. A soft contact
// also transmits a moment about its normal: (slip / friction)^2 + (moment / torsion)^2 <= (normal
// force)^2.
struct Reply {
  double work;
  Vec6 wrench;

  Reply(const Place& place, const Demand& demand, const Vec6& y) {
    const Point turn = (1.0 / demand.length) * point(y.data() + 3);
    const Point velocity = point(y.data()) + cross(turn, place.point);
    const double along = dot(velocity, place.normal);
    const Point tangent = velocity - along * place.normal;
    const double slip = length(tangent);
    double grip = slip > 0.0 ? demand.friction / slip : 0.0;
    double twist = 0.0;
    work = along + demand.friction * slip;
    if (demand.torsion > 0.0) {
      const double spin = demand.torsion * dot(turn, place.normal);
      const double both = std::hypot(demand.friction * slip, spin);
      grip *= both > 0.0 ? demand.friction * slip / both : 0.0;
      twist = both > 0.0 ? demand.torsion * spin / both : 0.0;
      work = along + both;
    }
    Point force = place.normal + grip * tangent;
    if (!place.efforts.empty()) {
      const double all = place.cost(force);
      const double plain = place.cost(place.normal);
      double cost = all;
      if (along * all > work * plain) {
        force = place.normal;
        work = along;
        cost = plain;
        twist = 0.0;
      }
      work /= cost;
      force = force / cost;
      twist /= cost;
    }
    wrench = unit_wrench((1.0 / demand.length) * place.point, force);
    if (twist != 0.0)
      for (int k = 0; k < 3; ++k) wrench[3 + k] += twist / demand.length * place.normal[k];
  }
};

// Smallest cost [N] of contact forces with the wrench `load`, to 2 %, by the rays from `Reply`;
// inf: none was found. y: multipliers; load . y over the largest reply is a lower bound.
inline double least_force(const std::vector<const Place*>& places, const Demand& demand,
                          const Vec6& load, Vec6& y) {
  constexpr double PENALTY = 1e6;  // [N] price of what no contact force balances
  constexpr double EXACT = 0.02;
  constexpr int PIVOTS = 120;
  Six<Vec6> inverse{};  // of the basis: six rays, or artificial columns at the penalty
  Vec6 amount, cost, column;
  for (int r = 0; r < 6; ++r) {
    inverse[r][r] = std::copysign(1.0, load[r]);
    amount[r] = std::abs(load[r]);
    cost[r] = PENALTY;
  }
  for (int pivot = 0; pivot < PIVOTS; ++pivot) {
    y = {};
    for (int r = 0; r < 6; ++r) y = y + cost[r] * inverse[r];
    const double upper = dot(cost, amount);
    const double lower = dot(y, load);
    double best = -infinity;
    Vec6 entering{};
    for (const Place* place : places)
      if (const Reply reply(*place, demand, y); reply.work > best) {
        best = reply.work;
        entering = reply.wrench;
      }
    if (best <= 1.0 + 1e-9 || (upper < 0.1 * PENALTY && upper * best <= (1.0 + EXACT) * lower))
      break;
    int leaving = -1;
    double least = infinity;
    for (int r = 0; r < 6; ++r) {
      column[r] = dot(inverse[r], entering);
      if (column[r] > 1e-10 && amount[r] < least * column[r]) {
        leaving = r;
        least = amount[r] / column[r];
      }
    }
    if (leaving < 0) break;
    inverse[leaving] = (1.0 / column[leaving]) * inverse[leaving];
    for (int r = 0; r < 6; ++r) {
      if (r == leaving) continue;
      amount[r] = std::max(amount[r] - least * column[r], 0.0);
      inverse[r] = inverse[r] - column[r] * inverse[leaving];
    }
    amount[leaving] = least;
    cost[leaving] = 1.0;
  }
  double total = 0.0;
  for (int r = 0; r < 6; ++r) {
    if (cost[r] == 1.0)
      total += amount[r];
    else if (amount[r] > 1e-9)
      return infinity;
  }
  return total;
}

class GraspSearch {
 public:
  using Choice = std::vector<int>;  // index of a place per finger
  struct RatedChoice {
    double force;  // [N] in the worst case
    Choice choice;
  };

  std::vector<std::vector<Place>> groups;  // for each finger
  std::vector<Misses> misses;

  GraspSearch(std::shared_ptr<HandLimbs> hand, Surface surface, Demand demand,
              std::vector<Vec6> directions)
      : groups(hand->fingers.size()),
        misses(groups.size()),
        hand_(std::move(hand)),
        object_(std::move(surface)),
        demand_(std::move(demand)),
        directions_(std::move(directions)) {}

  // Find up to `most` places of a finger. Return their number.
  int fill(int finger, const std::vector<Ray>& rays, const Margins& margins, int most) {
    hand_->fingers[finger].find(object_, demand_, rays, margins, most, groups[finger],
                                misses[finger]);
    return int(groups[finger].size());
  }

  enum Fault {
    none,
    near_object,
    near_itself,
    no_start,
    start_near_object,
    start_near_itself,
    not_together
  };

  // Compute the angles (M,) of the whole hand at its places, and before it closes; return what is
  // wrong with them. clearance: of the links from the object at the places [m].
  Fault assemble(const Choice& choice, double clearance, double* angles, double* start) {
    // [m] distance from the object of fingers of one motor when the first touches
    constexpr double TOGETHER = 2e-5;
    // fraction of the clearance from the object
    constexpr double EASIER = 0.9;
    // distance between links: a fraction of the clearance, and [m] the least one, as the fingers
    // deviate from the plan while they close
    constexpr double OWN = 1.0 / 3.0;
    constexpr double LEAST_OWN = 5e-4;
    std::copy(hand_->home.begin(), hand_->home.end(), angles);
    std::copy(angles, angles + hand_->home.size(), start);
    std::vector<double> there;
    bool starts = true;
    std::vector<int> shut;  // fingers so far that are closed by a shared motor
    for (std::size_t i = 0; i < choice.size(); ++i) {
      Finger& finger = hand_->fingers[i];
      const Place& place = groups[i][choice[i]];
      starts = finger.stand_off(object_.surface, place, demand_.start, there) && starts;
      const bool first = std::none_of(shut.begin(), shut.end(), [&](int f) {
        return hand_->fingers[f].closer == finger.closer;
      });
      for (std::size_t k = 0; k < finger.joints.size(); ++k)
        if (const int j = finger.joints[k]; j != finger.closer) {
          angles[j] = place.angles[k];
          start[j] = there[k];
        }
      if (finger.closer < 0) continue;
      double& at = angles[finger.closer];
      double& begun = start[finger.closer];
      const double open = finger.closed(there);
      if (first) {
        at = finger.closed(place.angles);
        begun = open;
      } else if (std::abs(open - at) > std::abs(begun - at))
        begun = open;
      shut.push_back(int(i));
    }
    hand_->tree->couple(angles);
    hand_->tree->couple(start);
    if (!shut.empty()) {
      Posture posture(hand_->tree);
      posture.trace(angles);
      for (int i : shut)
        if (const Point tip = posture.tip(i); std::abs(object_.surface.nearest(tip).distance -
                                                       hand_->tree->tips[i].radius) > TOGETHER)
          return not_together;
    }
    const auto [away, keeps_apart] = hand_->clearance(object_, angles, 2.0 * clearance);
    if (away < EASIER * clearance) return near_object;
    const double own = std::max(OWN * clearance, LEAST_OWN);
    if (!(keeps_apart > own)) return near_itself;
    if (!starts) return no_start;
    const auto [first_away, first_apart] = hand_->clearance(object_, start, 2.0 * clearance);
    if (!(first_away > OWN * clearance)) return start_near_object;
    return first_apart > own ? none : start_near_itself;
  }

  // Return the best choice of each round; each adds the multipliers of the last. No finger may be
  // without places. picks: random numbers >= 0 for the initial choices, half of them for the first
  // round.
  std::vector<RatedChoice> choose(const std::vector<Choice>& picks, int rounds) {
    constexpr int SWEEPS = 8;
    needs_.clear();
    for (auto& places : groups)
      for (Place& place : places) place.replies.clear();
    for (const Vec6& y : directions_) add_direction(y);
    std::vector<RatedChoice> out;
    Choice best, choice;
    std::size_t begun = 0;
    for (int round = 0; round < rounds; ++round) {
      double rating = best.empty() ? infinity : rate(best);
      const auto improve = [&] {
        double rated = rate(choice);
        for (int sweep = 0; sweep < SWEEPS && improve_each_finger(choice, rated); ++sweep) {
        }
        if (rated < rating || best.empty()) {
          rating = rated;
          best = choice;
        }
      };
      for (std::size_t share = picks.size() / (round == 0 ? 2 : 2 * rounds); share > 0; --share)
        if (begin(picks[begun++ % picks.size()], choice)) improve();
      if (best.empty()) return out;
      choice = best;
      improve();
      double worst = 0.0;
      std::vector<const Place*> places;
      for (std::size_t i = 0; i < best.size(); ++i) places.push_back(&groups[i][best[i]]);
      std::vector<Vec6> multipliers(demand_.loads.size());
      for (std::size_t m = 0; m < multipliers.size(); ++m)
        worst = std::max(worst, least_force(places, demand_, demand_.loads[m], multipliers[m]));
      for (const Vec6& y : multipliers) add_direction(y);
      out.push_back({worst, best});
    }
    return out;
  }

 private:
  std::shared_ptr<HandLimbs> hand_;
  Obstacle object_;
  Demand demand_;
  std::vector<Vec6> directions_;
  // per direction: the largest load . y; the largest reply of the other fingers
  std::vector<double> needs_, rest_;

  void add_direction(const Vec6& y) {
    double most = -infinity;
    for (const Vec6& load : demand_.loads) most = std::max(most, dot(load, y));
    needs_.push_back(most);
    for (auto& places : groups)
      for (Place& place : places) place.replies.push_back(Reply(place, demand_, y).work);
  }

  // Begin with the picked places: for each finger the first, from its pick on, that keeps apart
  // from those before.
  bool begin(const Choice& picks, Choice& choice) const {
    choice.clear();
    for (std::size_t i = 0; i < groups.size(); ++i) {
      const int count = int(groups[i].size());
      int tried = 0;
      int k = picks[i] % count;
      for (; tried < count && !keeps_apart(choice, i, k); ++tried) k = (k + 1) % count;
      if (tried == count) return false;
      choice.push_back(k);
    }
    return true;
  }

  // Give each finger in turn its best place. Return false if none changed.
  bool improve_each_finger(Choice& choice, double& rating) {
    bool changed = false;
    for (std::size_t i = 0; i < choice.size(); ++i) {
      rest_.assign(needs_.size(), 0.0);
      for (std::size_t j = 0; j < choice.size(); ++j)
        if (j != i) raise(rest_, groups[j][choice[j]]);
      for (int k = 0; k < int(groups[i].size()); ++k) {
        const double rated = rate(rest_, groups[i][k], rating);
        if (rated < rating && keeps_apart(choice, i, k)) {
          rating = rated;
          choice[i] = k;
          changed = true;
        }
      }
    }
    return changed;
  }

  static void raise(std::vector<double>& most, const Place& place) {
    for (std::size_t d = 0; d < most.size(); ++d) most[d] = std::max(most[d], place.replies[d]);
  }
  // Lower bound of a choice [N] by the table.
  double rate(const Choice& choice) {
    rest_.assign(needs_.size(), 0.0);
    for (std::size_t i = 0; i < choice.size(); ++i) raise(rest_, groups[i][choice[i]]);
    return rate(rest_, groups[0][choice[0]], infinity);
  }
  // The same, with the largest replies of the others; stops at `limit`.
  double rate(const std::vector<double>& rest, const Place& place, double limit) const {
    double worst = 0.0;
    for (std::size_t d = 0; d < needs_.size() && worst < limit; ++d) {
      const double reply = std::max(rest[d], place.replies[d]);
      if (needs_[d] > worst * reply) worst = reply > 0.0 ? needs_[d] / reply : infinity;
    }
    return worst;
  }

  // True if finger i at its place k keeps apart from the others, except for limbs that both carry.
  bool keeps_apart(const Choice& choice, std::size_t i, int k) const {
    const Finger& one = hand_->fingers[i];
    const Place& here = groups[i][k];
    for (std::size_t j = 0; j < choice.size(); ++j) {
      if (j == i) continue;
      const Finger& other = hand_->fingers[j];
      const Place& there = groups[j][choice[j]];
      for (std::size_t c = 0; c < one.limbs.size(); ++c) {
        if (other.carries(one.carried[c])) continue;
        for (std::size_t e = 0; e < other.limbs.size(); ++e) {
          if (one.carries(other.carried[e])) continue;
          const Limb& first = hand_->all[one.carried[c]];
          const Limb& second = hand_->all[other.carried[e]];
          if (hand_->together(first.link, second.link)) continue;
          if (first.solid.is_line() && second.solid.is_line()) {
            const double needed = first.solid.radius + second.solid.radius + demand_.space;
            if (gap(here.limbs[c].axis, there.limbs[e].axis) < needed) return false;
          } else if (is_closer(here.limbs[c], there.limbs[e], demand_.space)) {
            return false;
          }
        }
      }
    }
    return true;
  }
};

}  // namespace grasp
