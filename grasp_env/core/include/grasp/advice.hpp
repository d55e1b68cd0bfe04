// Common mistakes in contacts, limits and wrenches: wrong units, signs and frames, which solve as well as the right ones do.
#pragma once
#include <cstdarg>
#include <cstdio>
#include <string>
#include <grasp/optimizer.hpp>

namespace grasp {

// One likely mistake.
struct Advice {
    bool near_certain;  // no plausible problem looks like this
    std::string text;   // what was seen, when it may be right, and what to change
};

namespace detail {

class Adviser {
public:
    static constexpr double LONGEST = 5.0;           // [m] length of a grasp, lever of a joint: beyond it they are millimetres
    static constexpr double ROUGHEST = 2.0;          // Coulomb coefficient of the roughest rubber
    static constexpr double DEGREES = 5.0;           // a coefficient beyond it is an angle
    static constexpr double WIDEST_PATCH = 0.1;  // [m] torsional friction that would need a contact patch as wide as a hand
    static constexpr double FAR = 8.0;  // origin from the contacts, in lengths of the grasp
    static constexpr double VERY_FAR = 15.0;  // the same, where no tool is held that reaches so far...
    static constexpr double ARM = 0.4;  // [m] ...and at least this far
    static constexpr double SHORT_LEVER = 4.0;  // moment over force of a usual wrench, in lengths or reaches of the grasp
    static constexpr double LONG_LEVER = 20.0;  // the same of a wrench that hardly pushes, in reaches (length plus origin)
    static constexpr double PURE_MOMENT = 50.0;  // [N] a moment over the grasp's length, without any force
    static constexpr double TURNING = 10.0;  // [N] the same that is too small to mistake for a force
    static constexpr double STRONGEST = 500.0;  // torque limit over the torque that a load needs: beyond it they are mN m
    static constexpr double WEAKEST = 1.0 / 300.0;  // torque limit over the torque that a load needs
    static constexpr double SMALLEST_LOAD = 0.1;  // [N] below it torque limits are not judged

    Adviser(const Contacts& contacts, const ForceLimits& limits, Doubles wrench)
        : contacts_(contacts), limits_(limits), wrench_(wrench) {}

    std::vector<Advice> all() {
        normals(), units(), jacobian();
        if (wrench_.size() == 6) origin(), swapped(), torques();
        return std::move(said_);
    }
    // True if there is advice that is near certain: without text, for the first call of every solver.
    bool near_certain() const {
        return outward() == contacts_.count || contacts_.unit.length > LONGEST || roughest().second > DEGREES ||
               longest_lever() > LONGEST || (wrench_.size() == 6 && (elsewhere(VERY_FAR, ARM) || exchanged()));
    }

private:
    const Contacts& contacts_;
    const ForceLimits& limits_;
    Doubles wrench_;
    std::vector<Advice> said_;

    void say(bool near_certain, const char* format, ...) {
        char text[512];
        std::va_list values;
        va_start(values, format);
        std::vsnprintf(text, sizeof text, format, values);
        va_end(values);
        said_.push_back({near_certain, text});
    }
    bool away(int i) const {  // the normal of contact i points away from the centre of the contacts
        const Point arm = point(&contacts_.positions[3 * i]) - contacts_.unit.centre;
        return dot(point(&contacts_.normals[3 * i]), arm) > 1e-9 * contacts_.unit.length;
    }
    int outward() const {
        int many = 0;
        for (int i = 0; i < contacts_.count; ++i) many += away(i);
        return many;
    }
    static bool can_squeeze(const Contacts& contacts) {
        std::vector<double> force(3 * contacts.count), torsion(contacts.count);
        return ForceOptimizer({contacts}).deepest(std::array<double, 6>{}, force, torsion).code == CONVERGED;
    }
    void normals() {
        const int many = outward(), count = contacts_.count;
        if (many == count)
            return say(
                true,
                "all %d normals point away from the centre of the contacts: normals must point INTO the object; change their "
                "sign, unless the fingers press outwards from inside a hole",
                count);
        // turning ALL normals round never changes force closure, turning some of them does
        if (many == 0 || can_squeeze(contacts_)) return;
        Contacts turned = contacts_;
        std::string which;
        std::vector<double> positions = contacts_.positions, normals = contacts_.normals;
        for (int i = 0; i < count; ++i) {
            if (!away(i)) continue;
            which += (which.empty() ? "" : ", ") + std::to_string(i);
            for (int a = 0; a < 3; ++a) normals[3 * i + a] *= -1.0;
        }
        if (turned.place(positions.data(), normals.data()) == Placing::good && can_squeeze(turned))
            say(false,
                "the normals of contacts [%s] point away from the centre of the contacts, and the fingers cannot squeeze the "
                "object; with these normals turned round they could: normals must point INTO the object",
                which.c_str());
    }
    std::pair<int, double> roughest() const {  // the contact of the largest friction coefficient
        std::pair<int, double> worst{0, 0.0};
        for (int i = 0; i < contacts_.count; ++i)
            for (int a = 1; a < 3; ++a) {
                const double* scale = &contacts_.scale[3 * i];
                if (scale[a] > 0.0 && scale[0] / scale[a] > worst.second) worst = {i, scale[0] / scale[a]};
            }
        return worst;
    }
    void units() {
        const double length = contacts_.unit.length;
        if (length > LONGEST)
            say(true,
                "the contacts lie %.3g m from their centre (root mean square): positions are in metres; divide millimetres by "
                "1000",
                length);
        if (const auto [worst, friction] = roughest(); friction > ROUGHEST)
            say(friction > DEGREES,
                "friction is %.3g at contact %d: rubber reaches 1 to 2; give the coefficient, tan(friction angle), not an "
                "angle in degrees",
                friction, worst);
        const auto widest = std::max_element(contacts_.torsion.begin(), contacts_.torsion.end());
        if (widest != contacts_.torsion.end() && *widest > WIDEST_PATCH)
            say(false, "torsional_friction is %.3g m at contact %d: a fingertip has about 0.005 m; divide millimetres by 1000",
                *widest, int(widest - contacts_.torsion.begin()));
    }
    int joints() const { return int(limits_.torque_limit.size()); }
    // Rows of the Jacobian for each contact: 3, or 6 with angular velocities.
    int rows() const { return int(limits_.jacobian.size()) / std::max(1, joints() * contacts_.count); }
    double longest_lever() const {  // [m] largest velocity of a contact for one radian per second
        double longest = 0.0;
        const int joints = this->joints(), rows = this->rows();
        for (int k = 0; k < contacts_.count * rows; ++k)
            for (int j = 0; j < joints && k % rows < 3; ++j)
                longest = std::max(longest, std::abs(limits_.jacobian[joints * k + j]));
        return longest;
    }
    void jacobian() {
        if (const double lever = longest_lever(); lever > LONGEST)
            say(true,
                "the Jacobian's largest entry is %.3g m: a joint that far from its contact would be larger than a robot; "
                "lengths are in metres, divide the linear rows by 1000 if they are in millimetres",
                lever);
    }
    Point force() const { return point(wrench_.data()); }
    Point moment() const { return point(wrench_.data() + 3); }
    double distance() const { return length(contacts_.unit.centre); }
    double moment_at_contacts() const {  // [N m] about the centre of the contacts
        return wrench_.size() == 6 ? length(moment() - cross(contacts_.unit.centre, force())) : 0.0;
    }
    // The force acts near the origin, which is far from the contacts.
    bool elsewhere(double lengths, double least) const {
        const double size = contacts_.unit.length, force = length(this->force());
        return distance() > lengths * size && distance() > least && length(moment()) < SHORT_LEVER * size * force &&
               moment_at_contacts() > FAR * size * force;
    }
    void origin() {
        if (!elsewhere(FAR, 0.0)) return;
        say(elsewhere(VERY_FAR, ARM),
            "the contacts are %.3g m from the origin, but the wrench's force acts within %.2g m of it: is its moment about "
            "another point (the centre of mass)? Give both in one frame, the moment about the origin of the positions (in "
            "Python wrench_about shifts it), unless the object reaches that far",
            distance(), std::max(1e-3, length(moment()) / length(force())));
    }
    // Force and moment make sense only if they change places.
    bool exchanged() const {
        const double force = length(this->force()), moment = length(this->moment()), reach = contacts_.unit.length + distance();
        return force > 0.0 && moment_at_contacts() > LONG_LEVER * reach * force && force < SHORT_LEVER * reach * moment &&
               moment > TURNING * contacts_.unit.length;
    }
    void swapped() {
        const double moment = moment_at_contacts(), force = length(this->force());
        if (exchanged())
            say(true,
                "the wrench's moment of %.3g N m is that of its force of %.3g N at %.2g m from contacts that span %.2g m: a "
                "wrench is force [N] first, then moment [N m]; exchange them, or divide the moment by 1000 if it is in N mm",
                moment, force, moment / force, contacts_.unit.length);
        else if (force == 0.0 && moment > PURE_MOMENT * contacts_.unit.length)
            say(false,
                "the wrench is a moment of %.3g N m without a force, on contacts that span %.2g m: a wrench is force [N] "
                "first, then moment [N m]; exchange them, unless the fingers turn something",
                moment, contacts_.unit.length);
    }
    // Torque limits against J^T f of the force that the load needs without them.
    void torques() {
        const int joints = this->joints(), rows = this->rows();
        if (joints == 0 || length(force()) + moment_at_contacts() / contacts_.unit.length < SMALLEST_LOAD) return;
        ForceOptimizer solver({contacts_});
        const Record& found = solver.solve(wrench_.first<6>());
        if (!found.has_force()) return;
        std::vector<double> torque(joints, 0.0);
        for (int i = 0; i < contacts_.count; ++i) {
            double pushed[6] = {};
            found.object_force(i, pushed);
            for (int a = 0; a < 3; ++a) pushed[3 + a] = found.torsion()[i] * contacts_.normals[3 * i + a];
            for (int r = 0; r < rows; ++r)
                for (int j = 0; j < joints; ++j) torque[j] += pushed[r] * limits_.jacobian[joints * (rows * i + r) + j];
        }
        double least = infinity;  // the weakest joint's limit over its torque
        int weakest = 0;
        for (int j = 0; j < joints; ++j) {
            const double share = limits_.torque_limit[j] / std::abs(torque[j]);
            if (share < least) least = share, weakest = j;
        }
        const double limit = limits_.torque_limit[weakest], needed = std::abs(torque[weakest]);
        if (least > STRONGEST && least < infinity)
            say(false,
                "every torque limit is more than 500 times what this load needs (joint %d: %.3g of %.3g N m): limits are in N "
                "m; divide mN m by 1000",
                weakest, needed, limit);
        else if (least < WEAKEST)
            say(false,
                "this load needs %.2g times the torque limit of joint %d (%.3g of %.3g N m): limits are in N m, and the "
                "Jacobian's linear rows in metres",
                1.0 / least, weakest, needed, limit);
    }
};

}  // namespace detail

// Likely mistakes in contacts, their limits and the wrench (6,) if one is given; empty if there are none. Numbers as in `Problem`. Allocates:
// for setting up, not for a loop.
inline std::vector<Advice> advise(const Contacts& contacts, const ForceLimits& limits = {}, Doubles wrench = {}) {
    return detail::Adviser(contacts, limits, wrench).all();
}
// True if some of that advice is near certain. Takes a fraction of a microsecond and does not allocate.
inline bool looks_wrong(const Contacts& contacts, const ForceLimits& limits = {}, Doubles wrench = {}) {
    return detail::Adviser(contacts, limits, wrench).near_certain();
}

}  // namespace grasp
