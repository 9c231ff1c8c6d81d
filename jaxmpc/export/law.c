/* NAME: the search tree; see NAME.h. Written by jaxmpc VERSION. */
#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__) || \
    defined(_M_FP_FAST)
#error "Compile without -ffast-math: it takes the tests for NaN and infinity out"
#endif

#include "NAME.h"

#include <math.h>

typedef NAME_real real;

#include "NAME_tables.h"

enum { P = NAME_PARAMETERS, M = NAME_INPUTS };

/* How far half-space i is exceeded. z = x - centre, as offsets are those about the centre. */
static real beyond(int i, const real *z) {
  real sum = -plane_offset[i];
  for (int k = 0; k < P; k++) sum += plane_normal[i * P + k] * z[k];
  return sum;
}

static void clip(const real *x, real *u) {
  for (int i = 0; i < M; i++) {
#if NAME_RATES /* x ends with the inputs before */
    real before = isfinite(x[P - M + i]) ? x[P - M + i] : 0;
    if (!isfinite(u[i])) u[i] = before;
    if (u[i] < before + rate_lower[i]) u[i] = before + rate_lower[i];
    if (u[i] > before + rate_upper[i]) u[i] = before + rate_upper[i];
#else
    (void)x;
#endif
    if (!isfinite(u[i])) u[i] = 0;
    if (u[i] < input_lower[i]) u[i] = input_lower[i];
    if (u[i] > input_upper[i]) u[i] = input_upper[i];
  }
}

int NAME_evaluate(const real x[NAME_PARAMETERS], real u[NAME_INPUTS]) {
  real z[P];
  for (int i = 0; i < M; i++) u[i] = NAN;
  for (int k = 0; k < P; k++) {
    z[k] = x[k] - centre[k];
    if (!isfinite(x[k])) {
      clip(x, u);
      return NAME_NON_FINITE;
    }
  }
  /* Nodes to visit. So near a half-space that rounding may decide x goes to both sides, where the
   * signs of several that meet need not fit each other. */
  int waiting[NAME_DEPTH + 1] = {0}, count = 1, best = 0;
  real least = (real)INFINITY;
  while (count > 0 && !(least <= 0)) {
    int node = waiting[--count];
    if (node_plane[node] >= 0) {
      real over = beyond(node_plane[node], z);
      if (!(over <= (real)-NAME_NEAR)) waiting[count++] = node_outside[node];
      if (!(over >= (real)NAME_NEAR)) waiting[count++] = node_inside[node];
      continue;
    }
    /* A leaf: node_inside is its first region in leaf_region, node_outside how many. */
    for (int j = 0; j < node_outside[node]; j++) {
      int region = leaf_region[node_inside[node] + j];
      real worst = (real)-INFINITY;
      for (int f = facet_begin[region]; f < facet_begin[region + 1]; f++) {
        real over = (real)facet_side[f] * beyond(facet_plane[f], z);
        if (!(over <= worst)) worst = isfinite(over) ? over : (real)INFINITY;
      }
      if (worst < least) least = worst, best = region;
    }
  }
  for (int i = 0; i < M; i++) {
    u[i] = law_offset[best * M + i];
    for (int k = 0; k < P; k++) u[i] += law_gain[(best * P + k) * M + i] * z[k];
  }
  int finite = 1;
  for (int i = 0; i < M; i++) finite = finite && isfinite(u[i]);
  clip(x, u);
  return finite && least <= NAME_TOLERANCE ? NAME_INSIDE : NAME_OUTSIDE;
}
