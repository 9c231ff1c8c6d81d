/* NAME: written by jaxmpc VERSION. See NAME.h.
 *
 * minimize 1/2 z'Pz + q'z + g(Cz), q and the bounds of g affine in the parameters, by ADMM in rows
 * scaled by E. A step on t = s + v, the sum of splitting variable and scaled multiplier:
 *     s = prox(t),  t <- t + ALPHA (E C (ZF r + ZQ q) - s),  r = 2s - t,
 * with ZF = M^-1 C'E RHO and ZQ = -M^-1, M = P + C'E RHO E C (Boyd et al. 2011, section 3.4.3).
 */
#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__) || \
    defined(_M_FP_FAST)
#error "Compile without -ffast-math: it takes the tests for NaN and infinity out"
#endif

#include <math.h>
#include <string.h>

#include "NAME.h"

typedef NAME_real real;

#define N NAME_STATES
#define MU NAME_INPUTS
#define NP NAME_PARAMETERS
#define NZ NAME_VARIABLES
#define M NAME_ROWS
#define STAGES NAME_STAGES

#include "NAME_tables.h"

#ifdef __cplusplus
#define RESTRICT
#else
#define RESTRICT restrict
#endif

/* out (rows) = A (rows, columns) v, plus out where add is 1. Columns of A lie one after another, so
 * that compilers vectorise the inner loop without reordering a sum. */
static void product(int rows, int columns, const real *RESTRICT A, const real *RESTRICT v, int add,
                    real *RESTRICT out) {
  for (int i = 0; i < rows && !add; i++) out[i] = 0;
  for (int j = 0; j < columns; j++)
    for (int i = 0; i < rows; i++) out[i] += A[j * rows + i] * v[j];
}

/* The larger one; NaN where either is, which fmax drops. */
static real larger(real a, real b) { return a >= b || a != a ? a : b; }

/* |v| beside a size; 0 beside 0 is 0. */
static real relative(real v, real size) { return v == 0 ? 0 : FABS(v) / size; }

static int all_finite(int count, const real *v) {
  int finite = 1;
  for (int i = 0; i < count; i++) finite = finite && isfinite(v[i]);
  return finite;
}

/* s = prox(t) for bounds l, u in scaled rows and these penalties */
static void project(const real *t, const real *l, const real *u, const real *penalty, real *s) {
  for (int i = 0; i < M; i++) {
    real v = t[i], p = v < l[i] ? l[i] : v > u[i] ? u[i] : v;
#if NAME_SOFT
    real distance = FABS(v - p);
    if (distance > soft_linear[i] / penalty[i]) { /* p is outside too: from v, which may be far */
      real whole = penalty[i] + soft_quadratic[i];
      real paid = soft_linear[i] / whole + soft_quadratic[i] / whole * distance;
      p = v + (v > p ? -paid : paid);
    }
#else
    (void)penalty;
#endif
    s[i] = p;
  }
#if NAME_BALLS
  for (int k = 0, first = M - NAME_BALL_ROWS; k < NAME_BALLS; first += ball_rows[k++]) {
    real squared = 0;
    for (int i = first; i < first + ball_rows[k]; i++) squared += (t[i] - l[i]) * (t[i] - l[i]);
    real length = SQRT(squared), shrink = length > radius[k] ? radius[k] / length : 1;
    for (int i = first; i < first + ball_rows[k]; i++) s[i] = l[i] + shrink * (t[i] - l[i]);
  }
#endif
}

static real clipped(int i, real u) {
  if (!isfinite(u)) u = 0;
  return u < input_lower[i] ? input_lower[i] : u > input_upper[i] ? input_upper[i] : u;
}

void NAME_reset(NAME_memory *memory) { memset(memory, 0, sizeof *memory); }

static int said(int status, real primal, real dual, NAME_info *info) {
  if (info) {
    info->status = status;
    info->primal_residual = primal;
    info->dual_residual = dual;
  }
  return status;
}

/* Where there is no plan: the last input if its rate counts, else zero, within the limits; the next
 * call begins cold. */
static int failed(int status, NAME_memory *memory, real *input, NAME_info *info) {
  for (int i = 0; i < MU; i++) input[i] = clipped(i, NP > N ? memory->u[i] : 0);
  NAME_reset(memory);
  memcpy(memory->u, input, sizeof memory->u);
  return said(status, (real)INFINITY, (real)INFINITY, info);
}

/* out = E C z, scaled rows */
static void scaled_rows(const real *z, real *out) {
  product(M, NZ, C, z, 0, out);
  for (int i = 0; i < M; i++) out[i] *= E[i];
}

/* b = E C ZQ q, and ZQ q in move, for the penalties of a stage. */
static void offset(int stage, const real *q, real *move, real *b) {
  product(NZ, NZ, ZQ + stage * NZ * NZ, q, 0, move);
  scaled_rows(move, b);
}

/* What a step of ADMM adds to t, over ALPHA. */
static void direction(int stage, const real *t, const real *l, const real *u, const real *b, real *d) {
  real s[M + 1], r[M + 1];
  project(t, l, u, rho + stage * M, s);
  for (int i = 0; i < M; i++) r[i] = 2 * s[i] - t[i];
#if NAME_THIN
  real spare[NZ];
  product(NZ, M, ZF + stage * NZ * M, r, 0, spare);
  scaled_rows(spare, d);
#else
  product(M, M, G + stage * M * M, r, 0, d);
#endif
  for (int i = 0; i < M; i++) d[i] += b[i] - s[i];
}

#if NAME_WARM
/* Scaled t = s + v of the last plan, one step later. */
static void warm_start(const NAME_memory *memory, const real *l, const real *u, real *t) {
  real z[NZ], x[N], y[M + 1], s[M + 1];
  memcpy(x, end_constant, sizeof x);
  product(N, NP, end_theta, memory->theta, 1, x);
  product(N, NZ, end_z, memory->z, 1, x);
  for (int k = 0; k < NZ / MU; k++)
    for (int i = 0; i < MU; i++) {
      real value = 0;
      if (later_move[k] >= 0) {
        value = memory->z[later_move[k] * MU + i];
      } else { /* one step more: the unconstrained optimum, clipped */
        real own = 0;
#if NAME_RATES
        real last = last_constant[i];
        for (int j = 0; j < NP; j++) last += last_theta[j * MU + i] * memory->theta[j];
        for (int j = 0; j < NZ; j++) last += last_z[j * MU + i] * memory->z[j];
#endif
        for (int j = 0; j < N; j++) value += tail_gain[j * MU + i] * x[j];
        for (int j = 0; j < N; j++) own += prestabilising_gain[j * MU + i] * x[j];
#if NAME_RATES
        real least = last + rate_lower[i], most = last + rate_upper[i];
        value = value < least ? least : value > most ? most : value;
#endif
        value = clipped(i, value) - own;
      }
      z[k * MU + i] = value;
    }
  scaled_rows(z, t);
  for (int i = 0; i < M; i++) {
    real later = later_row[i] < 0 ? 0 : memory->y[later_row[i]];
    y[i] = E[i] > 0 ? later / E[i] / rho[i] : 0;
    t[i] += y[i];
  }
  project(t, l, u, rho, s);
  for (int i = 0; i < M; i++) t[i] = s[i] + y[i];
}
#endif

int NAME_step(NAME_memory *memory, const real x[N], const real *state_reference,
              const real *input_reference, real input[MU], NAME_info *info) {
  real theta[NP], q[NZ], move[NZ], z[NZ], spare[NZ];
  /* One more than M, since an array needs a length. */
  real shift[M + 1], l[M + 1], u[M + 1], t[M + 1], s[M + 1], r[M + 1], b[M + 1], d[M + 1];
  real image[M + 1], y[M + 1];
  real sum = 0;

  for (int i = 0; i < N; i++) sum += FABS(theta[i] = x[i]);
  for (int i = N; i < NP; i++) { /* input rates, from a last input that may lie beyond the limits */
    real last = memory->u[i - N];
    theta[i] = isfinite(last) ? last : clipped(i - N, last);
  }
  for (int i = 0; i < N && state_reference; i++) sum += FABS(state_reference[i]);
  for (int i = 0; i < MU && input_reference; i++) sum += FABS(input_reference[i]);
  if (!isfinite(sum)) return failed(NAME_NON_FINITE, memory, input, info);

  memcpy(q, q_constant, sizeof q);
  product(NZ, NP, q_theta, theta, 1, q);
  if (state_reference) product(NZ, N, q_state, state_reference, 1, q);
  if (input_reference) product(NZ, MU, q_input, input_reference, 1, q);
  memcpy(shift, shift_constant, M * sizeof(real));
  product(M, NP, shift_theta, theta, 1, shift);
  for (int i = 0; i < M; i++) {
    l[i] = E[i] > 0 ? E[i] * (lower[i] - shift[i]) : (real)-INFINITY;
    u[i] = E[i] > 0 ? E[i] * (upper[i] - shift[i]) : (real)INFINITY;
    t[i] = 0;
  }
  offset(0, q, move, b);
#if NAME_WARM
  if (state_reference || input_reference) { /* cold, steps begin where these are followed */
    memset(z, 0, sizeof z);
    if (state_reference) product(NZ, N, z_state, state_reference, 1, z);
    if (input_reference) product(NZ, MU, z_input, input_reference, 1, z);
    scaled_rows(z, t);
  }
  if (memory->warm) {
    /* From the last plan only where it is nearer than nothing: where the first step is shorter. */
    real warm[M + 1], near = 0, cold = 0;
    direction(0, t, l, u, b, d);
    for (int i = 0; i < M; i++) cold += d[i] * d[i];
    warm_start(memory, l, u, warm);
    direction(0, warm, l, u, b, d);
    for (int i = 0; i < M; i++) near += d[i] * d[i];
    for (int i = 0; i < M && near < cold; i++) t[i] = warm[i]; /* NaN is not less */
  }
#endif

  for (int stage = 0; stage < STAGES; stage++) {
    const real *now = rho + stage * M;
    if (stage) { /* the multiplier carries over: v changes with the penalty */
      project(t, l, u, now - M, s);
      for (int i = 0; i < M; i++) t[i] = s[i] + now[i - M] / now[i] * (t[i] - s[i]);
      offset(stage, q, move, b);
    }
    for (int k = 0; k < NAME_ITERATIONS / STAGES; k++) {
      direction(stage, t, l, u, b, d);
      for (int i = 0; i < M; i++) t[i] += ALPHA * d[i];
    }
  }

  /* Read: z, and multipliers in the units of the problem. */
  const real *last = rho + (STAGES - 1) * M;
  project(t, l, u, last, s);
  for (int i = 0; i < M; i++) r[i] = 2 * s[i] - t[i];
  memcpy(z, move, sizeof z);
  product(NZ, M, ZF + (STAGES - 1) * NZ * M, r, 1, z);
  product(M, NZ, C, z, 0, image);

  real primal = 0, dual = 0;
  for (int i = 0; i < M; i++) {
    /* A row that no move changes keeps its limit or does not; its penalty has a slope. */
    real least = lower[i] - shift[i], top = upper[i] - shift[i];
    real near = 0 < least ? least : 0 > top ? top : 0;
    y[i] = 0;
    if (E[i] > 0) {
      near = s[i] / E[i];
      y[i] = E[i] * last[i] * (t[i] - s[i]);
#if NAME_SOFT
    } else if (isfinite(soft_linear[i])) {
      y[i] = near == 0 ? 0 : (near < 0 ? 1 : -1) * (soft_linear[i] + soft_quadratic[i] * FABS(near));
      near = image[i];
#endif
    }
    real size = larger(row_size[i], larger(FABS(image[i]), FABS(near)));
    primal = larger(primal, relative(image[i] - near, size));
  }
  product(NZ, NZ, P, z, 0, spare);
  for (int i = 0; i < NZ; i++) {
    real force = 0;
    for (int j = 0; j < M; j++) force += C[i * M + j] * y[j];
    real size = larger(larger(variable_size[i], FABS(force)), larger(FABS(spare[i]), FABS(q[i])));
    dual = larger(dual, relative(spare[i] + q[i] + force, size));
  }
  int solved = primal <= NAME_TOLERANCE && dual <= NAME_TOLERANCE; /* false for NaN */
  int status = solved ? NAME_SOLVED : NAME_NOT_SOLVED;

  memcpy(input, first_constant, MU * sizeof(real));
  product(MU, NP, first_theta, theta, 1, input);
  product(MU, NZ, first_z, z, 1, input);
  if (!(all_finite(NZ, z) && all_finite(M, y) && all_finite(MU, input) && isfinite(primal) &&
        isfinite(dual)))
    return failed(NAME_OVERFLOW, memory, input, info);
  memcpy(memory->y, y, M * sizeof(real));
  memcpy(memory->z, z, sizeof z);
  memcpy(memory->theta, theta, sizeof theta);
  for (int i = 0; i < MU; i++) {
#if NAME_RATES
    real least = theta[N + i] + rate_lower[i], most = theta[N + i] + rate_upper[i];
    input[i] = input[i] < least ? least : input[i] > most ? most : input[i];
#endif
    memory->u[i] = input[i] = clipped(i, input[i]);
  }
  memory->warm = 1;
  return said(status, primal, dual, info);
}
