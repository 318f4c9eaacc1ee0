"""Change nerfstudio's functions and what they read, where its registry and subclasses do not suffice. Each function
states what it changes, for which commands, what is lost without it, and what would make it superfluous."""

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType, SimpleNamespace, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from nerfstudio.configs import external_methods
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.errors import MarkupError

from bitymi_ns import exit_messages
from bitymi_ns.bundle.manifest import MANIFEST
from bitymi_ns.bundle.parts import CONFIG, bundle_at
from .console import fail
from .data.datamanager import BitymiDataManager
from .data.dataparser import BundleCamerasConfig, has_cameras
from .data.views import DATA
from .run import checkpoints, render
from .run.bundle_model import BakedModelConfig, check_same_capture
from .run.films import WholeText, open_gzip, write_image
from .run.surfel_model import SurfelModel

_MESH = (
    "`ns-export bitymi-mesh` writes the surface, a mesh whose vertices are points with colors; `bitymi extras BUNDLE` "
    "Gaussian splats."
)
_RAYS = "needs rays, and surfels are drawn as whole pictures"
REFUSED = {
    "ExportPointCloud": f"pointcloud {_RAYS}",
    "ExportTSDFMesh": f"tsdf {_RAYS}",
    "ExportPoissonMesh": f"poisson {_RAYS}",
    "ExportMarchingCubesMesh": "marching-cubes needs a field of distances, which surfels have not",
    "ExportGaussianSplat": "gaussian-splat is for splatfacto",
}
"""Classes of nerfstudio's exporter that cannot work on surfels: their commands, and why."""
COMMAND, MESH_COMMAND = "bitymi-atlas", "bitymi-mesh"
EXPORTER, VIEWER = "nerfstudio.scripts.exporter", "nerfstudio.scripts.viewer.run_viewer"
LOOPBACK = "127.0.0.1"  # reachable from this machine alone
HOST_OPTION = "--viewer.websocket-host"


def read_names_of_callers() -> None:
    """Have nerfstudio's list of external methods read its callers' names without opening their source files.

    Changes: `inspect` in the list's namespace, which asks for the stack 26 times. For: every ns-* command. Without: it
    takes half of a command's start. Superfluous once nerfstudio reads only the name that it needs.
    """
    listing: Any = external_methods
    listing.inspect = SimpleNamespace(
        stack=lambda: [SimpleNamespace(function=frame.f_code.co_name) for frame in _callers(2)]
    )


def extend_exporter(commands: Callable[[], Sequence[Any]]) -> None:
    """Add commands to ns-export.

    Changes: `tyro.cli` in the namespace of nerfstudio's script, which loads the plugin before it builds the union of
    its commands. For: ns-export. Without: `ns-export bitymi-atlas` and `bitymi-mesh` are unknown. Superfluous once
    nerfstudio has a registry of exports. `commands` is called with the first command line.
    """
    main = sys.modules.get("__main__")
    as_main = str(getattr(main, "__file__", "") or "").replace("\\", "/").endswith("nerfstudio/scripts/exporter.py")
    for module in (sys.modules.get(EXPORTER), main if as_main else None):
        tyro = getattr(module, "tyro", None)
        if tyro is None or isinstance(tyro, SimpleNamespace):
            continue

        def cli(f: Any, *args: Any, module: Any = module, tyro: Any = tyro, **options: Any) -> Any:
            if f is getattr(module, "Commands", None):
                try:
                    f = _with_members(f, commands())
                except Exception as error:  # noqa: BLE001 - nerfstudio's own commands go on working
                    cause = exit_messages.line_of(error) or error
                    warnings.warn(f"bitymi-ns: `ns-export {COMMAND}` is not available: {cause}", stacklevel=2)
            return tyro.cli(f, *args, **options)

        vars(module)["tyro"] = SimpleNamespace(**{**vars(tyro), "cli": cli})


def _with_members(union: Any, more: Sequence[Any]) -> Any:
    if get_origin(union) is Annotated:
        inner, *markers = get_args(union)
        return Annotated[(_with_members(inner, more), *markers)]
    members = get_args(union) if get_origin(union) in (Union, UnionType) else (union,)
    return Union[(*members, *more)]  # noqa: UP007 - built at run time


def find_config() -> None:
    """Take a folder's config.yml, and refuse what is missing, a bundle without one, or of an early version.

    Changes: --load-config in `sys.argv`. For: commands with that option but MESH_COMMAND, which reads bundles without
    config.yml. Without: tracebacks. Superfluous once nerfstudio reports these.
    """
    i, path = _given_config()
    if path is None or MESH_COMMAND in sys.argv[1:2]:
        return
    try:
        config, bundle = path / CONFIG if path.is_dir() else path, bundle_at(path)
        if bundle is not None and (bundle.is_file() or not (bundle / CONFIG).is_file()):
            fail(f"{bundle} has no {CONFIG} for nerfstudio: give the folder that `bitymi unpack {bundle}` writes.")
        if not config.is_file():
            fail(f"there is no {config}: give the {CONFIG} of a run (ns-train says where it is) or of a bundle.")
        if b"bitymi_ns.host." in config.read_bytes():
            fail(f"{config} is of an early version that cannot be read any more: train or export again.")
    except OSError as error:
        fail(f"{exit_messages.line_of(error)}.", error)
    if config != path:
        sys.argv[i] = f"--load-config={config}" if "=" in sys.argv[i] else str(config)


def _given_config() -> tuple[int, Path | None]:
    """Return the index in `sys.argv` and the path of --load-config; None without."""
    for i, argument in enumerate(sys.argv):
        name, equals, value = argument.partition("=")
        if name in ("--load-config", "--load_config") and (equals or i + 1 < len(sys.argv)):
            return (i, Path(value).absolute()) if equals else (i + 1, Path(sys.argv[i + 1]).absolute())
    return 0, None


def answer_checkpoint_dir(config: Any, usual: Callable[[], Path]) -> Path:
    """Find the folder of the checkpoints, and read the one that nerfstudio is about to load.

    Changes: the answer of the trainer configuration's `get_checkpoint_dir`, for which eval_setup asks before it builds
    the pipeline; reads config.yml's path in eval_setup's frame, and options in the script's. For: ns-eval, ns-render,
    ns-viewer, ns-export. Without: no moved run or bundle opens, and commands that cannot work end in tracebacks.
    Superfluous once eval_setup passes on the path that it loads.
    """
    model = config.pipeline.model
    evaluated = _folder_being_evaluated()
    running = _running_command()
    command = None if running is None else running[0]
    if evaluated is not None:
        exit_messages.install()
        refused = REFUSED.get(type(command).__name__)
        if refused is not None:
            fail(f"ns-export {refused}. {_MESH}")
        patch_viewer(config)
        patch_render()
        moved_capture(config.pipeline.datamanager)
    if isinstance(model, BakedModelConfig):
        model.bundle = _find_bundle(model.bundle, evaluated)
        config.read_from = evaluated
        datamanager = config.pipeline.datamanager
        data = datamanager.data or getattr(datamanager.dataparser, "data", None)
        if data is not None and not Path(data).exists() and has_cameras(model.bundle):
            gray = render.leave_out_photographs(command)
            datamanager.dataparser = BundleCamerasConfig(data=model.bundle, capture=Path(data), gray=gray)
            datamanager.data = model.bundle
        if evaluated is not None:  # no pickled data may lie in a bundle
            measured = type(command).__name__ == "ComputePSNR"
            check = partial(check_same_capture, model.bundle) if measured else None
            hand_over(config, model.bundle / MANIFEST, {"step": 0, "pipeline": {}}, check)
        return model.bundle
    folder = usual()
    if evaluated is not None:
        if (evaluated / config.relative_model_dir).is_dir():
            folder, config.read_from = evaluated / config.relative_model_dir, evaluated
        # a resumed run records the step it went on from
        if config.load_step is None or not checkpoints.path_of(folder, config.load_step).is_file():
            config.load_step = checkpoints.newest_step(folder)
        path = checkpoints.path_of(folder, config.load_step)
        hand_over(config, path, checkpoints.load(path, model.scene))
        config.take_poses_of(evaluated)
    return folder


def hand_over(ours: Any, path: Path, state: dict[str, Any], check: Callable[[Any], None] | None = None) -> None:
    """Have eval_setup load `state`, read from `path`, for the configuration `ours`, and `check` the pipeline.

    Changes: `eval_load_checkpoint` in eval_utils, once. For: as `answer_checkpoint_dir`. Without: nerfstudio reads
    the file by torch.load, which can run code of others, and no bundle opens. Superfluous once eval_setup asks the
    method for its state.
    """
    from nerfstudio.utils import eval_utils

    stock = eval_utils.eval_load_checkpoint

    def load(config: Any, pipeline: Any) -> tuple[Path, int]:
        if config is not ours:
            return stock(config, pipeline)
        eval_utils.eval_load_checkpoint = stock
        pipeline.load_pipeline(state["pipeline"], state["step"])
        if check is not None:
            check(pipeline)
        return path, state["step"]

    eval_utils.eval_load_checkpoint = load


def _callers(depth: int = 1) -> list[FrameType]:
    """Return the frames of the call stack outwards, from the one `depth` calls above this."""
    frame: FrameType | None = sys._getframe(depth)
    frames = []
    while frame is not None:
        frames.append(frame)
        frame = frame.f_back
    return frames


def _folder_being_evaluated() -> Path | None:
    """Find the folder of the config.yml that eval_setup is loading; else None."""
    for frame in _callers():
        if frame.f_code.co_name == "eval_setup" and isinstance(frame.f_locals.get("config_path"), Path):
            return frame.f_locals["config_path"].absolute().parent
    return None


def _running_command() -> tuple[Any, dict[str, Any]] | None:
    """Find the script object whose `main` is running, and its module's namespace; else None."""
    for frame in _callers():
        command = frame.f_locals.get("self")
        if frame.f_code.co_name == "main" and type(command).__module__.startswith(("nerfstudio.scripts.", "__main__")):
            return command, frame.f_globals
    return None


def _find_bundle(recorded: Path, evaluated: Path | None) -> Path:
    candidates = [] if evaluated is None else [evaluated]
    _, given = _given_config()
    candidates += [recorded] if given is None else [given.parent, recorded]
    for folder in candidates:
        if (folder / MANIFEST).is_file() or folder.is_file():
            return folder.absolute()
    tried = ", ".join(str(folder) for folder in dict.fromkeys(candidates))
    fail(f"no bundle found ({MANIFEST} is not in {tried}). Keep config.yml in the bundle's folder.")


def moved_capture(datamanager: Any) -> None:
    """Read the capture at the environment variable `DATA`, if it is set.

    Changes: the recorded path. For: as `answer_checkpoint_dir`. Without: runs and bundles are lost when their capture
    moves. Superfluous once these commands have an option --data.
    """
    if not os.environ.get(DATA):
        return
    folder = Path(os.path.expanduser(os.environ[DATA])).absolute()
    if not folder.exists():
        fail(f"{DATA} names {folder} as the capture, which does not exist. Correct it.")
    datamanager.data = datamanager.dataparser.data = folder


def patch_viewer(config: Any) -> None:
    """Have ns-viewer, if it loads `config`, serve this machine alone, end at Ctrl-C, and do without photographs.

    Changes: `_start_viewer` in nerfstudio's script, for this scene. For: ns-viewer. Without: the viewer is open to the
    network, as its command line replaces the recorded host; Ctrl-C ends in a traceback; bundles of lost photographs
    cannot be shown. Superfluous once ns-viewer does these.
    """
    script: Any
    for script in map(sys.modules.get, (VIEWER, "__main__")):
        if hasattr(script, "_start_viewer"):
            script._start_viewer = partial(_start_viewer, config, script._start_viewer)


def _start_viewer(ours: Any, start: Callable[..., None], config: Any, *args: Any) -> None:
    if config is not ours:
        start(config, *args)
        return
    for pipeline in args[:1]:
        for name in ("train_dataset", "eval_dataset"):
            dataset = getattr(getattr(pipeline, "datamanager", None), name, None)
            if dataset is not None:
                dataset.gray_images = True
    given = any(argument.partition("=")[0].replace("_", "-") == HOST_OPTION for argument in sys.argv)
    if config.viewer.websocket_host == ViewerConfig().websocket_host and not given:
        config.viewer.websocket_host = LOOPBACK
    CONSOLE.print("Ctrl-C ends the viewer.")
    try:
        start(config, *args)
    except KeyboardInterrupt:
        CONSOLE.print("\nThe viewer has ended.")


def patch_render() -> None:
    """Have ns-render or ns-eval check their options before loading the scene, and write whole results by this package.
    Raises InputError: an option or the camera path cannot be used.

    Changes: functions of the script that render and write, until it has rendered; ns-eval's output path. For:
    ns-render, ns-eval. Without: films need the program ffmpeg, spirals roll, principal points are ignored, options are
    checked after loading, and a full disk leaves half a file. Superfluous once nerfstudio does these.
    """
    running = _running_command()
    if running is None:
        return
    command, script = running
    kind = type(command).__name__
    if kind in (*render.TRAJECTORIES, "DatasetRender"):
        render.check_options(command)
    if kind == "ComputePSNR":
        command.output_path = WholeText(command.output_path)
        render.check_evaluation(command)
    if kind == "DatasetRender":
        script["media"], script["gzip"] = SimpleNamespace(write_image=write_image), SimpleNamespace(open=open_gzip)
    if kind not in render.TRAJECTORIES:
        return

    def render_trajectory(pipeline: Any, cameras: Any, seconds: float, **options: Any) -> None:
        script.update(stock)  # for another method in the same process
        if isinstance(pipeline.model, SurfelModel):
            crop = options.get("crop_data")
            pipeline.model.crop_to(None if crop is None else crop.obb)
            render.write_trajectory(pipeline.model, cameras, command, seconds)
        else:
            script["_render_trajectory_video"](pipeline, cameras, seconds=seconds, **options)

    ours: dict[str, Any] = dict(
        install_checks=SimpleNamespace(check_ffmpeg_installed=lambda: None),
        get_path_from_json=lambda found: render.with_principal_points(stock["get_path_from_json"](found), found),
        get_interpolated_camera_path=lambda **options: render.interpolated(
            stock["get_interpolated_camera_path"], **options
        ),
        get_spiral_path=lambda camera, **options: camera,
        _render_trajectory_video=render_trajectory,
    )
    names = (*ours, "VanillaDataManager")
    stock = getattr(script["_render_trajectory_video"], "stock", {name: script[name] for name in names})
    ours["VanillaDataManager"] = (stock["VanillaDataManager"], BitymiDataManager)  # a spiral is allowed for these
    vars(render_trajectory)["stock"] = stock
    script.update(ours)


@contextmanager
def print_brackets() -> Iterator[None]:
    """Have nerfstudio's console print a line whose brackets are no markup as it is.

    Changes: `print` and `log` of the console in the block. For: ns-train. Without: a bracket in a path ends the run.
    Superfluous once nerfstudio escapes what it prints.
    """
    stock = {name: getattr(CONSOLE, name) for name in ("print", "log")}

    def write(name: str, *said: Any, **options: Any) -> None:
        options |= {"_stack_offset": 2} if name == "log" else {}
        try:
            stock[name](*said, **options)
        except MarkupError:
            stock[name](*said, **{**options, "markup": False})

    try:
        for name in stock:
            setattr(CONSOLE, name, partial(write, name))
        yield
    finally:
        for name, function in stock.items():
            setattr(CONSOLE, name, function)
