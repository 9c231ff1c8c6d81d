/* Numbers that nobody would send, for fuzz_law.c and fuzz_mpc.c, after the code that they include. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef long double wide;

static uint64_t state;

static uint64_t bits(void) { /* xorshift64* */
  state ^= state >> 12, state ^= state << 25, state ^= state >> 27;
  return state * UINT64_C(2685821657736338717);
}

static double uniform(double low, double high) {
  return low + (high - low) * (double)(bits() >> 11) / 9007199254740992.0;
}

static real wild(void) {
  uint64_t raw = bits();
  real value;
  switch (bits() % 8) {
    case 0: return (real)NAN;
    case 1: return (real)(raw & 1 ? INFINITY : -INFINITY);
    case 2: memcpy(&value, &raw, sizeof value); return value;
    case 3: case 4: return (real)(uniform(-1, 1) * pow(10, uniform(0, sizeof(real) == 4 ? 38 : 308)));
    case 5: return (real)uniform(-1e4, 1e4);
    default: return (real)uniform(-2, 2);
  }
}
