"""Entry points of nerfstudio's method registry. Every ns-* command loads them and handles no errors, so nothing here
raises: a method that fails to load reports why when it is used."""

import functools
import warnings
from dataclasses import dataclass
from typing import Annotated, Any

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification
from nerfstudio.utils.rich_utils import CONSOLE

from bitymi_ns.errors import KernelsUnavailable


@dataclass
class UnavailableConfig(TrainerConfig):
    """Stand-in for a method that failed to load."""

    reason: str = ""

    def set_timestamp(self) -> None:
        raise SystemExit(f"{self.method_name} is not available: {self.reason}")


@functools.cache
def _specification(name: str) -> MethodSpecification:
    try:
        from .run.config import method_config

        return method_config(name)
    except Exception as error:  # noqa: BLE001 - see the module's docstring
        reason = str(error) if isinstance(error, KernelsUnavailable) else f"{type(error).__name__}: {error}"
        warnings.warn(f"bitymi-ns: its methods are not available: {reason}", stacklevel=1)
        config = UnavailableConfig(method_name=name, reason=reason)
        return MethodSpecification(config=config, description=f"not available: {reason}")


def _install() -> None:
    """Make the changes of `hooks`, each even if another fails."""
    try:
        from . import hooks
        from .run import torchrun
    except Exception as error:  # noqa: BLE001 - see the module's docstring
        _warn("`ns-export bitymi-atlas` is not available", error)
        return
    CONSOLE.quiet = CONSOLE.quiet or not torchrun.own().first
    for change, lost in (
        (hooks.read_names_of_callers, "commands start slowly"),
        (lambda: hooks.extend_exporter(_exports), "`ns-export bitymi-atlas` is not available"),
    ):
        try:
            change()
        except Exception as error:  # noqa: BLE001 - see the module's docstring
            _warn(lost, error)
    hooks.find_config()


def _warn(lost: str, error: Exception) -> None:
    warnings.warn(f"bitymi-ns: {lost} ({type(error).__name__}: {error})", stacklevel=2)


def _exports() -> list[Any]:
    import tyro

    from .export.command import ExportAtlas
    from .export.mesh import ExportMesh
    from .hooks import COMMAND, MESH_COMMAND

    atlas = "Bake a trained bitymi scene into a bundle: surfels, a compressed texture atlas and a manifest."
    mesh = "Extract the surface of a trained bitymi scene or of a bundle as a triangle mesh with vertex colors."
    return [
        Annotated[ExportAtlas, tyro.conf.subcommand(name=COMMAND, description=atlas)],
        Annotated[ExportMesh, tyro.conf.subcommand(name=MESH_COMMAND, description=mesh)],
    ]


def __getattr__(name: str) -> MethodSpecification:
    """Make the registry entry of the preset `name`, with - for _."""
    if name.startswith("_"):
        raise AttributeError(name)
    return _specification(name.replace("_", "-"))


_install()
