"""Prose uses the field's words: documentation, comments, docstrings, messages; docstrings begin with a verb."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.test_docs import tracked, without_blocks

WORDS = (
    "*.md",
    "Makefile",
    "method_configs/*.yaml",
    "examples/*.py",
    "csrc/*",
    "benchmarks/*.py",
    "scripts/*.py",
    "bitymi_ns/*.py",
    "bitymi_ns/ops/shaders/*",
    "bitymi_ns/measure/templates/*",
)
"""Files checked for BANNED."""
DOCSTRINGS = ("examples/*.py", "benchmarks/*.py", "scripts/*.py", "bitymi_ns/*.py")
"""Python files whose docstrings are checked for QUESTION."""
COMMENTS = ("csrc/*",)
"""C++ files whose comments are."""
BANNED = {
    r"\bby lot\b": "at random",
    r"\bset(?:s|ting)?[- ]aside\b": "validation views; held back",
    r"(?i:\bworthwhile\b)": "by rate-distortion; lambda",
    r"\bpacks\b|\bpack of (?:4|16|pixels)|\ba pack at a time": "block4x4; lanes",
    r"\bLooks\b|\ba look at the|\bviews that are looked (?:at|through)": "evaluation; sampled views",
    r"\b(?:price of a bit|one price|price and worth|worth of a bit)\b": "lambda",
    r"\b(?:given|photographed|learned|finding|several|quiet|holdout|looks|places)\.py\b": "the module's subject",
    r"\bgiven places\b|\bits place in the list\b": "fragment_ids; offset",
    r"\brules keep it from\b|\bin silence\b|\bwithout a word\b|\bwith a word\b": "messages; silently",
    r"\bit is said\b|\b(?:that|which|what) is said\b|\bis said to\b": "a message says; reported",
    r"\bseeing it takes\b": "coverage prior",
    r"\bbegins? anew\b|\banew\b": "again; starts over",
    r"\breckon(?:ed|s|ing)?\b": "estimated",
    r"\bsurfels? (?:that )?speaks?\b|\bspeak to them\b": "affect",
    r"\bwhat a run's own\b|(?<!-)\bthinned\b": "limits; sampled",
    r"\blot of surfels\b|\bhouse word": "surfels",
    r"\b(?:through_pixel|kPacks?|list_places)\b|\bPack<": "blocks; ids; Lanes",
}
"""Pattern: replacement."""
QUESTION = re.compile(r"(?:What|Whether|How|Where|Who|Which|When)\b")
"""Start of a docstring that does not say what the code does."""


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line numbers and prose: Markdown without code, comments and strings of Python, other files whole."""
    text = path.read_text("utf8")
    if path.suffix == ".py":
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type in (tokenize.COMMENT, tokenize.STRING) or tokenize.tok_name[token.type] == "FSTRING_MIDDLE":
                yield token.start[0], " ".join(token.string.split())
        return
    if path.suffix == ".md":
        text = re.sub(r"`[^`\n]*`", "`", without_blocks(text))
    for paragraph in re.finditer(r"(?:[^\n]+\n?)+", text):
        yield text.count("\n", 0, paragraph.start()) + 1, " ".join(paragraph[0].split())


def found(path: Path) -> list[str]:
    """List banned words of a file, with line and replacement."""
    return [
        f"{path}:{number}: '{match[0]}', say: {instead}"
        for number, line in prose(path)
        for pattern, instead in BANNED.items()
        for match in re.finditer(pattern, line)
    ]


def questions(path: Path) -> list[str]:
    """List docstrings of a Python file, or comments of another one, that begin with a question word."""
    if path.suffix != ".py":
        comments = re.findall(r"(?:^[ \t]*//.*\n)+", path.read_text("utf8"), re.MULTILINE)
        texts = [comment.splitlines()[0].strip("/ ") for comment in comments]
        return [f"{path}: {text}" for text in texts if QUESTION.match(text)]
    nodes = ast.walk(ast.parse(path.read_text("utf8")))
    documented = [node for node in nodes if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))]
    texts = [(getattr(node, "name", path.stem), ast.get_docstring(node) or "") for node in documented]
    return [f"{path}: {name}: {text.splitlines()[0]}" for name, text in texts if QUESTION.match(text)]


FILES = tracked(*WORDS)


@pytest.mark.skipif(not FILES, reason="not a git checkout")
def test_no_banned_words() -> None:
    assert not [line for path in FILES for line in found(path)]


@pytest.mark.skipif(not FILES, reason="not a git checkout")
def test_docstrings_begin_with_what_is_done() -> None:
    assert not [line for path in tracked(*DOCSTRINGS, *COMMENTS) for line in questions(path)]
