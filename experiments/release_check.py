"""Compare what was built with the source tree: nothing of the package may be missing.

python -m build && python experiments/release_check.py dist
"""

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Return 1 where a file of the package is missing in the wheel or the source archive."""
    folder = Path(sys.argv[1])
    listed = ["git", "ls-files", "jaxmpc"]
    named = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    wanted = set(named.split())
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        inside = set(wheel.namelist())
    with tarfile.open(next(folder.glob("*.tar.gz"))) as archive:
        source = {name.split("/", 1)[-1] for name in archive.getnames()}
    missing = {"wheel": wanted - inside, "source archive": wanted - source}
    missing["source archive"] |= {"LICENSE", "README.md", "pyproject.toml"} - source
    for what, names in missing.items():
        print(f"{what}: {', '.join(sorted(names)) or 'nothing'} missing")
    return int(any(missing.values()))


if __name__ == "__main__":
    sys.exit(main())
