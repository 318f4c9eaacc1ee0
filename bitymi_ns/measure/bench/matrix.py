"""Benchmark matrix: scenes x rows x seeds, the cells of each run; standard data sets and plans by name."""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypedDict

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bitymi_ns.capture.recognise import recognise
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.measure.bench.cells import NOT_OF_A_RUN, identity
from bitymi_ns.measure.bench.process import BenchError
from bitymi_ns.presets import preset_names
from bitymi_ns.ranges import describe_problems
from bitymi_ns.safe_reading import read_text, reading


@dataclass(frozen=True)
class SceneSpec:
    """A capture and its dataparser."""

    name: str  # label in tables, and nerfstudio's experiment name
    data: Path  # absolute folder
    suite: str = "local"  # name of the data set, or `local`
    parser: tuple[str, ...] = ()  # nerfstudio's dataparser and its options; empty: the method's own


@dataclass(frozen=True)
class MethodSpec:
    """A method of the bench: its nerfstudio method with further options of ns-train."""

    name: str
    method: str
    options: tuple[str, ...] = ()

    @property
    def ours(self) -> bool:
        """True for a method of this package; only these are baked and have a training curve."""
        return self.method in preset_names()


@dataclass(frozen=True)
class BundleSpec:
    """Named options of `ns-export bitymi-atlas`."""

    name: str
    options: tuple[str, ...]


@dataclass(frozen=True)
class CellSpec:
    """A cell of the matrix: a training run, or an evaluation or export of its scene or of a bundle."""

    scene: SceneSpec
    row: MethodSpec
    seed: int | None = None  # None: the method's own
    steps: int | None = None  # length of the run; None: the method's own for this machine
    kind: Literal["train", "eval", "export"] = "train"
    bundle: BundleSpec | None = None

    @property
    def key(self) -> dict[str, Any]:
        """All settings that affect the result of the cell."""
        key: dict[str, Any] = {
            "cell": self.kind,
            "suite": self.scene.suite,
            "row": self.row.name,
            "scene": self.scene.name,
            "data": str(self.scene.data),
            "parser": list(self.scene.parser),
            "method": self.row.method,
            "options": list(self.row.options),
            "steps": self.steps,
            "seed": self.seed,
        }
        if self.bundle is not None:
            key |= {"bundle": self.bundle.name, "export": list(self.bundle.options)}
        return key

    @property
    def run_name(self) -> str:
        """Folder name of the run, unique among those of a method on a capture."""
        digest = hashlib.sha256(identity(self.key, *NOT_OF_A_RUN).encode()).hexdigest()[:8]
        length = "own-length" if self.steps is None else f"{self.steps}-steps"
        return f"{length}{'' if self.seed is None else f'-seed{self.seed}'}-{digest}"

    @property
    def folder(self) -> str:
        """Path of the run below runs/, bundles/, evals/ and logs/ of the work folder."""
        return f"{self.scene.name}/{self.row.method}/{self.run_name}"

    @property
    def form(self) -> str:
        """Name of the bundle, or `trained`."""
        return self.bundle.name if self.bundle else "trained"

    @property
    def output(self) -> Path:
        """Path in the work folder of the output: a folder, or the file of an evaluation, beside the folder of its
        pictures."""
        folders = {"train": Path("runs", self.folder), "export": Path("bundles", self.folder, self.form)}
        return folders.get(self.kind, Path("evals", self.folder, f"{self.form}.json"))

    @property
    def parent(self) -> "CellSpec":
        """The cell whose config.yml this one uses; the training itself for the training."""
        if self.kind == "eval" and self.bundle is not None:
            return replace(self, kind="export")
        return replace(self, kind="train", bundle=None)

    @property
    def run(self) -> str:
        """Title of the run, for messages."""
        return f"{self.scene.name}, {self.row.name}" + ("" if self.seed is None else f", seed {self.seed}")

    def __str__(self) -> str:
        what = {"train": "training", "eval": f"evaluation ({self.form})", "export": f"export ({self.form})"}
        return f"{self.run}: {what[self.kind]}"


Chain = list[CellSpec]  # the cells of one run; each may depend on those before it


def chains(
    scenes: Sequence[SceneSpec],
    rows: Sequence[MethodSpec],
    seeds: Sequence[int] = (),
    steps: int | None = None,
    bundles: Sequence[BundleSpec] = (),
) -> list[Chain]:
    """List the cells of each run in the order of their dependencies: each row is trained on each scene with each seed
    (empty: once, with the method's own), then baked to each bundle."""
    listed: list[Chain] = []
    for scene, row, seed in product(scenes, rows, list(seeds) or [None]):
        train = CellSpec(scene, row, seed, steps)
        listed.append([train, replace(train, kind="eval")])
        for bundle in bundles if row.ours else ():
            listed[-1] += [replace(train, kind="export", bundle=bundle), replace(train, kind="eval", bundle=bundle)]
    return listed


Format = Literal["fp16", "uint8", "bc7", "compact"]  # of `ns-export bitymi-atlas`


class Suite(TypedDict):
    """A standard data set, an entry of suites.yaml."""

    title: str
    scenes: dict[str, int]  # name -> downscale factor of the images relative to COLMAP's
    needed: list[str]  # required files and folders of a scene
    parser: str  # dataparser with its options


def _read(path: Path) -> Any:
    with reading(path, _refuse):
        try:
            return yaml.safe_load(read_text(path))
        except yaml.YAMLError as error:
            raise ValueError(" ".join(str(error).split())) from error


def _refuse(message: str, cause: BaseException) -> NoReturn:
    raise BenchError(message) from cause


def suites() -> dict[str, Suite]:
    """Read the standard data sets, by name."""
    return _read(Path(__file__).with_name("suites.yaml"))


def local_scenes(folders: Sequence[Path]) -> list[SceneSpec]:
    """List captures in any format that `ns-train bitymi --data` accepts. A Blender data set uses the points of its
    `hull_pc.ply`, if any. Raises BenchError: a folder is not a capture, two have the same name, or there is none."""
    if not folders:
        raise BenchError('no capture: give --data with one or more folders, as in --data "captures/fox"')
    scenes = []
    for folder in folders:
        folder = Path(os.path.expanduser(folder)).resolve()
        try:
            found = recognise(folder)
        except CaptureError as error:
            raise BenchError(f"{folder} is not a capture: {error}") from error
        if found.format == "blender":
            points = ("--ply-path", "hull_pc.ply") if (found.path / "hull_pc.ply").is_file() else ()
            scenes.append(SceneSpec(folder.name, found.path, parser=("blender-data", *points)))
        else:
            scenes.append(SceneSpec(folder.name, folder))
    names = [scene.name for scene in scenes]
    if len(set(names)) < len(names):
        raise BenchError(f"captures need folders of different names, not {', '.join(names)}")
    return scenes


def standard_scenes(name: str, root: Path, only: Sequence[str] = ()) -> list[SceneSpec]:
    """List the scenes of a standard data set. Raises BenchError: a scene does not exist, or its folder lacks required
    files."""
    suite, scenes = suites()[name], []
    unknown = sorted(set(only) - set(suite["scenes"]))
    if unknown:
        raise BenchError(f"{name} has no scene {', '.join(unknown)}; it has {', '.join(suite['scenes'])}")
    for scene in only or suite["scenes"]:
        folder, factor = Path(os.path.expanduser(root)).resolve() / scene, suite["scenes"][scene]
        needed = [part.format(images="images" if factor == 1 else f"images_{factor}") for part in suite["needed"]]
        missing = [part for part in needed if not (folder / part).exists()]
        if missing:
            raise BenchError(
                f"{folder} is not {suite['title']}'s {scene}: there is no {' and no '.join(missing)}. --data is the "
                f"folder that holds the scenes; --scenes {scene} ... chooses some of them"
            )
        scenes.append(SceneSpec(scene, folder, name, tuple(suite["parser"].format(factor=factor).split())))
    return scenes


Words = list[str | int | float]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._+-]*$")]


class _PlanRow(BaseModel):
    model_config = ConfigDict(extra="forbid")
    method: Name
    options: Words = []


class _Plan(BaseModel):
    model_config = ConfigDict(extra="forbid")
    rows: Annotated[dict[str | int | float, _PlanRow], Field(min_length=1)]
    bundles: dict[Name, Words] | None = None


def read_plan(name: str) -> tuple[list[MethodSpec], list[BundleSpec] | None]:
    """Read a plan by name, or from a YAML file. Returns rows, and bundles or None if the plan states none. Raises
    BenchError: the plan does not exist or is malformed; the message says where."""
    if name.endswith((".yaml", ".yml")):
        entry = _read(Path(os.path.expanduser(name)))
    else:
        plans = _read(Path(__file__).with_name("plans.yaml"))
        if name not in plans:
            raise BenchError(f"there is no plan {name}: give {', '.join(plans)}, or a file that ends in .yaml")
        entry = plans[name]
    try:
        plan = _Plan.model_validate(entry)
    except ValidationError as error:
        raise BenchError(
            f"plan {name}: {describe_problems(error)}; a plan has rows, NAME: {{method: NAME, options: [...]}}, and "
            "optionally bundles, NAME: [options of ns-export bitymi-atlas]"
        ) from error
    rows = [MethodSpec(str(title), row.method, tuple(map(str, row.options))) for title, row in plan.rows.items()]
    if plan.bundles is None:
        return rows, None
    return rows, [BundleSpec(title, tuple(map(str, options))) for title, options in plan.bundles.items()]
