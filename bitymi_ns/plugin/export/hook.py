"""Add `bitymi-atlas` and `bitymi-mesh` to nerfstudio's `ns-export`, which has no registry: its script builds the union
of commands after this plugin is loaded, and hands it to `tyro.cli`, so its own reference to tyro is replaced by a proxy
that adds members to that union. tyro itself is left alone."""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import sys
import warnings
from collections.abc import Callable
from types import ModuleType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

EXPORTER = "nerfstudio.scripts.exporter"
COMMAND, MESH_COMMAND = "bitymi-atlas", "bitymi-mesh"
DESCRIPTION = "Bake a trained bitymi scene into a bundle: surfels, a compressed texture atlas and a manifest."
MESH_DESCRIPTION = "Extract the surface of a trained bitymi scene or of a bundle as a triangle mesh with vertex colors."


def install() -> None:
    """Patch the exporter module: now where it is being imported already, else as soon as it is."""
    modules = [sys.modules.get(EXPORTER)]
    main = sys.modules.get("__main__")
    spec, file = getattr(main, "__spec__", None), str(getattr(main, "__file__", "") or "").replace("\\", "/")
    if (spec is not None and spec.name == EXPORTER) or file.endswith("nerfstudio/scripts/exporter.py"):
        modules.append(main)
    present = [module for module in modules if module is not None]
    for module in present:
        patch(module)
    if not present and not any(isinstance(finder, _ExporterFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _ExporterFinder())


def patch(module: ModuleType) -> None:
    """Put the proxy into a module that has bound tyro; a second call changes nothing."""
    tyro = getattr(module, "tyro", None)
    if tyro is not None and not isinstance(tyro, _TyroProxy):
        module.tyro = _TyroProxy(tyro, module)  # type: ignore[attr-defined]


def extended(commands: Any) -> Any:
    """The union of ns-export's commands with ours as further members; markers around it are kept."""
    if get_origin(commands) is Annotated:
        inner, *markers = get_args(commands)
        return Annotated[(extended(inner), *markers)]  # type: ignore[return-value]
    import tyro

    from bitymi_ns.plugin.export import command, mesh

    atlas = tyro.conf.subcommand(name=COMMAND, description=DESCRIPTION)
    surface = tyro.conf.subcommand(name=MESH_COMMAND, description=MESH_DESCRIPTION)
    ours = (Annotated[command.ExportAtlas, atlas], Annotated[mesh.ExportMesh, surface])
    members = get_args(commands) if get_origin(commands) in (Union, UnionType) else (commands,)
    return Union[(*members, *ours)]  # noqa: UP007 - built at run time


class _TyroProxy:
    """tyro, or its `extras`, but for the functions that take the union of commands."""

    def __init__(self, target: Any, module: ModuleType) -> None:
        self._target, self._module = target, module

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._target, name)
        if name == "extras":
            return _TyroProxy(found, self._module)
        if name in ("cli", "get_parser"):
            return lambda f, *args, **kwargs: found(self._with_ours(f), *args, **kwargs)
        return found

    def _with_ours(self, f: Any) -> Any:
        if f is not getattr(self._module, "Commands", None):
            return f
        try:
            return extended(f)
        except Exception as error:  # noqa: BLE001 - nerfstudio's own commands have to go on working
            warnings.warn(f"bitymi-ns: `ns-export {COMMAND}` is not available: {error}", stacklevel=3)
            return f


class _ExporterFinder(importlib.abc.MetaPathFinder):
    """Patches the exporter module after its import, once; finds nothing itself."""

    def find_spec(
        self, name: str, path: Any, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != EXPORTER:
            return None
        sys.meta_path.remove(self)
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader.exec_module = _then_patch(spec.loader.exec_module)  # type: ignore[method-assign]
        return spec


def _then_patch(execute: Callable[[ModuleType], None]) -> Callable[[ModuleType], None]:
    def exec_module(module: ModuleType) -> None:
        execute(module)
        patch(module)

    return exec_module
