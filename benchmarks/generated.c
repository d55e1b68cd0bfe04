/* Our side of a generated QOCOGEN solver: data of a grasp in, forces (the multipliers z) out, and its clock. */
#include <stddef.h>
#include <time.h>

#include "qoco_custom.h"

size_t peer_size(void) { return sizeof(Workspace); }

void peer_setup(Workspace *work, double *matrix, double *bound, int refinements) {
    set_default_settings(work);
    load_data(work);
    update_G(work, matrix);
    update_h(work, bound);
    work->settings.iter_ref_iters = refinements;
}

int peer_solve(Workspace *work, double *wrench, double *force) {
    update_c(work, wrench);
    qoco_custom_solve(work);
    qoco_custom_copy_arrayf(work->sol.z, force, work->m);
    return work->sol.status == QOCO_CUSTOM_SOLVED;
}

static double seconds_now(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* best (count): the least seconds of `repeats` passes over wrenches (count, 6), after `warm_up` calls. */
void peer_times(Workspace *work, double *wrenches, int count, int repeats, int warm_up, double *force, double *best) {
    for (int k = 0; k < count && k < warm_up; ++k)
        peer_solve(work, wrenches + 6 * k, force);
    for (int pass = 0; pass < repeats; ++pass)
        for (int k = 0; k < count; ++k) {
            double begin = seconds_now();
            peer_solve(work, wrenches + 6 * k, force);
            double taken = seconds_now() - begin;
            if (pass == 0 || taken < best[k])
                best[k] = taken;
        }
}
