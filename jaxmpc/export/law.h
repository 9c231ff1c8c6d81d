/* NAME: an explicit model predictive control law in C99, written by jaxmpc VERSION.
 *
 * The first input of the optimal plan is piecewise affine in the state. A search tree of half-spaces
 * leads to the piece: at most NAME_DEPTH products, and the facets of at most NAME_MOST regions. (Of
 * states within NAME_NEAR of a half-space both sides are looked at.)
 */
#ifndef NAME_H
#define NAME_H

#ifdef __cplusplus
extern "C" {
#endif

#include "NAME_sizes.h"

enum {
  NAME_INSIDE = 1,     /* x has a plan that keeps the limits; u is its first input */
  NAME_OUTSIDE = 2,    /* it has none; u is the law of a region near by, clipped into the limits */
  NAME_NON_FINITE = 3  /* x holds NaN or infinity; u is the input before where its rate is limited,
                        * else zero, within the limits */
};

/* First input u of the plan from x, in the units of the problem, and its status. x: the state, then
 * the previous input where the problem limits or weighs input rates. */
int NAME_evaluate(const NAME_real x[NAME_PARAMETERS], NAME_real u[NAME_INPUTS]);

#ifdef __cplusplus
}
#endif

#endif
