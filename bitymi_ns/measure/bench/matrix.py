"""Benchmark matrix: scenes x rows x seeds, the cells of each run; standard data sets and plans by name."""

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import yaml

from bitymi_ns.capture.recognise import recognise
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.presets import preset_names
from .cells import NOT_OF_A_RUN, identity
from .process import BenchError

Format = Literal["fp16", "uint8", "bc7", "compact"]  # of `ns-export bitymi-atlas`
PlanName = Literal["ablation", "overdraw", "resolution", "atlas", "rate"]  # in plans.yaml


@dataclass(frozen=True)
class Scene:
    """A capture and its dataparser."""

    scene: str  # nerfstudio's experiment name
    data: str  # absolute folder
    suite: str = "local"  # name of the data set, or `local`
    parser: tuple[str, ...] = ()  # dataparser and its options; empty: the method's own


class Row(NamedTuple):
    """A method of nerfstudio with further options of ns-train."""

    method: str
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class Cell(Scene):
    """A training, evaluation or export: all settings that affect its result."""

    row: str = ""
    method: str = ""
    options: tuple[str, ...] = ()
    seed: int | None = None  # None: the method's own
    steps: int | None = None  # length of the run; None: the method's own for this machine
    cell: Literal["train", "eval", "export"] = "train"
    bundle: str = ""
    export: tuple[str, ...] = ()  # options of the bundle

    @property
    def key(self) -> dict[str, Any]:
        """The settings as they are stored."""
        return {name: value for name, value in vars(self).items() if self.bundle or name not in ("bundle", "export")}

    @property
    def ours(self) -> bool:
        """True for a method of this package; only these are baked and have a training curve."""
        return self.method in preset_names()

    @property
    def folder(self) -> str:
        """Path of the run below runs/, bundles/, evals/ and logs/ of the work folder."""
        digest = hashlib.sha256(identity(self.key, *NOT_OF_A_RUN).encode()).hexdigest()[:8]
        length = "own-length" if self.steps is None else f"{self.steps}-steps"
        seed = "" if self.seed is None else f"-seed{self.seed}"
        return f"{self.scene}/{self.method}/{length}{seed}-{digest}"

    @property
    def form(self) -> str:
        """Name of the bundle, or `trained`."""
        return self.bundle or "trained"

    @property
    def output(self) -> Path:
        """Path in the work folder of the output: a folder, or an evaluation's file."""
        folders = {"train": Path("runs", self.folder), "export": Path("bundles", self.folder, self.form)}
        return folders.get(self.cell, Path("evals", self.folder, f"{self.form}.json"))

    @property
    def parent(self) -> "Cell":
        """The cell whose config.yml this one uses; of a training itself."""
        if self.cell == "eval" and self.bundle:
            return replace(self, cell="export")
        return replace(self, cell="train", bundle="", export=())

    @property
    def run(self) -> str:
        """Title of the run, for messages."""
        return f"{self.scene}, {self.row}" + ("" if self.seed is None else f", seed {self.seed}")

    def __str__(self) -> str:
        what = {"train": "training", "eval": f"evaluation ({self.form})", "export": f"export ({self.form})"}
        return f"{self.run}: {what[self.cell]}"


Chain = list[Cell]  # the cells of one run; each may depend on those before it


def chains(
    scenes: Sequence[Scene],
    rows: Mapping[str, Row],
    bundles: Mapping[str, Sequence[str]],
    seeds: Sequence[int] = (),
    steps: int | None = None,
) -> list[Chain]:
    """List the cells of each run, in the order of their dependencies: each row is trained on each scene with each seed
    (empty: the method's own), then baked to each bundle."""
    listed: list[Chain] = []
    for scene, (name, row), seed in product(scenes, rows.items(), list(seeds) or [None]):
        train = Cell(**vars(scene), row=name, method=row.method, options=row.options, seed=seed, steps=steps)
        listed.append([train, replace(train, cell="eval")])
        for bundle, options in bundles.items() if train.ours else ():
            export = replace(train, cell="export", bundle=bundle, export=tuple(options))
            listed[-1] += [export, replace(export, cell="eval")]
    return listed


@cache
def _read(name: str) -> Any:
    """Read a YAML file of this folder."""
    return yaml.safe_load(Path(__file__).with_name(name).read_text("utf8"))


def suites() -> dict[str, dict[str, Any]]:
    """Read the standard data sets by name; suites.yaml says what their entries are."""
    return _read("suites.yaml")


def read_plan(name: PlanName) -> tuple[dict[str, Row], dict[str, list[str]]]:
    """Read a plan: rows to train and bundles to bake (options of `ns-export bitymi-atlas`), by name."""
    plan = _read("plans.yaml")[name]
    rows = {title: Row(row["method"], tuple(row.get("options", ()))) for title, row in plan["rows"].items()}
    return rows, plan["bundles"]


def local_scenes(folders: Sequence[Path]) -> list[Scene]:
    """List captures in any format; a Blender data set uses the points of its `hull_pc.ply`, if any. Raises BenchError:
    a folder is not a capture, two have the same name, or there is none."""
    if not folders:
        raise BenchError('no capture: give --data with one or more folders, as in --data "captures/fox"')
    scenes = []
    for folder in folders:
        folder = Path(os.path.expanduser(folder)).resolve()
        try:
            capture = recognise(folder)
        except CaptureError as error:
            raise BenchError(f"{folder} is not a capture: {error}") from error
        if capture.format == "blender":
            points = ("--ply-path", "hull_pc.ply") if (capture.path / "hull_pc.ply").is_file() else ()
            scenes.append(Scene(folder.name, str(capture.path), parser=("blender-data", *points)))
        else:
            scenes.append(Scene(folder.name, str(folder)))
    names = [scene.scene for scene in scenes]
    if len(set(names)) < len(names):
        raise BenchError(f"captures need folders of different names, not {', '.join(names)}")
    return scenes


def standard_scenes(name: str, root: Path, only: Sequence[str] = ()) -> list[Scene]:
    """List the scenes of a standard data set. Raises BenchError: a scene does not exist, or its folder lacks files."""
    suite, scenes = suites()[name], []
    unknown = sorted(set(only) - set(suite["scenes"]))
    if unknown:
        raise BenchError(f"{name} has no scene {', '.join(unknown)}; it has {', '.join(suite['scenes'])}")
    for scene in only or suite["scenes"]:
        folder = Path(os.path.expanduser(root)).resolve() / scene
        factor = suite["scenes"][scene]
        needed = [part.format(images="images" if factor == 1 else f"images_{factor}") for part in suite["needed"]]
        missing = [part for part in needed if not (folder / part).exists()]
        if missing:
            raise BenchError(
                f"{folder} is not {suite['title']}'s {scene}: there is no {' and no '.join(missing)}. --data is the "
                "folder that holds the scenes; --scenes chooses some of them"
            )
        scenes.append(Scene(scene, str(folder), name, tuple(suite["parser"].format(factor=factor).split())))
    return scenes
