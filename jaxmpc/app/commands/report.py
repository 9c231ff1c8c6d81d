"""The command `jaxmpc report`: one HTML file with tables, text and pictures inside."""

import base64
import html
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jaxmpc.app.commands.outcome import RECORDS, Outcome
from jaxmpc.app.options.report import ReportOptions
from jaxmpc.checks import fail
from jaxmpc.files import text_within

STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}"
    "table{border-collapse:collapse;margin:.5rem 0}td,th{text-align:left;vertical-align:top;"
    "padding:.15rem 1rem .15rem 0;border-bottom:1px solid #ddd;overflow-wrap:anywhere}"
    "img{max-width:100%}pre{white-space:pre-wrap;background:#f6f6f6;padding:1rem}"
    "h2,h3{margin-bottom:.2rem}"
)


class Report(ReportOptions):
    """The command: its options, and `run`."""

    def run(self) -> Outcome:
        """Write the page. Raises ValueError for a folder without a readable summary."""
        path = self.folder / "report.html"
        try:
            path.write_text(folder_page(self.folder), encoding="utf-8")
        except (OSError, ValueError, RecursionError) as error:
            what = getattr(error, "strerror", None) or f"{error}"
            fail(
                str(self.folder), f"no page of it: {what}", "Give the folder of a finished command"
            )
        print(f"{path}: {path.stat().st_size / 1024:.0f} KiB")
        return Outcome(summary={"files": [str(path)]})


def html_page(title: str, parts: Iterable[str]) -> str:
    """Return a page of parts that `table`, `text` and `picture` made."""
    head = f"<meta charset='utf-8'><title>{html.escape(title)}</title><style>{STYLE}</style>"
    body = "\n".join([f"<h1>{html.escape(title)}</h1>", *parts])
    head += "<meta name='viewport' content='width=device-width'>"
    return f"<!doctype html>\n<html lang='en'><head>{head}</head>\n<body>\n{body}\n</body></html>\n"


def picture(caption: str, png: bytes) -> str:
    """An image, inside the page."""
    data, name = base64.b64encode(png).decode(), html.escape(caption)
    return f"<figure><img alt='{name}' src='data:image/png;base64,{data}'></figure>"


def text(title: str, body: str) -> str:
    """Lines as they would stand in a terminal."""
    return f"<h2>{html.escape(title)}</h2>\n<pre>{html.escape(body)}</pre>"


def table(title: str, values: dict[str, Any], level: int = 2) -> str:
    """Names and values but for None; what has names itself follows as tables below."""
    inner = {key: value for key, value in values.items() if isinstance(value, dict) and value}
    rows = [
        f"<tr><th>{html.escape(_words(key))}</th><td>{html.escape(_shown(value))}</td></tr>"
        for key, value in values.items()
        if key not in inner and value is not None
    ]
    below = [
        table(f"{title}: {_words(key)}" if level > 2 else _words(key), value, level + 1)
        for key, value in inner.items()
    ]
    heading = [f"<h{min(level, 4)}>{html.escape(title)}</h{min(level, 4)}>"]
    body = [f"<table>{''.join(rows)}</table>"] if rows else []
    return "\n".join([*heading, *body, *below])


def folder_page(folder: Path) -> str:
    """Return the page of a folder that a command wrote: its results and its pictures.

    Raises ValueError where there are none, and where they are damaged.
    """
    found = next((folder / name for name in RECORDS if (folder / name).exists()), None)
    if found is None:
        raise ValueError(f"it holds none of {', '.join(RECORDS)}")
    document = json.loads(text_within(found))
    if not isinstance(document, dict) or not isinstance(document.get("config", {}), dict):
        fail(str(folder), "holds other results than commands write", "Run the command again")
    document.pop("digest", None)
    config = document.pop("config", {})
    name = document.pop("name", None) or config.get("name") or folder.name
    pictures = [picture(path.stem, path.read_bytes()) for path in sorted(folder.glob("*.png"))]
    parts = [*pictures, table("Results", document)]
    return html_page(str(name), [*parts, *([table("Configuration", config)] if config else [])])


def _words(key: str) -> str:
    return key.replace("_", " ")


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list) and value and isinstance(value[0], list):
        return "; ".join(map(_shown, value))  # a matrix, row by row
    if isinstance(value, list):
        return ", ".join(map(_shown, value)) if len(value) < 30 else f"{len(value)} values"
    return str(value)
