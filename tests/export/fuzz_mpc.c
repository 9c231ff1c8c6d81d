/* Calls law_step with states, references and memory that nobody would send, and prints, one line
 * each, how often what must not happen happened. Usage: fuzz CALLS SEED
 *
 * What a status says is computed again in long double from the tables and from the plan in memory:
 * hard rows, balls, signs of multipliers, gradient. */
#include "law.c"

#include <stddef.h>

#include "fuzz.h"

static void sane(int count, real *v) {
  for (int i = 0; i < count; i++) v[i] = (real)uniform(-1, 1);
}

static wide apply(int rows, int row, int columns, const real *A, const real *v) {
  wide sum = 0;
  for (int j = 0; j < columns; j++) sum += (wide)A[j * rows + row] * v[j];
  return sum;
}

/* Whether the plan in memory is what SOLVED says. */
static int is_solved(const law_memory *m, const real *xr, const real *ur) {
  wide most = 1, worst = 0, most_dual = 1, dual = 0, tolerance = 1.05L * law_TOLERANCE;
  for (int i = 0; i < M; i++) {
    wide v = apply(M, i, NZ, C, m->z);
    most = v > most ? v : -v > most ? -v : most;
  }
#if law_BALLS
  for (int k = 0, first = M - law_BALL_ROWS; k < law_BALLS; first += ball_rows[k++]) {
    wide squared = 0, r = 0;
    for (int i = first; i < first + ball_rows[k]; i++) {
      wide off = apply(M, i, NZ, C, m->z) + shift_constant[i] + apply(M, i, NP, shift_theta, m->theta)
                 - lower[i];
      squared += off * off, r = (wide)radius[k] / E[i];
    }
    if (sqrtl(squared) - r > worst) worst = sqrtl(squared) - r;
  }
#endif
  for (int i = 0; i < M - law_BALL_ROWS; i++) {
    wide v = apply(M, i, NZ, C, m->z);
    wide offset = shift_constant[i] + apply(M, i, NP, shift_theta, m->theta);
    wide least = lower[i] - offset, top = upper[i] - offset;
    wide near = fmaxl(fabsl(isfinite(top) ? top : 0), fabsl(isfinite(least) ? least : 0));
    wide size = tolerance * (most > near ? most : near);
#if law_SOFT
    if (isfinite(soft_linear[i])) continue;
#endif
    if (v - top > worst) worst = v - top;
    if (least - v > worst) worst = least - v;
    if (m->y[i] > 0 && fabsl(v - top) > 2 * size) return 0;
    if (m->y[i] < 0 && fabsl(v - least) > 2 * size) return 0;
  }
  for (int i = 0; i < NZ; i++) {
    wide own = apply(NZ, i, NZ, P, m->z), pull = 0, q = q_constant[i];
    q += apply(NZ, i, NP, q_theta, m->theta);
    if (xr) q += apply(NZ, i, N, q_state, xr);
    if (ur) q += apply(NZ, i, MU, q_input, ur);
    for (int j = 0; j < M; j++) pull += (wide)C[i * M + j] * m->y[j];
    most_dual = fmaxl(fmaxl(most_dual, fabsl(own)), fmaxl(fabsl(q), fabsl(pull)));
    dual = fmaxl(dual, fabsl(own + q + pull));
  }
  return worst <= tolerance * most && dual <= tolerance * most_dual;
}

int main(int count, char **arguments) {
  long calls = count > 1 ? atol(arguments[1]) : 1000, statuses[6] = {0};
  long not_finite = 0, beyond = 0, strange = 0, lies = 0, worse = 0, better = 0, compared = 0;
  law_memory memory, cold;
  real x[N], xr[N], ur[MU], u[MU];
  law_info info;
  state = 88172645463325252u + (uint64_t)(count > 2 ? atol(arguments[2]) : 0);
  law_reset(&memory);
  for (long k = 0; k < calls; k++) {
    int bad = bits() % 4 == 0, garbage = bits() % 64 == 0, references = bits() % 4 == 0;
    sane(N, x), sane(N, xr), sane(MU, ur);
    if (bad)
      for (int i = 0; i < N; i++) x[i] = wild(), xr[i] = bits() % 2 ? wild() : xr[i];
    if (garbage) {
      uint64_t kind = bits() % 2, raw;
      real *v = (real *)&memory;
      for (size_t i = 0; i < offsetof(law_memory, warm) / sizeof(real); i++) v[i] = wild();
      raw = bits();
      memcpy(&memory.warm, &raw, kind ? sizeof memory.warm : 0);
    }
    int after_bad = k && !bad && !garbage;
    if (after_bad) { /* the same sample from no plan, with the same last input */
      law_reset(&cold);
      memcpy(cold.u, memory.u, sizeof cold.u);
    }
    real before[MU]; /* what the code takes for the last input */
    for (int i = 0; i < MU; i++) {
      real none = fmax(fmin((real)0, input_upper[i]), input_lower[i]);
      before[i] = isfinite(memory.u[i]) ? memory.u[i] : none;
    }
    const real *a = references ? xr : NULL, *b = references ? ur : NULL;
    int status = law_step(&memory, x, a, b, u, &info);
    for (int i = 0; i < MU; i++) {
      not_finite += !isfinite(u[i]);
      beyond += u[i] < input_lower[i] || u[i] > input_upper[i];
#if law_RATES
      real step = u[i] - before[i], ulp = 4 * (real)1e-7;
      if (before[i] + rate_upper[i] < input_lower[i] || before[i] + rate_lower[i] > input_upper[i])
        continue; /* no input keeps both limits */
      beyond += step < rate_lower[i] * (1 + ulp) || step > rate_upper[i] * (1 + ulp);
#endif
    }
    strange += status < 1 || status > 4 || status != info.status;
    statuses[status >= 1 && status <= 4 ? status : 0]++;
    if (status == law_SOLVED) lies += !is_solved(&memory, a, b);
    if (after_bad) {
      compared++;
      int cold_solved = law_step(&cold, x, a, b, u, NULL) == law_SOLVED;
      worse += cold_solved && status != law_SOLVED;
      better += status == law_SOLVED && !cold_solved;
    }
  }
  printf("not finite %ld\nbeyond limits %ld\nstrange status %ld\nnot solved %ld\n", not_finite, beyond,
         strange, lies);
  printf("worse than cold %ld\nbetter %ld\ncompared %ld\n", worse, better, compared);
  printf("statuses %ld %ld %ld %ld\n", statuses[1], statuses[2], statuses[3], statuses[4]);
  return 0;
}
