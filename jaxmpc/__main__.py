"""`python -m jaxmpc` is the command `jaxmpc`."""

import sys

from jaxmpc.cli import main

if __name__ == "__main__":
    sys.exit(main())
