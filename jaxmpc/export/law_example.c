/* Reads states from stdin, one a line; prints u and status of each.
 *
 *   cc -std=c99 -O2 NAME.c NAME_example.c -lm -o NAME_example
 *   echo "X0" | ./NAME_example
 */
#include <stdio.h>

#include "NAME.h"

int main(void) {
  NAME_real x[NAME_PARAMETERS], u[NAME_INPUTS];
  for (;;) {
    for (int i = 0; i < NAME_PARAMETERS; i++) {
      double value;
      if (scanf("%lf", &value) != 1) return 0;
      x[i] = (NAME_real)value;
    }
    int status = NAME_evaluate(x, u);
    for (int i = 0; i < NAME_INPUTS; i++) printf("%.17g ", (double)u[i]);
    printf("%d\n", status);
  }
}
