"""`python -m jaxmpc` is the command `jaxmpc`."""

import sys

from jaxmpc.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
