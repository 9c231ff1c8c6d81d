/* NAME: a model predictive controller in C99, written by jaxmpc VERSION.
 *
 * Each call runs a fixed number of ADMM steps: no memory is allocated, no loop depends on data.
 * One NAME_memory per controlled system, NAME_reset before the first call.
 *
 * u is finite and within its limits (if these are a box) for whatever x and memory hold. After
 * NON_FINITE and OVERFLOW u is the last input where its rate is limited or weighed, else zero,
 * within the limits, and the next call begins cold: one bad reading is forgotten after one sample.
 */
#ifndef NAME_H
#define NAME_H

#ifdef __cplusplus
extern "C" {
#endif

#include "NAME_sizes.h"

enum {
  NAME_SOLVED = 1,      /* both residuals are below NAME_TOLERANCE */
  NAME_NOT_SOLVED = 2,  /* they are not: infeasible, or too few ADMM steps */
  NAME_NON_FINITE = 3,  /* x or the references hold NaN or infinity */
  NAME_OVERFLOW = 4     /* the numbers became too large on the way */
};

typedef struct {
  NAME_real z[NAME_VARIABLES];      /* free moves of the last plan */
  NAME_real y[NAME_ROWS + 1];       /* multipliers of the last plan */
  NAME_real theta[NAME_PARAMETERS]; /* state, and previous input where input rates count */
  NAME_real u[NAME_INPUTS];         /* last input */
  int warm;                         /* 0: begin without the last plan */
} NAME_memory;

typedef struct {
  int status;
  /* Largest entry of |Cz - s|, s the nearest point that keeps the limits, and of |Pz + q + C'y|,
   * each relative to the largest of its terms and its row_size or variable_size in the tables. */
  NAME_real primal_residual, dual_residual;
} NAME_info;

void NAME_reset(NAME_memory *memory);

/* First input u of the plan from state x, in the units of the problem.
 *
 * state_reference, input_reference: what to track over the whole horizon; NULL for zero.
 * info: NULL, or where to write how well the plan was solved. Returns the status. */
int NAME_step(NAME_memory *memory, const NAME_real x[NAME_STATES],
              const NAME_real *state_reference, const NAME_real *input_reference,
              NAME_real u[NAME_INPUTS], NAME_info *info);

#ifdef __cplusplus
}
#endif

#endif
