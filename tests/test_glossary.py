"""docs/glossary.md names files and functions that exist, for every numbered equation of the paper."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NUMBERED = 10
"""Numbered equations of the paper."""


def rows() -> list[list[str]]:
    text = (ROOT / "docs" / "glossary.md").read_text("utf8")
    table = text.split("## Equations")[1].split("## Symbols")[0]
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_every_numbered_equation_is_there() -> None:
    numbers = {int(found) for row in rows() if (found := row[0].split(",")[0]).isdecimal()}
    assert numbers == set(range(1, NUMBERED + 1))


def test_names_are_defined_where_the_page_says() -> None:
    for _, _, file, name in rows():
        assert re.fullmatch(r"`\w+`", name), name
        name = name.strip("`")
        text = (ROOT / file).read_text("utf8")
        definition = rf"^def {name}\(" if file.endswith(".py") else rf"^ *(BT_HD .*|constexpr double )\b{name}\b( =|\()"
        assert re.search(definition, text, re.MULTILINE), f"{file} does not define {name}"
