/* Calls a C solver on the problems of a session and times each call; see force.h. */
#include <time.h>

#include "force.h"

static double seconds_now(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* A pass over the problems of a session, after an untimed call of the last one, which fills the
   caches and the branch predictor. Fills forces (M, size), multipliers (M, 6 + L), statuses,
   iterations and seconds (M,). warm: each call but the first gets the last force. setup: null, or
   called and timed before every solve. */
void force_times(force_solve* solve, void* context, force_setup* setup, force_close* close,
                 const char* objective, const force_problem* problems, int count, int warm,
                 double* forces, double* multipliers, int* statuses, int* iterations,
                 double* seconds) {
  double* before = 0;
  for (int m = -1; m < count; ++m) {
    const int k = m < 0 ? count - 1 : m;
    const force_problem* p = problems + k;
    double* force = forces + k * p->contacts * p->width;
    const double begin = seconds_now();
    void* used = setup ? setup(p, objective) : context;
    const int failed = setup && !used;
    const int status = failed ? 1
                              : solve(used, p, warm ? before : 0, force,
                                      multipliers + k * (6 + p->limits), iterations + k);
    seconds[k] = seconds_now() - begin;
    if (setup && close && used) close(used);
    statuses[k] = status;
    before = m >= 0 && status == 0 ? force : 0;
  }
}
