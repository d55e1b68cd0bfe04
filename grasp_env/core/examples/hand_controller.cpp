// Runs the controller of `hand_controller.hpp` for a hand in another process: `hand_controller FD
// HAND_FILE RATE FRICTION` answers messages over an inherited socket (AF_UNIX, SOCK_SEQPACKET)
// until it is closed. Each message is a row of doubles. In: number, state. Out: number of the
// newest state, messages received, updates, duration of this update [s], late, over_budget, status;
// commands; torques.
#include "hand_controller.hpp"

#include <cstdio>
#include <poll.h>
#include <sys/socket.h>

int main(int count, char** arguments) try {
  if (count != 5)
    return std::fprintf(stderr, "usage: hand_controller FD HAND_FILE RATE FRICTION\n"), 2;
  const int channel = std::atoi(arguments[1]);
  const auto hand = grasp::TreeFile::load(arguments[2]);
  const double rate = std::atof(arguments[3]);
  const double friction = std::atof(arguments[4]);
  Calibration calibration;  // whole numbers from -240 to 240
  for (const grasp::Link& link : hand->links) {
    calibration.torques.push_back({-link.torque_limit, link.torque_limit});
    calibration.units.push_back({-240.0, 240.0});
  }
  HandController controller;
  controller.configure(hand, {.friction = friction, .rate = rate}, calibration);

  HandState state(hand->joints(), hand->fingers());
  std::size_t numbers = 1;
  for (auto part : PARTS) numbers += (state.*part).size();
  Numbers in(numbers);
  Numbers out;
  pollfd ready{channel, POLLIN, 0};
  const timespec patience{0, long(1.5e9 / rate)};  // the controller updates without a message, too
  double heard = 0.0, updates = 0.0, measured = 0.0, last = 0.0;
  while (true) {
    ppoll(&ready, 1, heard ? &patience : nullptr, nullptr);
    bool fresh = false;
    ssize_t got;
    while ((got = recv(channel, in.data(), numbers * sizeof(double), MSG_DONTWAIT)) > 0) {
      fresh = true;
      ++heard;
    }  // only the newest is used
    if (got == 0) return 0;  // the other side has closed the socket
    const double now =
        std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
    if (fresh) {
      auto from = in.begin() + 1;
      for (auto part : PARTS)
        for (double& value : state.*part) value = *from++;
      measured = now - state.age[0];
    }
    if (controller.status == HandController::inactive) {
      controller.activate(state);
      last = now - 1.0 / rate;
    }
    state.age[0] = now - measured;
    controller.update(state, now - last);
    last = now;
    ++updates;
    out = {in[0],
           heard,
           updates,
           controller.duration,
           double(controller.late),
           double(controller.over_budget),
           double(controller.status)};
    out.insert(out.end(), controller.commands.begin(), controller.commands.end());
    out.insert(out.end(), controller.torques.begin(), controller.torques.end());
    send(channel, out.data(), out.size() * sizeof(double), MSG_DONTWAIT | MSG_NOSIGNAL);
  }
} catch (const std::exception& error) {
  return std::fprintf(stderr, "%s\n", error.what()), 2;
}
