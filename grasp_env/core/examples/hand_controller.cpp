// Runs the controller of `hand_controller.hpp` for a hand in another process: `hand_controller FD HAND_FILE RATE` answers messages over an
// inherited socket (AF_UNIX, SOCK_SEQPACKET) until it is closed. A message is a row of doubles. In: its number and a state. Out: number of
// the newest state, how many were heard, seconds of the update, late, over_budget, status; commands and torques.
#include "hand_controller.hpp"

#include <cstdio>
#include <sys/socket.h>
#include <sys/time.h>

int main(int given, char** arguments) try {
    if (given != 4) return std::fprintf(stderr, "usage: hand_controller FD HAND_FILE RATE\n"), 2;
    const int channel = std::atoi(arguments[1]);
    const auto hand = grasp::TreeFile::load(arguments[2]);
    const double rate = std::atof(arguments[3]);
    Calibration calibration;  // of an Allegro: whole numbers of at most 240
    for (const grasp::Link& link : hand->links)
        calibration.torques.push_back({-link.torque_limit, link.torque_limit}), calibration.units.push_back({-240, 240});
    HandController controller;
    controller.configure(hand, {.rate = rate}, calibration);

    HandState state(hand->joints(), hand->fingers());
    const std::size_t joints = hand->joints(), size = 2 * joints + 7 * hand->fingers() + 10;
    Numbers in(1 + size), out(6 + 2 * joints);
    const timeval patience{0, suseconds_t(1.5e6 / rate)};  // without a message there is an update all the same
    setsockopt(channel, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    using Clock = std::chrono::steady_clock;
    Clock::time_point last, measured;
    for (double heard = 0.0;;) {
        ssize_t got = recv(channel, in.data(), in.size() * sizeof(double), 0);
        const bool fresh = got > 0;
        for (; got > 0; ++heard) got = recv(channel, in.data(), in.size() * sizeof(double), MSG_DONTWAIT);  // the newest counts
        if (got == 0) return 0;  // closed
        const Clock::time_point now = Clock::now();
        if (fresh) {
            auto from = in.begin() + 1;
            for (auto part : PARTS)
                for (double& value : state.*part) value = *from++;
            measured = now - std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(state.age[0]));
            if (heard ...) 
        }
    }
} catch (const std::exception& error) { return std::fprintf(stderr, "%s\n", error.what()), 2; }
