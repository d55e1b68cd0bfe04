/* A grasp-force solver as a C function. All arrays are row-major doubles in SI units, in the
   object's frame; a pointer is null where a problem has no such thing. See problems.py for what
   they mean. The first problem lives until the context is closed, any other one until the call
   returns; start may be the array in which the last force was written. */
#ifndef FORCE_H
#define FORCE_H
#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
  int contacts, width, joints, limits; /* N; k = 3, 4 with torsion; J; L */
  int moved; /* 0: contacts, friction and limits are those of the session's first problem */
  unsigned long long touching;              /* bit i: contact i touches */
  const double* positions;                  /* (N, 3) */
  const double* frames;                     /* (N, 3, 3), columns n, o, t */
  const double* normals;                    /* (N, 3) */
  const double* friction;                   /* (N,) */
  const double* torsional_friction;         /* (N,) m; 0: no torsion */
  const double *min_normal, *max_normal;    /* (N,) */
  const double* jacobian;                   /* (N, 6, J) */
  const double *torque_limit, *torque_bias; /* (J,) */
  const double* wrench;                     /* (6,) */
  const double* matrix;                     /* G (6, N k); balance is G f + w = 0 */
  const double* limit_matrix;               /* B (L, N k) */
  const double* limit_bound;                /* b (L,); B f <= b */
  const double* friction_margin;            /* (1,); null, as preload, where the harness shifts */
  const double* preload;                    /* (N,) */
} force_problem;

/* Returns 0: solved, 1: failed, 2: infeasible. start: null, or the last force (N k). force (N k)
   and multipliers (6 + L) are written; multipliers and iterations may be left alone, and iterations
   may be null. */
typedef int force_solve(void* context, const force_problem* problem, const double* start,
                        double* force, double* multipliers, int* iterations);
/* Prepares for the problems of a session and returns the context; null: such problems are not
 * entered. objective: "sum" or "phi". */
typedef void* force_setup(const force_problem* first, const char* objective);
typedef void force_close(void* context);

#ifdef __cplusplus
}
#endif
#endif
