/* Reads states from stdin, one a line; prints u and status of each.
 *
 *   cc -std=c99 -O2 NAME.c NAME_example.c -lm -o NAME_example
 *   echo "X0" | ./NAME_example
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "NAME.h"

int main(void) {
  static char line[65536];
  for (long lines = 1; fgets(line, sizeof line, stdin); lines++) {
    NAME_real x[NAME_PARAMETERS], u[NAME_INPUTS];
    char *at = line, *next;
    int found = 0;
    for (; found < NAME_PARAMETERS; found++, at = next) {
      x[found] = (NAME_real)strtod(at, &next);
      if (next == at) break;
    }
    at += strspn(at, " \t\r\n");
    if (!found && !*at) continue;
    if (found < NAME_PARAMETERS || *at) {
      fprintf(stderr, "line %ld: give %d numbers with blanks between them\n", lines,
              NAME_PARAMETERS);
      return 1;
    }
    int status = NAME_evaluate(x, u);
    for (int i = 0; i < NAME_INPUTS; i++) printf("%.17g ", (double)u[i]);
    printf("%d\n", status);
  }
  return 0;
}
