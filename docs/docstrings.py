"""Keep the layout of docstrings in the reference: a line that describes another field or argument,
or that begins a list, starts a paragraph of its own, and stars outside code are stars."""

import re
from typing import Any

import griffe

_FIELD = re.compile(r"(\w+)(?:, \w+)*(?: \([^:]*?\))?(?:,? [^:.]{0,40})?: ")


class Layout(griffe.Extension):
    """Extension of griffe, which mkdocstrings reads docstrings with."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Mend the docstrings of a package once all of it is loaded."""
        self._mend(pkg)

    def _mend(self, obj: Any) -> None:
        for member in obj.members.values():
            if not member.is_alias:
                self._mend(member)
        if obj.docstring:
            names = set(obj.members) if obj.is_class else set()
            if obj.is_function:
                names = {parameter.name for parameter in obj.parameters}
            obj.docstring.value = _mended(obj.docstring.value, names)


def _mended(text: str, names: set[str]) -> str:
    lines: list[str] = []
    section = False  # inside "Arguments:", which has a layout of its own
    for line in text.split("\n"):
        if re.fullmatch(r"(Arguments|Returns|Raises):", line):
            section = True
        elif line and not line[0].isspace():
            section = False
            found = _FIELD.match(line)
            begins = (found and found[1] in names) or (
                line.startswith("- ") and lines and not lines[-1].startswith(("- ", "  "))
            )
            if begins and lines and lines[-1].strip() and not lines[-1].endswith(","):
                lines.append("")
        if not section and not line.startswith("    "):
            parts = line.split("`")
            parts[::2] = [part.replace("*", r"\*") for part in parts[::2]]
            line = "`".join(parts)
        lines.append(line)
    return "\n".join(lines)
