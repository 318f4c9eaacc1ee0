"""Links between the pages of the documentation lead somewhere."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"\[[^\]]*\]\(\s*<?([^)>\s]+)>?[^)]*\)")
OUTSIDE = re.compile(r"[a-z][a-z0-9+.-]*:")
MENTION = re.compile(r"\b(?:docs|benchmarks)/[\w/]+\.md\b")


def tracked(*patterns: str) -> list[Path]:
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *patterns]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return []  # not a checkout
    return [path for line in done.stdout.splitlines() if (path := ROOT / line).is_file()]


PAGES = tracked("*.md")


def without_code(text: str) -> str:
    """The text without its code, in which brackets are no links and # begins no heading."""
    text = re.sub(r"^(```|~~~).*?^\1", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`[^`\n]*`", lambda code: "" if "](" in code[0] else code[0], text)


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub makes of the headings of a page."""
    found: dict[str, int] = {}
    names = set()
    for heading in re.findall(r"^#{1,6} +(.*?) *#*$", without_code(page.read_text("utf8")), re.MULTILINE):
        shown = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        name = re.sub(r"[^\w\- ]", "", shown.lower()).replace(" ", "-")
        count = found.get(name, 0)
        names.add(f"{name}-{count}" if count else name)
        found[name] = count + 1
    return names


def dead_links(page: Path) -> list[str]:
    """Relative links of a page that lead nowhere."""
    dead = []
    for link in LINK.findall(without_code(page.read_text("utf8"))):
        if OUTSIDE.match(link):
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if not target.exists() or (anchor and (target.suffix != ".md" or anchor not in anchors(target))):
            dead.append(link)
    return dead


@pytest.mark.skipif(not PAGES, reason="not a git checkout")
def test_the_links_of_every_page_resolve() -> None:
    dead = {str(page.relative_to(ROOT)): links for page in PAGES if (links := dead_links(page))}
    assert len(PAGES) > 5 and not dead


def test_pages_that_code_refers_to_are_there() -> None:
    for path in tracked("*.py", "*.h", "*.cpp", "*.cu", "*.yaml", "Makefile", "*.toml"):
        for name in MENTION.findall(path.read_text("utf8")):
            assert (ROOT / name).is_file() or path == Path(__file__), f"{path} refers to {name}"


def test_dead_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "b.md").write_text("# One & two\n\n```\n# no heading\n```\n## One & two\n")
    page = tmp_path / "a.md"
    page.write_text("# A\n[1](b.md) [2](b.md#one--two) [3](b.md#one--two-1) [4](https://x.y/z) [5](#a) `[6](no.md)`\n")
    assert dead_links(page) == []
    page.write_text("[1](c.md) [2](b.md#no-heading) [3](#b) ![4](c.png)\n")
    assert dead_links(page) == ["c.md", "b.md#no-heading", "#b", "c.png"]
