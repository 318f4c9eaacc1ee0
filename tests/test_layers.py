"""A layer imports only what stands below it, and nerfstudio is known to the outermost one alone."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import bitymi_ns

PACKAGE = Path(bitymi_ns.__file__).parent
ORDER = ["ops", "scene", "stability", "train", "bake", "report", "bench", "host"]
"""Innermost first. `report` reads files alone, `bench` runs commands; `host` takes the name of the machine from it."""


def imports(path: Path) -> Iterator[str]:
    """Modules that a file imports when it runs; those for the type checker alone are left out."""
    pending: list[ast.AST] = [ast.parse(path.read_text("utf8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            pending += node.orelse
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        pending += ast.iter_child_nodes(node)


@pytest.mark.parametrize("layer", ORDER)
def test_a_layer_imports_only_what_stands_below(layer: str) -> None:
    above = {f"bitymi_ns.{name}" for name in ORDER[ORDER.index(layer) + 1 :]}
    for path in (PACKAGE / layer).rglob("*.py"):
        for name in imports(path):
            parts = name.split(".")
            assert ".".join(parts[:2]) not in above, f"{path} imports {name}"
            assert layer == "host" or parts[0] != "nerfstudio", f"{path} imports {name}"


def test_a_scene_can_be_built_and_trained_without_nerfstudio() -> None:
    modules = "bitymi_ns.train.domain, bitymi_ns.train.fit, bitymi_ns.bake, bitymi_ns.scene.baked"
    code = f"import sys; sys.modules['nerfstudio'] = None; import {modules}"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
