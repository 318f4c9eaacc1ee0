"""docs/glossary.md names existing files and functions for every numbered equation of the paper."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NUMBERED = 10
"""Numbered equations of the paper."""
CODE = r"`(\w+)`"


def rows(section: str) -> list[list[str]]:
    text = (ROOT / "docs" / "glossary.md").read_text("utf8")
    table = text.split(f"## {section}\n")[1].split("\n## ")[0].split("\n\n| ", 1)[-1]
    lines = [line for line in ("| " + table).split("\n\n")[0].splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines[1:]]


def defines(file: str, text: str, name: str) -> bool:
    """Return True if a file defines a function of this name, or a C++ constant; calls and declarations do not count."""
    if file.endswith(".py"):
        return re.search(rf"^def {name}\(", text, re.MULTILINE) is not None
    if re.search(rf"^constexpr double {name} =", text, re.MULTILINE):
        return True
    start = rf"^ *(?:template <[^>]*> )?(?:BT_HD|__device__|__global__|void)\b[^;\n]*\b{name}\([^;]*?\{{"
    return re.search(start, text, re.MULTILINE) is not None


def test_every_numbered_equation_is_there() -> None:
    numbers = {int(found) for row in rows("Equations") if (found := row[0].split(",")[0]).isdecimal()}
    assert numbers == set(range(1, NUMBERED + 1))


def test_names_are_defined_where_the_page_says() -> None:
    for _, _, file, name in rows("Equations"):
        assert re.fullmatch(CODE, name), name
        assert defines(file, (ROOT / file).read_text("utf8"), name.strip("`")), f"{file} does not define {name}"
