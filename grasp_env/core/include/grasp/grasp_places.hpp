// Places on an object that one finger of a hand can touch on its own.
#pragma once
#include "clearance.hpp"
#include "reach.hpp"

namespace grasp {

// What a place must keep.
struct Margins {
    double flat;       // [m] of flat surface around it
    double joints;     // [rad] from the joints' limits
    double clearance;  // [m] of the links from the object
};

// Where to begin inside the object [m], and what to add to the direction towards the finger.
struct Ray { Point start, aside; };

struct Place {
    Point point, normal;           // [m], inward
    std::vector<Segment> limbs;    // of the finger, when it is there
    std::vector<double> replies;   // see `grasp_search.hpp`
};

// How many rays ended at an edge, out of reach, with a link at the object.
struct Misses { int edge = 0, far = 0, touching = 0; };

// One finger of a hand: its joints as a tree of their own, and the limbs that they carry.
class Finger {
public:
    std::vector<int> joints;  // numbers in the hand
    std::vector<int> carried; // numbers of its limbs in the hand
    std::vector<Limb> limbs;  // links as numbered in the finger

    // home: (M,) [rad] of the hand, where the inverse kinematics starts
    Finger(const Tree& hand, int number, const std::vector<Limb>& all, const double* home)
        : tree_(std::make_shared<const Tree>(hand.chain(number, joints))), reach_(tree_), posture_(tree_) {
        for (int j : joints) home_.push_back(home[j]);
        for (std::size_t c = 0; c < all.size(); ++c) {
            const auto at = std::find(joints.begin(), joints.end(), all[c].link);
            if (at == joints.end()) continue;
            carried.push_back(int(c)), limbs.push_back(all[c]);
            limbs.back().link = int(at - joints.begin());
        }
        angles_ = home_;
        posture_.trace(home_.data());
        const Point tip = posture_.tip(0);
        direction_ = (1.0 / std::max(length(tip), 1e-9)) * tip;
    }

    bool carries(int limb) const { return std::binary_search(carried.begin(), carried.end(), limb); }

    // Up to `most` places that it reaches with its links clear of the object.
    void find(const Surface& surface, const std::vector<Ray>& rays, const Margins& margins, std::size_t most,
              std::vector<Place>& places, Misses& misses) {
        places.clear();
        for (const Ray& ray : rays) {
            if (places.size() == most) return;
            Nearest place;
            if (!walk(surface, ray, place)) continue;
            if (!flat(surface, place, margins.flat)) ++misses.edge;
            else if (!reaches(place, margins.joints)) ++misses.far;
            else if (Place made{place.point, place.inward, {}, {}}; !clear(surface, margins.clearance, made.limbs))
                ++misses.touching;
            else places.push_back(std::move(made));
        }
    }

private:
    std::shared_ptr<const Tree> tree_;
    Reach reach_;
    Posture posture_;
    std::vector<double> home_, angles_;
    Point direction_;  // from the object to the finger

    // From inside along a ray to the surface; false where the start is not inside.
    bool walk(const Surface& surface, const Ray& ray, Nearest& place) const {
        constexpr int STEPS = 8;  // exactly along the ray does not matter
        const Point way = direction_ + ray.aside;
        const double size = length(way);
        Point center = ray.start;
        place = surface.nearest(center);
        if (place.distance >= 0.0 || size < 0.1) return false;
        for (int step = 0; step < STEPS; ++step) {
            center -= (place.distance / size) * way;
            place = surface.nearest(center);
            if (place.distance > -1e-4) break;
        }
        return true;
    }

    // Whether the normal turns by less than 20 degrees up to `size` away.
    static bool flat(const Surface& surface, const Nearest& place, double size) {
        const Point& n = place.inward;
        int least = 0;
        for (int k = 1; k < 3; ++k)
            if (std::abs(n[k]) < std::abs(n[least])) least = k;
        Point side = -n[least] * n;
        side[least] += 1.0;
        side = (size / length(side)) * side;
        for (const Point& step : {side, cross(n, side), -side, -cross(n, side)})
            if (dot(surface.nearest(place.point + step - 0.1 * size * n).inward, n) < 0.94) return false;
        return true;
    }

    bool reaches(const Nearest& place, double margin) {
        const Point tip = place.point - tree_->tips[0].radius * place.inward;
        double missed;
        reach_.solve(&tip, home_.data(), 1, angles_.data(), &missed);
        bool good = missed <= REACHED;
        for (std::size_t j = 0; j < angles_.size(); ++j)
            good = good && tree_->links[j].lower + margin <= angles_[j] && angles_[j] <= tree_->links[j].upper - margin;
        return good;
    }

    // Whether the limbs are that far from the object at `angles_`; writes where they are.
    bool clear(const Surface& surface, double margin, std::vector<Segment>& there) {
        posture_.trace(angles_.data());
        for (const Limb& limb : limbs) {
            const double enough = limb.radius + margin;
            there.push_back(limb.at(posture_));
            if (!limb.tip && gap(surface, there.back(), enough) < enough) return false;
        }
        return true;
    }
};

// The limbs of a hand, and its fingers one by one.
struct HandLimbs {
    std::shared_ptr<const Tree> tree;
    std::vector<Limb> all;
    std::vector<Finger> fingers;

    HandLimbs(std::shared_ptr<const Tree> hand, std::vector<Limb> limbs, const double* home)
        : tree(std::move(hand)), all(std::move(limbs)) {
        for (int i = 0; i < tree->fingers(); ++i) fingers.emplace_back(*tree, i, all, home);
    }

    // Least distances [m]: of the links, without fingertips, from the object; of links and tips from one another.
    std::pair<double, double> clearance(const Surface& surface, const double* angles) const {
        Posture posture(tree);
        posture.trace(angles);
        double away = infinity, apart = infinity;
        std::vector<Segment> there;
        for (const Limb& limb : all) {
            const Segment axis = limb.at(posture);
            if (!limb.tip) away = std::min(away, gap(surface, axis, away + limb.radius) - limb.radius);
            for (std::size_t e = 0; e < there.size(); ++e)
                if (!neighbours(limb.link, all[e].link))
                    apart = std::min(apart, gap(axis, there[e]) - limb.radius - all[e].radius);
            there.push_back(axis);
        }
        return {away, apart};
    }
    // Of the palm from the object [m].
    double palm_gap(const Surface& surface) const {
        double least = infinity;
        for (const Limb& limb : all)
            if (limb.link < 0) least = std::min(least, gap(surface, limb.axis, least + limb.radius) - limb.radius);
        return least;
    }

private:
    // Links of one joint overlap around it; Bullet leaves them out too.
    bool neighbours(int a, int b) const { return a == b || tree->links[std::max(a, b)].parent == std::min(a, b); }
};

}  // namespace grasp
