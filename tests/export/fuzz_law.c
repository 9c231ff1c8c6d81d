/* Calls law_evaluate with states that nobody would send, and prints, one line each, how often what
 * must not happen happened. Usage: fuzz CALLS SEED
 *
 * "Inside" is computed again in long double: some region holds the state, and u is its law. */
#include "law.c"

#include "fuzz.h"

static int is_inside(const real *x, const real *u) {
  wide rounding = (sizeof(real) == 4 ? 1e-6L : 1e-14L);
  for (int region = 0; region < law_REGIONS; region++) {
    int inside = 1, same = 1;
    for (int f = facet_begin[region]; f < facet_begin[region + 1]; f++) {
      wide sum = -(wide)plane_offset[facet_plane[f]], terms = fabsl(sum);
      for (int k = 0; k < P; k++) {
        wide term = (wide)plane_normal[facet_plane[f] * P + k] * x[k];
        sum += term, terms += fabsl(term);
      }
      inside = inside && facet_side[f] * sum <= law_TOLERANCE + 4 * rounding * terms;
    }
    for (int i = 0; i < M; i++) {
      wide value = law_offset[region * M + i], terms = fabsl(value);
      for (int k = 0; k < P; k++) {
        wide term = (wide)law_gain[(region * P + k) * M + i] * x[k];
        value += term, terms += fabsl(term);
      }
      value = value < input_lower[i] ? input_lower[i] : value > input_upper[i] ? input_upper[i] : value;
      same = same && fabsl(value - u[i]) <= 4 * rounding * (1 + terms);
    }
    if (inside && same) return 1;
  }
  return 0;
}

int main(int count, char **arguments) {
  long calls = count > 1 ? atol(arguments[1]) : 1000, statuses[4] = {0};
  long not_finite = 0, beyond_limits = 0, strange = 0, lies = 0;
  real x[P], u[M];
  state = 88172645463325252u + (uint64_t)(count > 2 ? atol(arguments[2]) : 0);
  for (long k = 0; k < calls; k++) {
    int bad = bits() % 4 == 0;
    for (int i = 0; i < P; i++) x[i] = bad ? wild() : (real)uniform(-2, 2);
    int status = law_evaluate(x, u);
    for (int i = 0; i < M; i++) {
      not_finite += !isfinite(u[i]);
      beyond_limits += u[i] < input_lower[i] || u[i] > input_upper[i];
    }
    strange += status < 1 || status > 3;
    statuses[status >= 1 && status <= 3 ? status : 0]++;
    if (status == law_INSIDE) lies += !is_inside(x, u);
  }
  printf("not finite %ld\nbeyond limits %ld\nstrange status %ld\nnot inside %ld\n", not_finite,
         beyond_limits, strange, lies);
  printf("statuses %ld %ld %ld\n", statuses[1], statuses[2], statuses[3]);
  return 0;
}
