// Runs `grasp::HandController` for a hand in another process: `hand_controller FD HAND_FILE RATE
// FRICTION MARGIN PRELOAD` answers messages over an inherited socket (AF_UNIX, SOCK_SEQPACKET)
// until it is closed. Each message is a row of doubles. In: number, `HandState::numbers()`. Out:
// number of the newest state, messages received, updates, duration of this update [s], late,
// over_budget, status; commands; torques.
#include <grasp/hand/hand_controller.hpp>
#include <grasp/hand/tree_file.hpp>

#include <cstdio>
#include <poll.h>
#include <sys/socket.h>

int main(int count, char** arguments) try {
  if (count != 7) {
    std::fprintf(stderr, "usage: hand_controller FD HAND_FILE RATE FRICTION MARGIN PRELOAD\n");
    return 2;
  }
  const int channel = std::atoi(arguments[1]);
  const auto hand = grasp::TreeFile::load(arguments[2]);
  grasp::HandControllerSettings settings;
  settings.rate = std::atof(arguments[3]);
  settings.friction = std::atof(arguments[4]);
  settings.friction_margin = std::atof(arguments[5]);
  settings.preload = std::atof(arguments[6]);
  grasp::Calibration calibration;  // whole numbers from -240 to 240
  for (const grasp::Link& link : hand->links) {
    calibration.torques.push_back({-link.torque_limit, link.torque_limit});
    calibration.units.push_back({-240.0, 240.0});
  }

  grasp::HandState state(hand->joints(), hand->fingers());
  std::vector<double> in(1 + state.numbers().size());
  std::vector<double> next(in), out;
  const std::size_t size = in.size() * sizeof(double);
  // the posture of the first message is the one in which gains are computed; it stays in the queue
  if (recv(channel, in.data(), size, MSG_PEEK | MSG_TRUNC) != ssize_t(size)) {
    std::fprintf(stderr, "the first message is not of this hand\n");
    return 2;
  }
  std::copy(in.begin() + 1, in.end(), state.numbers().begin());
  grasp::HandController controller;
  controller.configure(hand, settings, calibration, state[grasp::ANGLES]);

  pollfd ready{channel, POLLIN, 0};
  // the controller updates without a message, too
  const double wait = 1.5 / settings.rate;
  const timespec patience{time_t(wait), long(1e9 * (wait - std::floor(wait)))};
  double heard = 0.0, updates = 0.0, last = 0.0;
  while (true) {
    ppoll(&ready, 1, &patience, nullptr);
    bool fresh = false;
    ssize_t got;
    while ((got = recv(channel, next.data(), size, MSG_DONTWAIT | MSG_TRUNC)) > 0) {
      if (got != ssize_t(size)) continue;  // of another hand
      in.swap(next);
      fresh = true;
      ++heard;
    }  // only the newest is used
    if (got == 0) return 0;  // the other side has closed the socket
    const double now =
        std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
    if (fresh)
      std::copy(in.begin() + 1, in.end(), state.numbers().begin());
    else
      for (double& age : state[grasp::AGES]) age += now - last;
    if (controller.status == grasp::HandController::inactive) {
      controller.activate(state);
      last = now - 1.0 / settings.rate;
    }
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
  std::fprintf(stderr, "%s\n", error.what());
  return 2;
}
