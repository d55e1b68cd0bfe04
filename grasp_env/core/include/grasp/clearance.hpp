// How far a hand's links are from an object and from one another; links are capsules here.
#pragma once
#include "surface.hpp"
#include "tree.hpp"

namespace grasp {

struct Segment {
    Point start, end;  // [m]

    Point at(double part) const { return start + part * (end - start); }
};

// The least distance of two segments [m] (Ericson 2005, 5.1.9).
inline double gap(const Segment& a, const Segment& b) {
    constexpr double PARALLEL = 1e-12;  // of the squared sine between them
    const auto within = [](double part) { return std::min(std::max(part, 0.0), 1.0); };
    const Point u = a.end - a.start, v = b.end - b.start, r = a.start - b.start;
    const double uu = dot(u, u), vv = dot(v, v), uv = dot(u, v), ur = dot(u, r), vr = dot(v, r);
    double s = 0.0, t = 0.0;
    if (uu > 0.0) {
        if (const double across = uu * vv - uv * uv; across > PARALLEL * uu * vv) s = within((uv * vr - ur * vv) / across);
        t = vv > 0.0 ? (uv * s + vr) / vv : -1.0;
        if (t < 0.0 || t > 1.0) t = within(t), s = within((t * uv - ur) / uu);
    } else if (vv > 0.0) {
        t = within(vr / vv);
    }
    return length(r + s * u - t * v);
}

// The least signed distance of a segment from a convex surface [m], by golden sections; stops where it is surely `enough`.
inline double gap(const Surface& surface, const Segment& a, double enough = infinity) {
    constexpr double GOLDEN = 0.6180339887498949;
    constexpr int SECTIONS = 14;  // leave a thousandth of the segment
    const auto at = [&](double part) { return surface.nearest(a.at(part)).distance; };
    const double size = length(a.end - a.start);
    double low = 0.0, high = 1.0, left = 1.0 - GOLDEN, right = GOLDEN, at_left = at(left), at_right = at(right);
    // no point of the bracket is further from one of the two than the bracket is long
    for (int k = 1; k < SECTIONS && size > 0.0 && !(std::min(at_left, at_right) - (high - low) * size > enough); ++k) {
        if (at_left < at_right) {
            high = right, right = left, at_right = at_left;
            at_left = at(left = high - GOLDEN * (high - low));
        } else {
            low = left, left = right, at_left = at_right;
            at_right = at(right = low + GOLDEN * (high - low));
        }
    }
    return std::min(at_left, at_right);
}

// A capsule that is fixed to a link.
struct Limb {
    int link;       // -1: the palm
    Segment axis;   // [m], link frame
    double radius;  // [m]
    bool tip;       // a fingertip's own sphere, which is there to touch

    Segment at(const Posture& posture) const { return {posture.at(link, axis.start), posture.at(link, axis.end)}; }
};

}  // namespace grasp
