"""Checkpoint files: written whole or not at all, read with errors that say what to do."""

import dataclasses
import errno
import json
import pickle
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bitymi_ns.files import complete_file, reason
from bitymi_ns.plugin.console import fail, listed, warn
from bitymi_ns.scene.config import SceneConfig

EXTRA_STATE = "_extra_state"  # torch's name for what a module saves beside its tensors
SURFELS = "scene.surfels."  # prefix of the surfels' parameters in the model
STATE_VERSION = 2
MAY_DIFFER = ("near", "weight_bound", "rim", "texture_moves_surfels", "max_fragments")
"""Scene options that may differ from those that a checkpoint was trained with: they do not decide what its parameters
mean, only how they are drawn or learned."""
_READING = (RuntimeError, EOFError, OSError, LookupError, ValueError, TypeError, AttributeError)
"""Errors of torch.load for damaged files."""


def allow_numpy_scalars() -> None:
    """Let torch.load's safe mode read the numpy numbers that nerfstudio's own schedulers leave in checkpoints."""
    try:
        from numpy._core.multiarray import scalar
    except ImportError:  # numpy 1
        from numpy.core.multiarray import scalar
    torch.serialization.add_safe_globals([scalar, np.dtype, type(np.dtype("float64")), type(np.dtype("float32"))])


def save(state: dict[str, Any], path: Path, scratch: Path) -> None:
    """Write a checkpoint; a crash or a full disk leaves the previous ones as they were.

    Args:
        scratch: a folder of the same file system for the unfinished file; nerfstudio takes every name in the
            checkpoint folder for a checkpoint.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with complete_file(path, scratch) as file:
            torch.save(state, file)
    except (OSError, RuntimeError) as error:
        kept = sorted(p.name for p in path.parent.glob("*.ckpt"))
        detail = reason(_of_the_system(error), path)
        then = f"Resume with --load-dir {path.parent} (from {kept[-1]}, which is intact)" if kept else "Train again"
        fail(f"the checkpoint {path} could not be written: {detail}.\n  {then}.", error)


def _of_the_system(error: BaseException) -> OSError:
    """The system's error behind that of torch, which writes an archive's end after a write that failed and reports only
    that this does not fit."""
    behind: BaseException | None = error
    while behind is not None and not isinstance(behind, OSError):
        behind = behind.__context__
    return behind or OSError(errno.EIO, "the disk took only a part of it")


def newest_step(folder: Path) -> int:
    """The largest step for which the folder holds a checkpoint."""
    if not folder.is_dir():
        fail(
            f"there is no checkpoint folder {folder}. "
            "Give the nerfstudio_models folder of a run: --load-dir outputs/.../nerfstudio_models"
        )
    steps = [int(p.stem[5:]) for p in folder.glob("step-*.ckpt") if p.stem[5:].isdigit()]
    deeper = next((p.parent for p in sorted(folder.glob("*/step-*.ckpt"))), None)
    if not steps and deeper is not None:
        fail(f"{folder} holds no checkpoint itself; they are in {deeper}: --load-dir {deeper}")
    if not steps:
        fail(f"{folder} holds no checkpoint (step-*.ckpt); the run was stopped before it saved one. Train again.")
    return max(steps)


def path_of(folder: Path, step: int) -> Path:
    """Path of the checkpoint of a step."""
    return folder / f"step-{step:09d}.ckpt"


def load(path: Path, scene: SceneConfig) -> dict[str, Any]:
    """Read a checkpoint of a run whose scene is of this kind."""
    if path.is_dir():
        fail(
            f"{path} is a folder: give one of the files step-*.ckpt with --load-checkpoint, or a folder with --load-dir"
        )
    if not path.is_file():
        fail(f"there is no checkpoint {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            altered = archive.testzip()  # torch does not look at the checksums
        if altered is not None:
            raise ValueError(f"the checksum of {altered} is wrong")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (zipfile.BadZipFile, zlib.error, pickle.UnpicklingError, *_READING) as error:
        others = sorted(p.name for p in path.parent.glob("step-*.ckpt") if p != path)
        way_out = (
            f"Remove it to go back to {others[-1]}" if others else "Copy it again from where it was, or train again"
        )
        fail(
            f"the checkpoint {path} is damaged (cut off or altered), or another program wrote it: "
            f"{(str(error).strip() or type(error).__name__).splitlines()[0].rstrip('.')}. {way_out}.",
            error,
        )
    if (
        not isinstance(state, dict)
        or not {"step", "pipeline", "optimizers"} <= state.keys()
        or not isinstance(state["step"], int)
    ):
        fail(f"{path} is not a nerfstudio checkpoint")
    _check_scene(state["pipeline"], scene, path)
    return state


def _check_scene(parameters: Mapping[str, Any], scene: SceneConfig, path: Path) -> None:
    """Stop when the parameters are not those of a scene of this kind."""
    extra = parameters.get("_model." + EXTRA_STATE)
    if not isinstance(extra, dict) or f"_model.{SURFELS}means" not in parameters:
        fail(f"{path} is not a checkpoint of this method: it holds no surfels. Load it with the method it is from.")
    if extra.get("version", 0) > STATE_VERSION:
        fail(f"{path} is from a newer bitymi-ns; update it to load this checkpoint")
    try:
        there, here = dict(json.loads(extra["scene"])), dataclasses.asdict(scene)
    except (ValueError, TypeError, KeyError) as error:
        fail(f"the checkpoint {path} was altered: it does not say what its scene is made of. Train again.", error)
    different = [k for k in there if k in here and k not in MAY_DIFFER and there[k] != here[k]]
    if different:
        lines = "\n".join(
            f"  --pipeline.model.scene.{k.replace('_', '-')}: {there[k]} there, {here[k]} here" for k in different
        )
        fail(
            f"the checkpoint {path} was trained with another preset:\n"
            f"{lines}\n"
            "Use the method that it was trained with (see the config.yml beside its nerfstudio_models folder)."
        )
    rows = {name: len(value) for name, value in parameters.items() if name.startswith("_model." + SURFELS)}
    if len(set(rows.values())) > 1:
        counts = ", ".join(f"{count} {name.rpartition('.')[2]}" for name, count in rows.items())
        fail(
            f"the checkpoint {path} was altered: its parameters differ in their number of surfels ({counts}). Train "
            "again."
        )
    if not all(rows.values()):
        fail(f"the checkpoint {path} holds no surfels. Train again.")
    broken = [
        name.removeprefix("_model.")
        for name, value in parameters.items()
        if isinstance(value, torch.Tensor) and value.is_floating_point() and not bool(value.isfinite().all())
    ]
    if broken:
        warn(f"The checkpoint {path} holds numbers that are not finite, in {listed(broken)}: expect holes, or black.")
