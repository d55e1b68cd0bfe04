/* Calls a C solver on the problems of a session and times each call; see force.h. */
#define _GNU_SOURCE /* RUSAGE_THREAD */
#include <sys/resource.h>
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

/* How often the system has taken the processor away from this thread. */
static long switches_now(void) {
#ifdef RUSAGE_THREAD
  const int who = RUSAGE_THREAD;
#else
  const int who = RUSAGE_SELF;
#endif
  struct rusage used;
  getrusage(who, &used);
  return used.ru_nivcsw;
}

/* Passes over the problems of a session, one directly after another, each call timed, after an
   untimed call of the last problem. Fills seconds (passes, M), and interrupted (passes, M) with 1
   where the system took the processor away. force (size,) and multipliers (6 + L,) are overwritten
   by every call. */
void force_ticks(force_solve* solve, void* context, const force_problem* problems, int count,
                 int passes, double* force, double* multipliers, double* seconds,
                 unsigned char* interrupted) {
  int steps;
  solve(context, problems + count - 1, 0, force, multipliers, &steps);
  long before = switches_now();
  for (int pass = 0; pass < passes; ++pass)
    for (int m = 0; m < count; ++m) {
      const long place = (long)pass * count + m;
      const double begin = seconds_now();
      solve(context, problems + m, 0, force, multipliers, &steps);
      seconds[place] = seconds_now() - begin;
      const long after = switches_now();
      interrupted[place] = after != before;
      before = after;
    }
}

/* A `force_solve` that is busy for *context seconds and answers nothing. */
int force_busy(void* context, const force_problem* problem, const double* start, double* force,
               double* multipliers, int* iterations) {
  const double end = seconds_now() + *(const double*)context;
  (void)problem;
  (void)start;
  (void)force;
  (void)multipliers;
  (void)iterations;
  while (seconds_now() < end) continue;
  return 1;
}
