"""A layer imports only lower layers, no two modules import each other, and only `plugin` and its measurements import
nerfstudio."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import bitymi_ns

PACKAGE = Path(bitymi_ns.__file__).parent
ORDER = ["ops", "scene", "codec", "bundle", "train", "bake", "interchange", "view", "plugin", "measure"]
BESIDE = "errors exit_messages files locks ply presets progress ranges safe_reading sample capture trust".split()
"""Modules beside the layers (ORDER, innermost first); these import no layer."""
KNOW_NERFSTUDIO = ("plugin",)


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in PACKAGE.rglob("*.py")}


def imports(path: Path) -> Iterator[tuple[str, bool]]:
    """Yield the full names of a module's imports, including relative and type-checking ones, and whether they run on
    import (not in a function or for type checking only)."""
    name = name_of(path)
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    pending: list[tuple[ast.AST, bool]] = [(ast.parse(path.read_text("utf8")), True)]
    while pending:
        node, loads = pending.pop()
        if isinstance(node, ast.Import):
            yield from ((alias.name, loads) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            start = ".".join([*above, *([node.module] if node.module else [])])
            yield from ((f"{start}.{alias.name}", loads) for alias in node.names)
        later = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        typed = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        pending += ((child, loads and not later and not typed) for child in ast.iter_child_nodes(node))


def module_of(name: str) -> str | None:
    while name and name not in MODULES:
        name = name.rpartition(".")[0]
    return name or None


@pytest.mark.parametrize("layer", ORDER)
def test_a_layer_imports_only_what_stands_below(layer: str) -> None:
    above = {f"bitymi_ns.{name}" for name in [*ORDER[ORDER.index(layer) + 1 :], "api", "cli"]}
    for path in (PACKAGE / layer).rglob("*.py"):
        for name, _ in imports(path):
            assert ".".join(name.split(".")[:2]) not in above, f"{path} imports {name}"


@pytest.mark.parametrize("name", BESIDE)
def test_what_stands_beside_the_layers_imports_none_of_them(name: str) -> None:
    layers = {f"bitymi_ns.{layer}" for layer in [*ORDER, "api", "cli"]}
    for path in [path for module, path in MODULES.items() if f"{module}.".startswith(f"bitymi_ns.{name}.")]:
        for imported, _ in imports(path):
            assert ".".join(imported.split(".")[:2]) not in layers, f"{path} imports {imported}"


def test_no_module_imports_what_the_package_itself_defines() -> None:
    """It names public functions and the version for users; modules are imported from where they stand."""
    for module, path in MODULES.items():
        found = [name for name, _ in imports(path) if module_of(name) == "bitymi_ns" and name != "bitymi_ns"]
        assert module == "bitymi_ns" or not found, f"{path} imports {found}"


def test_imports_within_a_layer_are_relative() -> None:
    for module, path in MODULES.items():
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        package = ".".join(package.split(".")[:2])
        for node in ast.walk(ast.parse(path.read_text("utf8"))):
            if isinstance(node, ast.ImportFrom) and not node.level:
                assert not f"{node.module}.".startswith(f"{package}."), f"{path} imports {node.module}"


def test_nerfstudio_is_known_to_the_plugin_and_to_what_measures_it_alone() -> None:
    for path in PACKAGE.rglob("*.py"):
        knows = path.relative_to(PACKAGE).as_posix().startswith(KNOW_NERFSTUDIO)
        names = [name for name, _ in imports(path) if name.split(".")[0] == "nerfstudio"]
        assert knows or not names, f"{path} imports {names}"


def test_no_two_modules_import_each_other() -> None:
    """Nor indirectly. Imports in functions and for type checking count, except a package's own."""
    graph = {}
    for name, path in MODULES.items():
        found = {module_of(imported) for imported, _ in imports(path)} - {None, name}
        if path.name == "__init__.py":  # re-exports its modules, which do not import it
            found = {other for other in found if not other.startswith(name + ".")}
        graph[name] = {other for other in found if not name.startswith(f"{other}.")}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(error.args[1]))


@pytest.mark.slow
def test_reading_a_bundle_loads_neither_the_bake_nor_the_training() -> None:
    code = (
        "import sys; from bitymi_ns.bundle import check_files, read_bundle, write_bundle; "
        "print([m for m in sys.modules if m.startswith(('bitymi_ns.bake', 'bitymi_ns.train'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_a_scene_can_be_built_and_trained_without_nerfstudio() -> None:
    code = (
        "import sys; sys.modules['nerfstudio'] = None; import bitymi_ns, bitymi_ns.bake; "
        "bitymi_ns.train_scene, bitymi_ns.rasterize, bitymi_ns.read_bundle"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
