"""Links in the documentation resolve, and files and names it mentions exist."""

import ast
import re
import subprocess
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"\[[^\]]*\]\(\s*<?([^)>\s]+)>?[^)]*\)")
OUTSIDE = re.compile(r"[a-z][a-z0-9+.-]*:")
SOURCE = re.compile(r"(?<![\w./-])[\w/]+\.(?:py|h|cpp|cu|cmake)\b")
DOTTED = re.compile(r"`([a-zA-Z_]\w*(?:\.\w+)+)`")
FOREIGN = {"activations.py"}
"""Files of other projects in the pages."""
DATA = set("json jsonl ply glb usdc ktx2 webp png jpg yml yaml toml py h txt pth wgsl bin npz npy sfm geojson".split())
MENTION = re.compile(r"\b(?:docs|benchmarks)/[\w/]+\.md\b")


def tracked(*patterns: str) -> list[Path]:
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *patterns]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return []  # not a checkout
    return [path for line in done.stdout.splitlines() if (path := ROOT / line).is_file()]


PAGES = tracked("*.md")


def without_blocks(text: str) -> str:
    return re.sub(r"^(```|~~~).*?^\1", "", text, flags=re.MULTILINE | re.DOTALL)


def without_code(text: str) -> str:
    """Remove code, in which brackets are not links and # is no heading."""
    text = without_blocks(text)
    return re.sub(r"`[^`\n]*`", lambda code: "" if "](" in code[0] else code[0], text)


def anchors(page: Path) -> set[str]:
    """List the anchors that GitHub makes from a page's headings."""
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
    dead = []
    for link in LINK.findall(without_code(page.read_text("utf8"))):
        if OUTSIDE.match(link):
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if not target.exists() or (anchor and (target.suffix != ".md" or anchor not in anchors(target))):
            dead.append(link)
    return dead


def owners(paths: list[Path]) -> dict[str, set[str]]:
    """Map names of modules, packages and classes (lower case, without a final Config or Entry) to the names they
    define: so `scene.rim` is an option of `SceneConfig`, and `ops.trace` a function."""
    found: dict[str, set[str]] = defaultdict(set)
    for path in paths:
        tree = ast.parse(path.read_text("utf8"))
        module = {path.stem, path.parent.name, path.parent.parent.name}
        bodies = [(module, tree.body)]
        bodies += [
            ({*module, node.name, re.sub("(Config|Entry)$", "", node.name)}, node.body)
            for node in ast.walk(tree)
            if isinstance(node, ast.ClassDef)
        ]
        for places, body in bodies:
            names = set(module)
            for node in body:
                if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                    names.add(node.name)
                elif isinstance(node, (ast.Assign, ast.AnnAssign)):
                    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                    names |= {target.id for target in targets if isinstance(target, ast.Name)}
            for place in places:
                found[place.lower()] |= names
    return found


@pytest.mark.skipif(not PAGES, reason="not a git checkout")
def test_files_that_pages_mention_are_there() -> None:
    files = [f"/{path.relative_to(ROOT)}" for path in tracked("*")]
    for page in PAGES:
        for name in sorted(set(SOURCE.findall(without_blocks(page.read_text("utf8")))) - FOREIGN):
            assert any(file.endswith(f"/{name}") for file in files), f"{page.relative_to(ROOT)} mentions {name}"


@pytest.mark.skipif(not PAGES, reason="not a git checkout")
def test_functions_and_options_that_pages_mention_are_there() -> None:
    defined = owners(tracked("bitymi_ns/*.py", "benchmarks/*.py"))
    seen = 0
    for page in PAGES:
        for name in sorted(set(DOTTED.findall(page.read_text("utf8")))):
            parts = name.split(".")
            if parts[-1] in DATA or parts[0] in ("gsplat", "torch"):
                continue
            seen += 1
            for i, member in enumerate(parts[1:], start=1):
                there = any(member in defined[place.lower()] for place in parts[:i])
                assert there, f"{page.relative_to(ROOT)} mentions {name}: no {member}"
    assert seen > 30


@pytest.mark.skipif(not PAGES, reason="not a git checkout")
def test_the_links_of_every_page_resolve() -> None:
    dead = {str(page.relative_to(ROOT)): links for page in PAGES if (links := dead_links(page))}
    assert len(PAGES) > 5 and not dead


def test_pages_that_code_refers_to_are_there() -> None:
    for path in tracked("*.py", "*.h", "*.cpp", "*.cu", "*.yaml", "Makefile", "*.toml"):
        for name in MENTION.findall(path.read_text("utf8")):
            assert (ROOT / name).is_file() or path == Path(__file__), f"{path} refers to {name}"
