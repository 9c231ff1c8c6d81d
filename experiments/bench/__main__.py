"""`python experiments/bench`: see command.py."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # Python puts this folder on the path; `bench` is found from the one that holds it.
    sys.path[0] = str(Path(__file__).resolve().parents[1])
    from bench.command import main

    sys.exit(main())
