/* Calls a C solver on the problems of a session and times each call; see force.h. */
#include <string.h>
#include <time.h>

#include "force.h"

static double seconds_now(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* The first pass fills forces (M, size), multipliers (M, prices), statuses and iterations (M,); seconds (M,): the least of all passes.
   warm: each call but the first gets the last force. setup: null, or called and timed before every solve. */
void force_times(force_solve *solve, void *context, force_setup *setup, force_close *close, const char *objective,
                 const force_problem *problems, int count, int passes, int warm, double *forces, double *multipliers, int *statuses,
                 int *iterations, double *seconds) {
    for (int pass = 0; pass < passes; ++pass) {
        double *before = 0;
        for (int m = 0; m < count; ++m) {
            const force_problem *p = problems + m;
            const int size = p->contacts * p->width, prices = 6 + p->limits;
            double *force = forces + m * size;
            double begin = seconds_now();
            void *used = setup ? setup(p, objective) : context;
            const int failed = setup && !used;
            const int status = failed ? 1 : solve(used, p, warm ? before : 0, force, multipliers + m * prices, iterations + m);
            const double taken = seconds_now() - begin;
            if (setup && close && used) close(used);
            if (pass == 0 || taken < seconds[m]) seconds[m] = taken;
            statuses[m] = status;
            before = status == 0 ? force : 0;
        }
    }
}
