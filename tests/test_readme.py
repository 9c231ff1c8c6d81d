"""The README's snippet runs as it stands, and says what it promises."""

import re
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def test_snippet(capsys):
    (snippet,) = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    code = snippet.split("import jaxmpc as jm\n\n")[1]
    assert len(code.splitlines()) <= 10
    names: dict[str, object] = {}
    exec(compile(snippet, str(README), "exec"), names)
    fmap = names["fmap"]
    low, high = fmap.volume_bounds()
    assert low <= 1489 / 125 <= high and high - low < 1e-6
    assert fmap.counts()["undecided"] == 0
    assert capsys.readouterr().out.startswith("Solved")
