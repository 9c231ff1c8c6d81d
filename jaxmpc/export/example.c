/* Reads states from stdin, one a line; prints u, status and residuals of each sample, and the time.
 *
 *   cc -std=c99 -O2 NAME.c NAME_example.c -lm -o NAME_example
 *   echo "X0" | ./NAME_example
 *
 * An empty line begins a new run. After the last state the times go to stderr.
 */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "NAME.h"

int main(void) {
  static NAME_memory memory;
  static char line[65536];
  double worst = 0, total = 0;
  long count = 0, lines = 0;
  NAME_reset(&memory);
  while (fgets(line, sizeof line, stdin)) {
    NAME_real x[NAME_STATES], u[NAME_INPUTS];
    NAME_info info;
    struct timespec begin, end;
    char *at = line, *next;
    int found = 0;
    lines++;
    for (; found < NAME_STATES; found++, at = next) {
      x[found] = (NAME_real)strtod(at, &next);
      if (next == at) break;
    }
    at += strspn(at, " \t\r\n");
    if (!found && !*at) {
      NAME_reset(&memory);
      continue;
    }
    if (found < NAME_STATES || *at) {
      fprintf(stderr, "line %ld: give %d numbers with blanks between them\n", lines, NAME_STATES);
      return 1;
    }
    clock_gettime(CLOCK_MONOTONIC, &begin);
    NAME_step(&memory, x, NULL, NULL, u, &info);
    clock_gettime(CLOCK_MONOTONIC, &end);
    double seconds = (double)(end.tv_sec - begin.tv_sec) + 1e-9 * (double)(end.tv_nsec - begin.tv_nsec);
    worst = seconds > worst ? seconds : worst, total += seconds, count++;
    for (int i = 0; i < NAME_INPUTS; i++) printf("%.17g ", (double)u[i]);
    printf("%d %.3g %.3g\n", info.status, (double)info.primal_residual, (double)info.dual_residual);
  }
  if (count)
    fprintf(stderr, "%ld samples: mean %.2f us, worst %.2f us\n", count, 1e6 * total / (double)count,
            1e6 * worst);
  return 0;
}
