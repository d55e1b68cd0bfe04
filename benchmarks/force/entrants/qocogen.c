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

/* torsion of a unit of v, [m] */
static double lever(const force_problem* p, int i) {
  return p->torsional_friction[i] / p->friction[i];
}

/* Dual._rows */
static double dual_number(const force_problem* p, int row, int column) {
  int k = p->width, i = (row - p->limits) / k, of = (row - p->limits) % k;
  if (row < p->limits) return row == column - 6 ? -1.0 : 0.0;
  double scale = of == 0 ? 1.0 / p->friction[i] : of == 3 ? lever(p, i) : 1.0;
  if (column < 6) return scale * balance(p, column, k * i + of);
  return -scale * limit(p, column - 6, k * i + of);
}

/* A number of Primal._rows in a row of balance or of limits, with v in place of torsion. */
static double primal_scaled(const force_problem* p, double number, int column) {
  return p->width == 4 && column % 4 == 3 ? number * lever(p, column / 4) : number;
}

/* Primal._rows below the equations */
static double primal_number(const force_problem* p, int row, int column) {
  int k = p->width;
  if (row < p->limits) return primal_scaled(p, limit(p, row, column), column);
  return column % k == 0 ? -p->friction[column / k] : -1.0;
}

static void refresh(Context* at, const force_problem* p) {
  Workspace* work = &at->work;
  const Description* generated = &at->generated;
  int n = p->contacts, k = p->width, form = generated->form;
  for (int j = 0; j < generated->count_a; ++j) {
    int row = generated->rows_a[j], column = generated->columns_a[j];
    double number = balance(p, row, column);
    if (form == PRIMAL) number = primal_scaled(p, number, column);
    if (form == BARRIER && column % 3 == 0) number /= p->friction[column / 3];
    work->A[j] = number;
  }
  for (int j = 0; form != BARRIER && j < generated->count_g; ++j) /* the barrier's are constants */
    work->G[j] = (form == DUAL ? dual_number : primal_number)(p, generated->rows_g[j],
                                                              generated->columns_g[j]);
  for (int i = 0; form == DUAL && i < n; ++i) work->h[work->l + k * i] = 1.0 / p->friction[i];
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
    const double* from = (form == DUAL ? z + work->l : x) + k * i;
    int on = touches(p, i);
    force[0] = on ? unit * from[0] / (form == PRIMAL ? 1.0 : p->friction[i]) : 0.0;
    force[1] = on ? unit * from[1] : 0.0;
    force[2] = on ? unit * from[2] : 0.0;
    if (k == 4) force[3] = on ? unit * lever(p, i) * from[3] : 0.0;
  }
  for (int j = 0; j < 6; ++j) multipliers[j] = form == DUAL ? x[j] : -work->sol.y[j];
  for (int j = 0; j < limits; ++j) multipliers[6 + j] = form == DUAL ? x[6 + j] : z[j];
  if (iterations) *iterations = steps;
  return work->sol.status == QOCO_CUSTOM_SOLVED ? 0 : 1;
}
