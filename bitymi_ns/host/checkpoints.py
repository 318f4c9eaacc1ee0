"""Checkpoint files: written whole or not at all, read with errors that say what to do."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bitymi_ns.host.errors import fail


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
        state: what to save.
        path: the file.
        scratch: a folder of the same file system for the unfinished file; nerfstudio takes every name in the
            checkpoint folder for a checkpoint.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = scratch / f".{path.name}.{os.getpid()}.unfinished"
    try:
        with open(unfinished, "wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except (OSError, RuntimeError) as error:  # torch reports some write errors as RuntimeError
        _remove(unfinished)
        kept = sorted(p.name for p in path.parent.glob("*.ckpt"))
        fail(
            f"the checkpoint {path} could not be written: {error}\n"
            f"  Free some disk space and resume with --load-dir {path.parent}"
            + (f" (from {kept[-1]}, which is intact)." if kept else " (there is no earlier checkpoint)."),
            error,
        )
    except BaseException:  # Ctrl-C
        _remove(unfinished)
        raise


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:
        pass


def newest_step(folder: Path) -> int:
    """The largest step for which the folder holds a checkpoint."""
    if not folder.is_dir():
        fail(
            f"there is no checkpoint folder {folder}. "
            "Give the nerfstudio_models folder of a run: --load-dir outputs/.../nerfstudio_models"
        )
    steps = [int(p.stem[5:]) for p in folder.glob("step-*.ckpt") if p.stem[5:].isdigit()]
    if not steps:
        fail(f"{folder} holds no checkpoint (step-*.ckpt); the run was stopped before it saved one. Train again.")
    return max(steps)


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint."""
    if not path.is_file():
        fail(f"there is no checkpoint {path}")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, OSError, KeyError, ValueError, pickle.UnpicklingError) as error:
        fail(f"the checkpoint {path} cannot be read; it is damaged or of another program: {_first_line(error)}", error)
    if not isinstance(state, dict) or not {"step", "pipeline", "optimizers"} <= state.keys():
        fail(f"{path} is not a nerfstudio checkpoint")
    return state


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
