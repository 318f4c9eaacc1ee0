"""Entry points of nerfstudio's method registry (pyproject.toml), one name per method. nerfstudio loads them without any
error handling, from every ns-* command, so nothing here raises: a method that cannot be set up is registered under its
name and says why when it is used."""

import warnings
from dataclasses import dataclass

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification

from bitymi_ns import KernelsUnavailable


@dataclass
class UnavailableConfig(TrainerConfig):
    """Stands in for a method that could not be set up: reports the reason as soon as it is used."""

    reason: str = ""
    """The reason that the method is not available."""

    def set_timestamp(self) -> None:
        raise SystemExit(f"{self.method_name} is not available: {self.reason}")


def _specification(name: str) -> MethodSpecification:
    try:
        from bitymi_ns.plugin.run.config import method_config

        return method_config(name)
    except Exception as error:  # noqa: BLE001 - see the module's docstring
        reason = str(error) if isinstance(error, KernelsUnavailable) else f"{type(error).__name__}: {error}"
        warnings.warn(f"bitymi-ns: its methods are not available: {reason}", stacklevel=1)
        return MethodSpecification(
            config=UnavailableConfig(method_name=name, reason=reason), description=f"not available: {reason}"
        )


def _install() -> None:
    """Additions to nerfstudio that do not pass through its registry."""
    try:
        from bitymi_ns.plugin.run import checkpoints

        checkpoints.allow_numpy_scalars()
    except Exception as error:  # noqa: BLE001 - see the module's docstring
        why = f"{type(error).__name__}: {error}"
        warnings.warn(f"bitymi-ns: checkpoints of nerfstudio's own methods may not load ({why})", stacklevel=1)
    try:
        from bitymi_ns.plugin.export import hook

        hook.install()
    except Exception as error:  # noqa: BLE001
        warnings.warn(
            f"bitymi-ns: `ns-export bitymi-atlas` is not available ({type(error).__name__}: {error}); "
            "use `python -m bitymi_ns.plugin.export.command` instead",
            stacklevel=1,
        )
    try:
        from bitymi_ns.plugin.export.hook import MESH_COMMAND
        from bitymi_ns.plugin.run.commands import refuse_without_config
    except Exception:  # noqa: BLE001 - a method that is not available says so
        return
    refuse_without_config(MESH_COMMAND)


_install()
bitymi = _specification("bitymi")
bitymi_quality = _specification("bitymi-quality")
bitymi_fast = _specification("bitymi-fast")
bitymi_sh = _specification("bitymi-sh")
bitymi_sb = _specification("bitymi-sb")
bitymi_sg = _specification("bitymi-sg")
bitymi_field = _specification("bitymi-field")
bitymi_notexture = _specification("bitymi-notexture")
