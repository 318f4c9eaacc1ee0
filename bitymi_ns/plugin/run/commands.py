"""nerfstudio's other commands on our scenes: detection, refusal of unsupported ones, moved captures, and ns-viewer."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from bitymi_ns.bundle.parts import CONFIG, bundle_at
from bitymi_ns.plugin.console import fail

DATA = "BITYMI_DATA"
"""Environment variable: where a capture is now; most of nerfstudio's commands that read a run have no option for it."""
MOVED = f"If it was moved, say where it is now: `{DATA}=/where/it/is` before the command."
_MESH = (
    "`ns-export bitymi-mesh` writes the surface, a mesh whose vertices are points with colors; `bitymi extras BUNDLE` "
    "Gaussian splats."
)
REFUSED = {
    "ExportPointCloud": f"ns-export pointcloud needs rays, and surfels are drawn as whole pictures. {_MESH}",
    "ExportTSDFMesh": f"ns-export tsdf needs rays, and surfels are drawn as whole pictures. {_MESH}",
    "ExportPoissonMesh": f"ns-export poisson needs rays, and surfels are drawn as whole pictures. {_MESH}",
    "ExportMarchingCubesMesh": f"ns-export marching-cubes needs a field of distances, which surfels have not. {_MESH}",
    "ExportGaussianSplat": f"ns-export gaussian-splat is for splatfacto. {_MESH}",
}
"""Classes of nerfstudio's scripts that cannot work on surfels, and what does instead."""
SCRIPTS = ("nerfstudio.scripts.", "__main__")


def _callers() -> Iterator[FrameType]:
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        yield frame
        frame = frame.f_back


def folder_being_evaluated() -> Path | None:
    """The folder of the config.yml that nerfstudio's eval_setup is loading, which it does not pass on; else None."""
    for frame in _callers():
        if frame.f_code.co_name == "eval_setup" and isinstance(frame.f_locals.get("config_path"), Path):
            return frame.f_locals["config_path"].absolute().parent
    return None


def running_command() -> tuple[Any, dict[str, Any]] | None:
    """The object of nerfstudio's script whose main function is loading a scene, and its module's namespace; or None."""
    for frame in _callers():
        command = frame.f_locals.get("self")
        if frame.f_code.co_name == "main" and type(command).__module__.startswith(SCRIPTS):
            return command, frame.f_globals
    return None


def refuse_others() -> None:
    """Stop where the command that loads a scene cannot work on it, before it is loaded."""
    found = running_command()
    if found is not None and type(found[0]).__name__ in REFUSED:
        fail(REFUSED[type(found[0]).__name__])


def given_config() -> Path | None:
    """The --load-config of this process's command line; None without."""
    for i, argument in enumerate(sys.argv):
        name, _, value = argument.partition("=")
        if name in ("--load-config", "--load_config") and (value or i + 1 < len(sys.argv)):
            return Path(value or sys.argv[i + 1]).absolute()
    return None


def refuse_without_config(reader: str) -> None:
    """Stop where nerfstudio is about to load, as its own YAML, a bundle that has none.

    Args:
        reader: the command of ours that reads such bundles.
    """
    path = given_config()
    bundle = None if path is None else bundle_at(path)
    if bundle is None or reader in sys.argv[1:2]:
        return
    if bundle.is_file() or not (bundle / CONFIG).is_file():
        fail(
            f"{bundle} has no {CONFIG} for nerfstudio's commands: `bitymi unpack {bundle}` writes it as a folder with "
            "one; give that."
        )


def moved_capture(datamanager: Any) -> None:
    """Read the capture where `DATA` says it is now, if it says anything."""
    if not os.environ.get(DATA):
        return
    folder = Path(os.path.expanduser(os.environ[DATA])).absolute()
    if not folder.exists():
        fail(f"{DATA} names {folder} as the capture, which does not exist. Correct it.")
    datamanager.data = datamanager.dataparser.data = folder


def how_to_say_where() -> str:
    """Advice: the option or variable by which the running command finds its capture."""
    return "Give its folder with --data." if folder_being_evaluated() is None else MOVED


LOOPBACK = "127.0.0.1"
"""The address that only this machine can reach. nerfstudio's default, 0.0.0.0, is open to the network."""
HOST_OPTION = "--viewer.websocket-host"
VIEWER_SCRIPTS = ("nerfstudio.scripts.viewer.run_viewer", "__main__")


def adopt_viewer(config: Any) -> None:
    """Have ns-viewer, where it is the command that loads `config`, show this scene by our rules.

    ns-viewer replaces the recorded viewer options by those of its own command line, so config.yml cannot set the host;
    and it waits for Ctrl-C in a loop that ends in a traceback. Both are put right around its `_start_viewer`.
    """
    for name in VIEWER_SCRIPTS:
        script = sys.modules.get(name)
        if hasattr(script, "_start_viewer"):
            script._start_viewer = _ours_for(config, script._start_viewer)  # type: ignore[union-attr]


def _ours_for(config: Any, start: Any) -> Any:
    def start_viewer(shown: Any, *args: Any) -> None:
        if shown is not config:
            start(shown, *args)
            return
        for pipeline in args[:1]:  # photographs that are gone are no hindrance to it
            for name in ("train_dataset", "eval_dataset"):
                dataset = getattr(getattr(pipeline, "datamanager", None), name, None)
                if dataset is not None:
                    dataset.gray_images = True
        given = any(argument.partition("=")[0].replace("_", "-") == HOST_OPTION for argument in sys.argv)
        if shown.viewer.websocket_host == ViewerConfig().websocket_host and not given:
            shown.viewer.websocket_host = LOOPBACK
        CONSOLE.print("Ctrl-C ends the viewer.")
        try:
            start(shown, *args)
        except KeyboardInterrupt:
            CONSOLE.print("\nThe viewer has ended.")

    return start_viewer
