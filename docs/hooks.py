"""What the site has beside the pages of docs/: the notebooks with their output, the changelog, the
version, and formulas as MathML, which browsers draw without scripts and fonts from elsewhere."""

import base64
import html
import json
import os
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
# Address of the repository, where it is known: for a link in the footer, and notebooks in Colab.
# (The link of the theme itself asks GitHub for numbers when a page is read.)
REPOSITORY = os.environ.get("JAXMPC_REPOSITORY", "")
# Links of pages to files outside docs/, and where these are on the site.
MOVED = {"CHANGELOG.md": "changelog.md"}
# Formulas wait here, under a word that Markdown leaves alone, until the page is HTML.
FORMULAS: dict[str, str] = {}


def on_config(config: Any) -> Any:
    """Show the version in the footer, and link to the repository where its address is known."""
    text = (ROOT / "jaxmpc" / "version.py").read_text()
    version = re.search(r'__version__ = "(.*)"', text)
    assert version is not None
    config.copyright = f"jaxmpc {version[1]}, Apache License 2.0"
    if REPOSITORY:
        config.copyright += f' · <a href="{html.escape(REPOSITORY)}">Repository</a>'
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the changelog and the notebooks."""
    changelog = (ROOT / "CHANGELOG.md").read_text()
    files.append(File.generated(config, "changelog.md", content=changelog))
    for path in sorted((ROOT / "notebooks").glob("[0-9]*.ipynb")):
        text, pictures = page_of(path)
        if "//github.com/" in REPOSITORY:
            place = REPOSITORY.split("//github.com/")[1].rstrip("/")
            colab = f"https://colab.research.google.com/github/{place}/blob/main/notebooks/"
            first = f"`!pip install 'jaxmpc[robots] @ git+{REPOSITORY}'`"
            link = f"[Open in Colab]({colab}{path.name}), and run {first} there first. "
            text = text.replace("\n\n", f"\n\n{link}", 1)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
        files.append(File.generated(config, f"notebooks/{path.name}", content=path.read_bytes()))
        for name, picture in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=picture))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Put words in place of formulas, and addresses on the site in place of files."""
    src = page.file.src_uri
    if src.startswith("notebooks/"):
        parts = re.split(r"(^```.*?^```$|`[^`\n]*`)", markdown, flags=re.MULTILINE | re.DOTALL)
        parts[::2] = [_without_dollars(part) for part in parts[::2]]
        return "".join(parts)
    markdown = re.sub(
        r"^```math\n(.*?)^```$",
        lambda found: _kept(found[1], "block"),
        markdown,
        flags=re.MULTILINE | re.DOTALL,
    )
    up = "../" * src.count("/")
    for file, where in MOVED.items():
        markdown = markdown.replace(f"]({up}../{file})", f"]({up}{where})")
    return re.sub(rf"\]\({re.escape(up)}\.\./(notebooks/\w+)\.ipynb\)", rf"]({up}\1.md)", markdown)


def on_page_content(content: str, page: Any, config: Any, files: Files) -> str:
    """Put the formulas back."""
    content = re.sub(
        r"<p>(formulablock\d+end)</p>",
        lambda found: f'<div class="formula">{FORMULAS[found[1]]}</div>',
        content,
    )
    return re.sub(r"formula(?:block|inline)\d+end", lambda found: FORMULAS[found[0]], content)


def _kept(formula: str, display: str) -> str:
    """Keep a formula in TeX as MathML; return the word that stands for it."""
    word = f"formula{display}{len(FORMULAS)}end"
    # What LaTeX calls aligned, its converter knows as align*. Of a prime it makes an exponent,
    # small and too high in browsers, where the character is raised by itself.
    formula = formula.strip().replace("{aligned}", "{align*}").replace("'", r"\text{′}")
    FORMULAS[word] = convert(formula, display=display)
    return f"\n\n{word}\n\n" if display == "block" else word


def _without_dollars(text: str) -> str:
    text = re.sub(r"\$\$(.+?)\$\$", lambda found: _kept(found[1], "block"), text, flags=re.DOTALL)
    return re.sub(r"(?<!\\)\$([^$]+?)\$", lambda found: _kept(found[1], "inline"), text)


def page_of(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, and its pictures by their names."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in json.loads(path.read_text())["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            text = "".join(output.get("text", data.get("text/plain", "")))
            if "image/png" in data:
                name = f"{path.stem}_{len(pictures)}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![Picture that the code above draws]({name})")
            elif "text/html" in data:
                parts.append("".join(data["text/html"]))
            elif text.strip():
                parts.append(f'<pre class="output">{html.escape(text.rstrip())}</pre>')
    start = (
        f"[Download this notebook]({path.name}){{ download }}; how to run it: "
        "[Tutorial](../tutorial.md)."
    )
    title, rest = parts[0].split("\n", 1) if "\n" in parts[0] else (parts[0], "")
    return "\n\n".join([title, start, rest, *parts[1:]]) + os.linesep, pictures
