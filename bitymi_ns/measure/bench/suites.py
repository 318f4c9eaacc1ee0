"""Scenes and rows by name: standard data sets, one's own folders, plans."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from bitymi_ns.capture.recognise import NotRecognised, recognise
from bitymi_ns.measure.bench.matrix import Bundle, Row, SceneSpec
from bitymi_ns.measure.bench.process import BenchError
from bitymi_ns.trust import inside

FORMATS = ("fp16", "uint8", "bc7", "compact")
"""Formats of `ns-export bitymi-atlas`."""
HOLD_OUT = 8
"""Every which image of one's own captures is held out: the method's default."""


@dataclass(frozen=True)
class Suite:
    """A standard data set."""

    name: str
    title: str
    layout: str
    hold_out: int
    scenes: dict[str, str]
    """Scene -> folder of its images."""


def _read(path: Path) -> Any:
    try:
        return yaml.safe_load(path.read_text("utf8"))
    except OSError as error:
        raise BenchError(f"{path} cannot be read: {error.strerror or error}") from error
    except RecursionError as error:
        raise BenchError(f"{path} is nested too deeply") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BenchError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error


def suites() -> dict[str, Suite]:
    """The standard data sets by name."""
    entries = _read(Path(__file__).with_name("suites.yaml"))
    return {name: Suite(name=name, **entry) for name, entry in entries.items()}


# scenes


def local_scenes(folders: Sequence[Path]) -> list[SceneSpec]:
    """One's own captures, each whatever `ns-train bitymi --data` takes; a Blender data set has the points of
    `hull_pc.ply` where it has that file.

    Raises:
        BenchError: a folder holds nothing to train on, or two have the same name.
    """
    if not folders:
        raise BenchError('no capture: give --data with one or more folders, as in --data "captures/fox"')
    scenes = []
    for folder in folders:
        folder = Path(os.path.expanduser(folder)).resolve()
        try:
            found = recognise(folder)
        except NotRecognised as error:
            raise BenchError(f"{folder} is not a capture: {error}") from error
        if found.format == "blender":
            points = ("--ply-path", "hull_pc.ply") if (found.path / "hull_pc.ply").is_file() else ()
            scenes.append(SceneSpec(folder.name, found.path, parser=("blender-data", *points), hold_out=0))
        else:
            scenes.append(SceneSpec(folder.name, folder, hold_out=HOLD_OUT))
    names = [scene.name for scene in scenes]
    if len(set(names)) < len(names):
        raise BenchError(f"captures need folders of different names, not {', '.join(names)}")
    return scenes


def standard_scenes(suite: Suite, root: Path, only: Sequence[str] = ()) -> list[SceneSpec]:
    """The scenes of a standard data set below its folder.

    Raises:
        BenchError: the folder, or a scene of it, does not have the layout.
    """
    unknown = sorted(set(only) - set(suite.scenes))
    if unknown:
        raise BenchError(f"{suite.name} has no scene {', '.join(unknown)}; it has {', '.join(suite.scenes)}")
    root = Path(os.path.expanduser(root)).resolve()
    return [_standard_scene(suite, name, root / name) for name in only or suite.scenes]


def _standard_scene(suite: Suite, name: str, folder: Path) -> SceneSpec:
    images = suite.scenes[name]
    needed = [images, "sparse/0"] if suite.layout == "colmap" else ["transforms_train.json", "transforms_test.json"]
    missing = [part for part in needed if not (folder / part).exists()]
    if missing:
        raise BenchError(
            f"{folder} is not {suite.title}'s {name}: there is no {' and no '.join(missing)}. --data is the folder "
            f"that holds the scenes; --scenes {name} ... chooses some of them"
        )
    if suite.layout == "blender":
        return SceneSpec(name, folder, suite.name, ("blender-data",), suite.hold_out)
    base, _, factor = images.partition("_")
    parser = ["colmap", "--images-path", base, "--colmap-path", "sparse/0"]
    parser += ["--downscale-factor", factor or "1", "--downscale-rounding-mode", "round"]
    parser += ["--eval-mode", "interval", "--eval-interval", str(suite.hold_out)]
    return SceneSpec(name, folder, suite.name, tuple(parser), suite.hold_out)


# rows and bundles


def format_bundles(formats: Sequence[str]) -> list[Bundle]:
    """A bundle an atlas format."""
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise BenchError(f"there is no atlas format {', '.join(unknown)}; there are {', '.join(FORMATS)}")
    return [Bundle(name, ("--format", name)) for name in dict.fromkeys(formats)]


def read_plan(name: str) -> tuple[list[Row], list[Bundle] | None]:
    """A plan by name, or from a YAML file.

    Returns:
        rows, and the bundles; None when the plan leaves them open.

    Raises:
        BenchError: there is no such plan, or it is malformed; the message says where.
    """
    if name.endswith((".yaml", ".yml")):
        plan = _read(Path(os.path.expanduser(name)))
    else:
        plans = _read(Path(__file__).with_name("plans.yaml"))
        if name not in plans:
            raise BenchError(f"there is no plan {name}: give {', '.join(plans)}, or a file that ends in .yaml")
        plan = plans[name]
    if not isinstance(plan, dict) or not isinstance(plan.get("rows"), dict) or not plan["rows"]:
        raise BenchError(f"plan {name}: 'rows' must map names to {{method: ..., options: [...]}}")
    strange = sorted(set(plan) - {"rows", "bundles"})
    if strange:
        raise BenchError(f"plan {name}: unknown entry {', '.join(map(str, strange))}; there are rows and bundles")
    rows = [_row(name, str(title), entry) for title, entry in plan["rows"].items()]
    bundles = plan.get("bundles")
    if bundles is None:
        return rows, None
    if not isinstance(bundles, dict):
        raise BenchError(f"plan {name}: 'bundles' must map names to lists of options of ns-export bitymi-atlas")
    return rows, [_bundle(name, str(title), options) for title, options in bundles.items()]


def _row(plan: str, title: str, entry: Any) -> Row:
    if not isinstance(entry, dict) or not isinstance(entry.get("method"), str) or set(entry) - {"method", "options"}:
        raise BenchError(f"plan {plan}, row {title}: it must be {{method: NAME, options: [...]}}, not {entry!r}")
    try:
        inside(Path("runs"), entry["method"])
    except ValueError as error:
        raise BenchError(f"plan {plan}, row {title}: {error}") from error
    return Row(title, entry["method"], _options(f"plan {plan}, row {title}", entry.get("options", [])))


def _bundle(plan: str, title: str, options: Any) -> Bundle:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]*", title):
        raise BenchError(f"plan {plan}, bundle {title!r}: a bundle's name may hold letters, digits and . _ + - only")
    return Bundle(title, _options(f"plan {plan}, bundle {title}", options))


def _options(where: str, options: Any) -> tuple[str, ...]:
    if not isinstance(options, list) or not all(isinstance(o, (str, int, float)) for o in options):
        raise BenchError(f"{where}: options must be a list of words, not {options!r}")
    return tuple(map(str, options))
