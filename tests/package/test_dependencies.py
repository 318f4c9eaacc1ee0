"""Imports equal the declared dependencies, without transitive ones."""

import ast
import re
import sys
from pathlib import Path

import pytest
import yaml

import bitymi_ns

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("pip._vendor.tomli")

PACKAGE = Path(bitymi_ns.__file__).parent
PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text("utf8"))["project"]
MODULES = {"opencv_python_headless": "cv2", "pillow": "PIL", "pyyaml": yaml.__name__, "usd_core": "pxr"}
"""Import names that differ from the package's name."""


def declared() -> set[str]:
    """List the import names of dependencies and extras."""
    extras = PROJECT["optional-dependencies"]
    listed = PROJECT["dependencies"] + [line for name, lines in extras.items() if name != "dev" for line in lines]
    names = [re.split(r"[^\w-]", line)[0].replace("-", "_") for line in listed]
    return {MODULES.get(name, name) for name in names}


def imported() -> dict[str, Path]:
    """Map top-level names of imported packages to a module that imports them."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            else:
                continue
            found |= {name.partition(".")[0]: path for name in names}
    return {name: path for name, path in found.items() if name not in {*sys.stdlib_module_names, PACKAGE.name}}


def test_every_import_is_declared() -> None:
    missing = {name: str(path) for name, path in imported().items() if name not in declared()}
    assert len(imported()) > 10 and not missing
