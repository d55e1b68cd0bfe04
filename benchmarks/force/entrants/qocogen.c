/* A generated QOCOGEN solver of one of the forms in forms.py as the C functions of force.h. */
#include <math.h>
#include <stdlib.h>

#include "force.h"
#include "qoco_custom.h"

enum { DUAL, PRIMAL, BARRIER };

/* The generated code: rows and columns of the numbers of A and G in their order, and settings. */
typedef struct {
  int form, refinements, count_a, count_g;
  const int *columns_a, *rows_a, *columns_g, *rows_g;
  double size;
} Description;

typedef struct {
  Workspace work;
  Description generated;
  int moved;
} Context;

static Description described;

void qocogen_describe(const Description* generated) { described = *generated; }

static int touches(const force_problem* p, int i) {
  return p->contacts > 64 || p->touching >> i & 1;
}

static double limit(const force_problem* p, int row, int column) {
  return p->limit_matrix[row * p->contacts * p->width + column];
}
static double balance(const force_problem* p, int row, int column) {
  return p->matrix[row * p->contacts * p->width + column];
}

/* Dual._rows */
static double dual_number(const force_problem* p, int row, int column) {
  int n = p->contacts, k = p->width, soft = k == 4 ? 2 * n : 0, begin = soft + p->limits;
  int i = row < soft ? row % n : (row - begin) / 3, of = row < soft ? 3 : (row - begin) % 3;
  if (row >= soft && row < begin) return row - soft == column - 6 ? -1.0 : 0.0;
  double scale = row < n && soft ? -p->torsional_friction[i]
                 : row < soft    ? p->torsional_friction[i]
                 : of == 0       ? 1.0 / p->friction[i]
                                 : 1.0;
  if (column < 6) return scale * balance(p, column, k * i + of);
  if (column < 6 + p->limits) return -scale * limit(p, column - 6, k * i + of);
  return column - 6 - p->limits != i ? 0.0 : row < soft ? -1.0 : of == 0 ? scale : 0.0;
}

/* Primal._rows below the equations */
static double primal_number(const force_problem* p, int row, int column) {
  int n = p->contacts, k = p->width, soft = k == 4 ? 2 * n : 0, begin = p->limits + soft;
  if (row < p->limits) return limit(p, row, column);
  int i = row < begin ? (row - p->limits) / 2 : (row - begin) / 3, of = column - k * i;
  if (row < begin) return of == 0 ? -p->torsional_friction[i] : (row - p->limits) % 2 ? -1.0 : 1.0;
  return of == 0 ? -p->friction[i] : -1.0;
}

static void refresh(Context* at, const force_problem* p) {
  Workspace* work = &at->work;
  const Description* generated = &at->generated;
  int n = p->contacts, form = generated->form;
  for (int j = 0; j < generated->count_a; ++j) {
    int row = generated->rows_a[j], column = generated->columns_a[j];
    work->A[j] = balance(p, row, column) /
                 (form == BARRIER && column % 3 == 0 ? p->friction[column / 3] : 1.0);
  }
  for (int j = 0; form != BARRIER && j < generated->count_g; ++j) /* the barrier's are constants */
    work->G[j] = (form == DUAL ? dual_number : primal_number)(p, generated->rows_g[j],
                                                              generated->columns_g[j]);
  for (int i = 0; form == DUAL && i < n; ++i) work->h[work->l + 3 * i] = 1.0 / p->friction[i];
  at->moved = p->moved;
}

void* qocogen_setup(const force_problem* first, const char* objective) {
  Context* at = calloc(1, sizeof(Context));
  (void)objective;
  if (at) {
    at->generated = described;
    set_default_settings(&at->work);
    load_data(&at->work);
    at->work.settings.iter_ref_iters = described.refinements;
    refresh(at, first);
  }
  return at;
}

void qocogen_close(void* context) { free(context); }

int qocogen(void* context, const force_problem* p, const double* start, double* force,
            double* multipliers, int* iterations) {
  Context* at = context;
  Workspace* work = &at->work;
  int n = p->contacts, k = p->width, form = at->generated.form, limits = p->limits;
  double square = 0.0, unit = 1.0;
  (void)start;
  if (p->moved || at->moved) refresh(at, p);
  for (int j = 0; j < 6; ++j) square += p->wrench[j] * p->wrench[j];
  if (form != BARRIER && square > 0.0) unit = sqrt(square) / at->generated.size;
  for (int j = 0; j < 6; ++j)
    if (form == DUAL)
      work->c[j] = p->wrench[j] / unit;
    else
      work->b[j] = -p->wrench[j] / unit;
  for (int j = 0; j < limits; ++j)
    *(form == DUAL ? &work->c[6 + j] : &work->h[j]) = p->limit_bound[j] / unit;
  qoco_custom_solve(work);
  int steps = work->sol.iters;
  if (work->sol.status != QOCO_CUSTOM_SOLVED) {
    /* five bisections give up on steps below 1/32; always more would cost every solve */
    int few = work->settings.bisect_iters;
    work->settings.bisect_iters = 30;
    qoco_custom_solve(work);
    work->settings.bisect_iters = few;
    steps += work->sol.iters;
  }
  const double *x = work->sol.x, *z = work->sol.z;
  for (int i = 0; i < n; ++i, force += k) {
    const double* from = form == DUAL ? z + work->l + 3 * i : x + (form == PRIMAL ? k : 3) * i;
    int on = touches(p, i);
    force[0] = on ? unit * from[0] / (form == PRIMAL ? 1.0 : p->friction[i]) : 0.0;
    force[1] = on ? unit * from[1] : 0.0;
    force[2] = on ? unit * from[2] : 0.0;
    if (k == 4)
      force[3] =
          !on ? 0.0
              : unit * (form == DUAL ? p->torsional_friction[i] * (z[n + i] - z[i]) : from[3]);
  }
  for (int j = 0; j < 6; ++j) multipliers[j] = form == DUAL ? x[j] : -work->sol.y[j];
  for (int j = 0; j < limits; ++j) multipliers[6 + j] = form == DUAL ? x[6 + j] : z[j];
  if (iterations) *iterations = steps;
  return work->sol.status == QOCO_CUSTOM_SOLVED ? 0 : 1;
}
