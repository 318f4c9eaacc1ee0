"""What is measured: scenes x rows x seeds, and the cells of each run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from bitymi_ns.presets import preset_names

Kind = Literal["train", "eval", "export", "pictures", "knobs"]


@dataclass(frozen=True)
class SceneSpec:
    """A capture and how it is read.

    Attributes:
        name: shown in tables, and nerfstudio's experiment name.
        data: its folder, absolute.
        suite: name of the suite that it is from.
        parser: nerfstudio's dataparser with its options, as they stand at the end of ns-train's command line; empty =
            the method's own.
        hold_out: every which image is held out, where the capture has no test images of its own; 0 = it has.
    """

    name: str
    data: Path
    suite: str = "local"
    parser: tuple[str, ...] = ()
    hold_out: int = 8


@dataclass(frozen=True)
class Row:
    """What is trained: a method with further options of ns-train."""

    name: str
    method: str
    options: tuple[str, ...] = ()

    @property
    def ours(self) -> bool:
        """Whether it is a method of this package: only these are baked and have a training curve."""
        return self.method in preset_names()


@dataclass(frozen=True)
class Bundle:
    """How a trained scene is baked: options of `ns-export bitymi-atlas`."""

    name: str
    options: tuple[str, ...]


@dataclass(frozen=True)
class Run:
    """One training: a scene, a row, a seed (None = the method's own) and a length (None = the method's own)."""

    scene: SceneSpec
    row: Row
    seed: int | None = None
    steps: int | None = None

    @property
    def key(self) -> dict[str, Any]:
        """Every setting."""
        return {
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

    @property
    def name(self) -> str:
        """Of the run's folder: tells runs of one method on one capture apart."""
        settings = {k: v for k, v in self.key.items() if k not in ("suite", "row")}
        digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
        length = "own-length" if self.steps is None else f"{self.steps}-steps"
        seed = "" if self.seed is None else f"-seed{self.seed}"
        return f"{length}{seed}-{digest}"

    @property
    def folder(self) -> str:
        """Relative place of everything that belongs to it: under runs/, bundles/, evals/, pictures/, logs/."""
        return f"{self.scene.name}/{self.row.method}/{self.name}"

    def __str__(self) -> str:
        seed = "" if self.seed is None else f", seed {self.seed}"
        return f"{self.scene.name}, {self.row.name}{seed}"


@dataclass(frozen=True)
class Stage:
    """One cell of the matrix."""

    run: Run
    kind: Kind
    bundle: Bundle | None = None
    count: int = 0
    """pictures: number of views."""

    @property
    def key(self) -> dict[str, Any]:
        """What decides the result of the cell."""
        key: dict[str, Any] = {"cell": self.kind, **self.run.key}
        if self.bundle is not None:
            key |= {"bundle": self.bundle.name, "export": list(self.bundle.options)}
        if self.kind == "pictures":
            key["views"] = self.count
        return key

    @property
    def form(self) -> str:
        """The bundle's name, or `trained` for the trained scene."""
        return self.bundle.name if self.bundle else "trained"

    def __str__(self) -> str:
        what = {"train": "training", "eval": f"evaluation ({self.form})", "export": f"export ({self.form})"}
        return f"{self.run}: {what.get(self.kind, self.kind)}"


@dataclass(frozen=True)
class Matrix:
    """Everything that is to be measured.

    Attributes:
        scenes, rows: each row is trained on each scene.
        seeds: once for each of them; empty = once, with the method's own seed.
        steps: length of a run; None = the method's own for this machine.
        bundles: how each trained scene is baked; each bundle is evaluated.
        pictures: worst held-out views that are drawn with their decomposition; 0 = none.
        knobs: whether the quality knobs of each run are measured.
    """

    scenes: Sequence[SceneSpec]
    rows: Sequence[Row]
    seeds: Sequence[int] = ()
    steps: int | None = None
    bundles: Sequence[Bundle] = field(default_factory=tuple)
    pictures: int = 0
    knobs: bool = False

    def runs(self) -> list[Run]:
        """All trainings, the seeds of a row next to each other."""
        seeds = list(self.seeds) or [None]
        return [Run(s, r, seed, self.steps) for s in self.scenes for r in self.rows for seed in seeds]

    def stages(self, run: Run) -> list[Stage]:
        """The cells of a run in the order in which they need each other."""
        stages = [Stage(run, "train"), Stage(run, "eval")]
        if not run.row.ours:
            return stages
        for bundle in self.bundles:
            stages += [Stage(run, "export", bundle), Stage(run, "eval", bundle)]
        if self.pictures:
            stages.append(Stage(run, "pictures", count=self.pictures))
        if self.knobs:
            stages.append(Stage(run, "knobs"))
        return stages

    def chains(self) -> list[list[Stage]]:
        """The cells of every run."""
        return [self.stages(run) for run in self.runs()]
