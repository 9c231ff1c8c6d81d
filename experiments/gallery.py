"""Draw the pictures of docs/gallery.md from its own lines: docs/assets/gallery.

python experiments/gallery.py
"""

import os
import re
import tempfile
from pathlib import Path

import matplotlib

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Run the page in an empty folder, and keep its pictures."""
    matplotlib.use("agg")
    matplotlib.rcParams["savefig.dpi"] = 110
    matplotlib.rcParams["savefig.bbox"] = "tight"
    text = (ROOT / "docs" / "gallery.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names: dict[str, object] = {}
    kept = ROOT / "docs" / "assets" / "gallery"
    kept.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for block in blocks:
            exec(compile(block, "docs/gallery.md", "exec"), names)
        for picture in sorted(Path(folder).glob("*.png")):
            (kept / picture.name).write_bytes(picture.read_bytes())
            print(picture.name, f"{picture.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
