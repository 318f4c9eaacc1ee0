"""Checkpoint files, written whole or not at all."""

import dataclasses
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from bitymi_ns.files import complete_file, reason
from bitymi_ns.safe_reading import open_regular, reading
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.trust import json_of
from ..console import InputError, fail, listed, warn
from .checkpoint_reader import read_archive
from .checkpoint_schema import EXTRA_STATE, SURFELS, Entry, Misfit, check, check_unwritten

STATE_VERSION = 2
MAY_DIFFER = ("near", "weight_bound", "rim", "texture_moves_surfels", "max_fragments")
"""Scene options that may differ from a checkpoint's: they change only how parameters are drawn or learned."""


def save(state: dict[str, Any], path: Path, scratch: Path, scene: SceneConfig) -> None:
    """Write a checkpoint that `load` takes; on failure the previous ones stay. The unfinished file lies in `scratch`,
    on the same file system: nerfstudio takes any file beside the checkpoints for one."""
    try:
        check_unwritten(state, scene)
        with complete_file(path, scratch) as file:
            torch.save(state, file)
    except (OSError, RuntimeError, Misfit) as error:
        # torch still ends its archive, and reports that: the disk's error is in the context
        behind: BaseException | None = error
        while behind is not None and not isinstance(behind, OSError):
            behind = behind.__context__
        kept = sorted(p.name for p in path.parent.glob("*.ckpt"))
        if isinstance(error, Misfit):
            detail = f"nothing could read it ({error}), which is a fault of bitymi-ns: please report it"
        elif behind is not None or "inline_container" in str(error):
            detail = reason(behind or OSError(0, "the disk took only a part of it"), path)
        else:
            raise
        then = f"Resume with --load-dir {path.parent} (from {kept[-1]}, which is intact)" if kept else "Train again"
        fail(f"the checkpoint {path} could not be written: {detail}.\n  {then}.", error)


def newest_step(folder: Path) -> int:
    """Find the folder's largest step with a checkpoint."""
    if not folder.is_dir():
        fail(f"there is no checkpoint folder {folder}. Give a run's: --load-dir outputs/.../nerfstudio_models")
    steps = [int(p.stem[5:]) for p in folder.glob("step-*.ckpt") if p.stem[5:].isdigit()]
    deeper = next((p.parent for p in sorted(folder.glob("*/step-*.ckpt"))), None)
    if not steps and deeper is not None:
        fail(f"{folder} holds no checkpoint itself; they are in {deeper}: --load-dir {deeper}")
    if not steps:
        fail(f"{folder} holds no checkpoint (step-*.ckpt): the run was stopped before it. Train again.")
    return max(steps)


def how_to_resume(folder: Path) -> str:
    saved = sorted(folder.glob("step-*.ckpt"))
    if not saved:
        return "No checkpoint had been written yet."
    return f"The newest checkpoint is {saved[-1]}; resume with\n  --load-dir {folder}"


def path_of(folder: Path, step: int) -> Path:
    return folder / f"step-{step:09d}.ckpt"


def load(path: Path, scene: SceneConfig) -> dict[str, Any]:
    """Read a checkpoint, check that it fits the options of `scene`, and warn of numbers that are not finite."""
    if path.is_dir():
        fail(f"{path} is a folder: give one of the files step-*.ckpt with --load-checkpoint, or --load-dir")
    if not path.is_file():
        fail(f"there is no checkpoint {path}")
    earlier = sorted(p.name for p in path.parent.glob("step-*.ckpt") if p != path)
    way_out = f"Remove it to go back to {earlier[-1]}" if earlier else "Copy it again from where it was, or train again"

    advice = f"It is damaged (cut off or altered), or another program wrote it. {way_out}."
    with reading(f"the checkpoint {path}", InputError, "Have it made readable for you (chmod u+r), or copy it."):
        file = open_regular(path)
    with file, reading(f"the checkpoint {path}", InputError, advice):
        state = read_archive(file)
    if not isinstance(state, dict) or not {"step", "pipeline", "optimizers"} <= state.keys():
        fail(f"{path} is not a nerfstudio checkpoint")
    try:
        _check_kind(state["pipeline"], scene, path)
        broken = check(state, scene)
    except Misfit as error:
        fail(f"the checkpoint {path} was altered, or is not of this method: {error}. {way_out}.", error)
    if broken:
        warn(f"The checkpoint {path} holds numbers that are not finite, or too large to be drawn, in {listed(broken)}.")
    return state


def check_removed(source: Path | str, scene: Mapping[str, Any], rates: Mapping[str, Any]) -> None:
    """Fail on recorded options of the scene and learning rates that only earlier versions can follow."""
    for option, value in (("scene.prefilter", scene.get("prefilter")), ("train.lr.means", rates.get("means"))):
        if value not in (None, "low_pass"):
            fail(f"{source} asks for {option} {value}, which is gone: train the scene again")


def _check_kind(parameters: Any, scene: SceneConfig, path: Path) -> None:
    """Fail on parameters of another method or a newer version, or scene options that differ beyond `MAY_DIFFER`."""
    extra = parameters.get("_model." + EXTRA_STATE) if isinstance(parameters, dict) else None
    if not isinstance(extra, dict) or f"{SURFELS}means" not in parameters:
        fail(f"{path} is not a checkpoint of this method: it holds no surfels. Load it with its own method.")
    version = Entry(extra, f"pipeline.{EXTRA_STATE}").get("version")
    if version is not None and version.count() > STATE_VERSION:
        fail(f"{path} is from a newer bitymi-ns; update it to load this checkpoint")
    try:
        there, here = dict(json_of(extra["scene"])), dataclasses.asdict(scene)
    except (ValueError, TypeError, KeyError) as error:
        fail(f"the checkpoint {path} was altered: it does not describe its scene. Train again.", error)
    rates: Mapping[str, Any] = {}
    with suppress(ValueError, TypeError, LookupError):  # `check` names what is wrong
        rates = dict(json_of(extra["train"])["lr"])
    check_removed(path, there, rates)
    check_removed(path.parent.parent / "config.yml", vars(scene), {})
    different = [k for k in there if k in here and k not in MAY_DIFFER and there[k] != here[k]]
    if different:
        lines = "\n".join(
            f"  --pipeline.model.scene.{k.replace('_', '-')}: {there[k]} there, {here[k]} here" for k in different
        )
        fail(f"the checkpoint {path} was trained with another preset:\n{lines}\nUse that of its run's config.yml.")
