"""What the reference shows beside the text of docstrings: constructors that decorators make, and
tables of arguments or fields, read from the text that describes them."""

import ast
import functools
import re
from pathlib import Path
from typing import Any

import griffe

# Decorators of `jaxmpc.pytrees`, which make dataclasses.
MAKERS = {"pytree", "prepared_pytree", "record", "static_pytree", "dataclass"}
# Functions that describe a field.
FIELDS = {"field", "static"}
# Begins a sentence that goes on with what the one before says of an argument.
GOES_ON = re.compile(
    r"(?:None|With|Without|It|Its|True|False|Each|Else|Where|If|These|Those|They|Them|Both|The"
    r" larger|Less|Of several|That|Without either|Then|Such|\"|`|−?\d)"
)
# After the name of an argument: its letter in formulas, and its shape in parentheses.
SHAPE = r"(?:\s[^\W\d_]'?(?=[\s,:;(.]|$))?(?:\s\((?:[^()]|\([^()]*\))*\))?"
# The page on which names are described that mean the same everywhere.
COMMON = Path(__file__).parent / "reference" / "index.md"


class Layout(griffe.Extension):
    """Extension of griffe, which mkdocstrings reads docstrings with."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Complete the classes and docstrings of a package once all of it is loaded."""
        _each(pkg, _construct)
        _each(pkg, _tabulate)


def _each(obj: Any, change: Any) -> None:
    for member in list(obj.members.values()):
        if not member.is_alias:
            _each(member, change)
    change(obj)


def _construct(obj: Any) -> None:
    """Give a class of fields the constructor that its decorator makes."""
    if obj.is_class and "__init__" not in obj.members:
        fields = _fields(obj)
        if fields:
            own = griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)
            obj.set_member(
                "__init__",
                griffe.Function("__init__", parameters=griffe.Parameters(own, *fields), parent=obj),
            )


def _fields(cls: Any) -> list[griffe.Parameter]:
    """Return the fields of a dataclass or NamedTuple, inherited ones first, as parameters."""
    made = {str(decorator.value).split("(")[0].split(".")[-1] for decorator in cls.decorators}
    bases = [str(base).split(".")[-1] for base in cls.bases]
    if not (made & MAKERS or "NamedTuple" in bases):
        return []
    found: dict[str, griffe.Parameter] = {}
    keywords = False
    for base in cls.resolved_bases:
        found |= {parameter.name: parameter for parameter in _fields(base)}
    for name, member in cls.members.items():
        if member.is_alias or not member.is_attribute or member.annotation is None:
            continue
        if "property" in member.labels or str(member.annotation).startswith("ClassVar"):
            continue
        keywords = keywords or name == "_"  # `_: KW_ONLY`
        given, default = _default(member.value)
        if name == "_" or not given:
            continue
        kinds = griffe.ParameterKind
        kind = kinds.keyword_only if keywords else kinds.positional_or_keyword
        found[name] = griffe.Parameter(
            name, annotation=member.annotation, kind=kind, default=default
        )
    return list(found.values())


def _default(value: Any) -> tuple[bool, Any]:
    """Return whether the constructor takes a field, and its default, from what its class says."""
    try:
        call = ast.parse(str(value), mode="eval").body
    except SyntaxError:
        return True, value
    if not isinstance(call, ast.Call) or ast.unparse(call.func).split(".")[-1] not in FIELDS:
        return True, value
    options = {option.arg: ast.unparse(option.value) for option in call.keywords}
    if options.get("init") == "False":
        return False, None
    if "default_factory" in options:
        return True, f"{options['default_factory']}()"
    return True, options.get("default")


def _tabulate(obj: Any) -> None:
    """Write what a docstring says of arguments or fields as the section that becomes a table."""
    for parameter in obj.parameters if obj.is_function else ():
        if str(parameter.annotation) == "Any":
            parameter.annotation = None
    if not obj.docstring or not (obj.is_class or obj.is_function):
        return
    try:
        parameters = [p for p in obj.parameters if p.name not in ("self", "cls")]
    except (KeyError, AttributeError):
        parameters = []
    names = [p.name.lstrip("*") for p in parameters]
    text, meanings = _meanings(obj, names)
    if names and (obj.is_class or meanings):
        title = "Arguments, which are its fields" if _fields_of(obj) else "Arguments"
        rows = [f"    {p.name}: {meanings.get(p.name.lstrip('*'), '')}" for p in parameters]
        text += "\n\n" + "\n".join([f"Arguments: {title}", *rows])
    obj.docstring.value = text


def _meanings(obj: Any, names: list[str]) -> tuple[str, dict[str, str]]:
    """Return `described` of an object, with what its bases and the page `COMMON` say."""
    text, meanings = described(obj.docstring.value, names)
    for base in obj.resolved_bases if obj.is_class else ():
        if base.docstring:
            meanings = _meanings(base, [p.name for p in _fields(base)])[1] | meanings
    for name in names:
        if not meanings.get(name):
            meanings[name] = common().get(name) or _shape(obj.docstring.value, name)
    return text, meanings


def _fields_of(obj: Any) -> bool:
    return obj.is_class and bool(_fields(obj))


def described(docstring: str, names: list[str]) -> tuple[str, dict[str, str]]:
    """Return the text of a docstring without what it says of the arguments `names`, and that:
    name → text.

    Paragraphs that begin with the name of an argument and a colon, and the section "Arguments:",
    are moved. Of an argument that other paragraphs mention with a shape or a colon, that sentence
    is copied.
    """
    meanings: dict[str, str] = {}
    kept = []
    section = False
    for paragraph in re.split(r"\n\s*\n", docstring):
        lines = paragraph.split("\n")
        if lines[0] in ("Arguments:", "Returns:", "Raises:"):
            section = lines[0] == "Arguments:"
            lines = lines[1:]
        elif not lines[0].startswith(" "):
            section = False
        body = "\n".join(lines)
        head = _head(names)
        starts = head is not None and head.match(body.lstrip())
        if section or starts:
            rest = _moved(body, names, meanings, whole=section)
            kept += [_plain(rest)] if rest else []
        else:
            kept.append(_plain(paragraph))
    text = "\n\n".join(kept)
    for name in names:
        meanings[name] = meanings.get(name) or _mentioned(docstring, name)
    return text, {name: meaning for name, meaning in meanings.items() if meaning}


@functools.cache
def common() -> dict[str, str]:
    """Return what names mean that mean the same everywhere, as `COMMON` has them in a table."""
    rows = re.findall(r"^\| (`\w+`(?:, `\w+`)*) \| (.*) \|$", COMMON.read_text(), re.MULTILINE)
    return {name: meaning for names, meaning in rows for name in re.findall(r"\w+", names)}


def _head(names: list[str]) -> re.Pattern[str] | None:
    """Return the pattern of what begins the description of arguments: "a (n,), b: "."""
    if not names:
        return None
    one = rf"(?:{'|'.join(map(re.escape, sorted(names, key=len, reverse=True)))})"
    one = rf"{one}\b{SHAPE}"
    return re.compile(rf"({one}(?:(?:,|,? and|;)\s{one})*)([^:.;]{{0,45}}):(?=\s)")


def _moved(body: str, names: list[str], meanings: dict[str, str], whole: bool) -> str:
    """Put what is said of arguments into `meanings`; return the rest, nothing of a `whole` one."""
    lines = [line.rstrip() for line in body.split("\n")]
    margin = min(len(line) - len(line.lstrip()) for line in lines if line)
    whole = whole or any(line[margin:].startswith("  ") for line in lines)
    body = "\n".join(line.strip() for line in lines)
    head = _head(names)
    assert head is not None
    begins = [
        found
        for found in head.finditer(body)
        if found.start() == 0 or re.search(r"[.;:]\s$", body[: found.start()])
    ]
    ends = [found.start() for found in begins[1:]] + [len(body)]
    rest = body[: begins[0].start()] if begins else body
    for found, end in zip(begins, ends, strict=True):
        text = body[found.end() : end].strip()
        parts = re.split(r"(?<=\.)\s+(?=[A-Z])", text)
        others = (i for i, part in enumerate(parts) if i and not (whole or GOES_ON.match(part)))
        cut = next(others, len(parts))
        text, after = " ".join(parts[:cut]), " ".join(parts[cut:])
        rest += "\n" * bool(rest and after) + after
        for name, shape in _named(found[1], names):
            said = " ".join(f"{shape} {found[2]}".split())
            joined = f"{said}: {text}" if said else text
            meanings[name] = _plain(_sentence(" ".join(joined.split())))
    return rest


def _named(heads: str, names: list[str]) -> list[tuple[str, str]]:
    """Return the names in the beginning of a description, each with its symbol and shape."""
    one = "|".join(map(re.escape, sorted(names, key=len, reverse=True)))
    found = re.findall(rf"(?:^|(?<=[\s,]))({one})\b({SHAPE})", heads)
    return [(name, " ".join(shape.split())) for name, shape in found]


def _mentioned(docstring: str, name: str) -> str:
    """Return the clause after an argument and a colon in prose, or the lines of a list on it."""
    word = re.escape(name)
    listed = rf"^( +)(?:\w+, )*{word}(?:, \w+)*  +(.*(?:\n\1 .*)*)"
    if found := re.search(listed, docstring, re.MULTILINE):
        return _plain(_sentence(" ".join(found[2].split())))
    for paragraph in re.split(r"\n\s*\n", docstring):
        text = " ".join(paragraph.split())
        begin = r"(?:^|[.;:,)] |and )"
        found = re.search(rf"{begin}{word}({SHAPE})(?:,? [^:.;]{{0,45}})?: (.*?)(?:[.;] |$)", text)
        if found:
            shape = found[1].strip()
            return _plain(_sentence(f"{shape}: {found[2]}" if shape else found[2]))
    return ""


def _shape(docstring: str, name: str) -> str:
    """Return the shape of an argument that prose names."""
    text = " ".join(docstring.split())
    for found in re.finditer(rf"(?<![\w`.']){re.escape(name)}({SHAPE})", text):
        if re.search(r"\(.*[,\w]\)", found[1]) and "−" not in found[1]:
            return found[1].strip()
    return ""


def _sentence(text: str) -> str:
    """Return a text that ends with a full stop and begins with a capital, if with a plain word."""
    text = text.strip().rstrip(";,")
    if re.match(r"(?:[a-z]{2,}[ ,.;]|a )", text):
        text = text[0].upper() + text[1:]
    return text if text.endswith((".", ":", ")")) or not text else text + "."


def _plain(text: str) -> str:
    """Return a text in which stars outside code are stars, and whose lists begin a paragraph."""
    lines: list[str] = []
    for line in text.split("\n"):
        if not line.startswith("    "):
            if line.startswith("- ") and lines and not lines[-1].startswith(("- ", "  ")):
                lines.append("")
            parts = line.split("`")
            parts[::2] = [part.replace("*", r"\*") for part in parts[::2]]
            line = "`".join(parts)
        lines.append(line)
    return "\n".join(lines)
