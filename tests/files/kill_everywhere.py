"""Kill a write at every step: run with the name of a result and an empty folder.

The write runs in forked children, the n-th of which ends without cleanup just before its n-th access to the folder;
then the write is repeated to the end. Fails if anything is lost, mixed or left over.
"""

import os
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from bitymi_ns import files

KILLED = 77
EVENTS = ("mkdir", "rename", "remove", "rmdir", "truncate", "listdir", "scandir")


def accesses(folder: Path, event: str, arguments: tuple[Any, ...]) -> bool:
    """Return True if Python is about to access the folder, by its audit events."""
    if event != "open" and event not in {f"os.{name}" for name in EVENTS}:
        return False
    inside = any(isinstance(path, (str, Path)) and str(path).startswith(str(folder)) for path in arguments[:2])
    relative = event in ("os.remove", "os.rmdir", "open") and len(arguments) > 1 and "/" not in str(arguments[0])
    return inside or relative  # shutil.rmtree names files relative to an open folder


def killed_at(step: int, folder: Path, write: Callable[[], None]) -> bool:
    """Write in a child that is killed before access number `step`; returns False if it finished first."""
    child = os.fork()
    if child == 0:
        count = 0

        def watch(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal count
            if accesses(folder, event, arguments):
                count += 1
                if count > step:
                    os._exit(KILLED)

        sys.addaudithook(watch)
        write()
        os._exit(0)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status in (0, KILLED), status
    return status == KILLED


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def of_a_folder(folder: Path, version: int) -> None:
    with files.complete_folder(folder / "b") as new:
        for name in ("xy", "xz")[version]:
            (new / name).write_bytes((b"old", b"new")[version] * 999)


def of_a_file(folder: Path, version: int) -> None:
    files.write_file(folder / "b", (b"old", b"new")[version] * 999)


def of_a_bundle(folder: Path, version: int) -> None:
    import torch

    from bitymi_ns.bundle import write_bundle
    from bitymi_ns.scene.baked import BakedScene

    torch.set_num_threads(1)

    shapes = {"means": (3, 3), "quats": (3, 4), "log_scales": (3, 2), "opacity_logits": (3,), "beta_raw": (3,)}
    shapes |= {"sh_dc": (3, 3), "sh_rest": (3, 15, 3)}
    surfels = {name: torch.full(shape, version + 1.0) for name, shape in shapes.items()}
    more = {"extra_files": {"preview.png": b"png"}, "loose_files": {"config.yml": b"config"}}
    write_bundle(folder / "b", BakedScene(surfels, "sh", torch.zeros(3, 5, dtype=torch.int32)), overwrite=True, **more)


def main(kind: str, folder: Path) -> None:
    write = {"folder": of_a_folder, "file": of_a_file, "bundle": of_a_bundle}[kind]
    old, new = partial(write, folder, 0), partial(write, folder, 1)
    new()
    newer = contents(folder)
    old()
    older = contents(folder)
    assert older != newer
    for first in (False, True):  # over an earlier version; without one
        step = 0
        while True:
            for path in folder.iterdir() if first else ():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            killed = killed_at(step, folder, new)
            found = {name: data for name, data in contents(folder).items() if name.split("/")[0] == "b"}
            assert found in (newer, older, {}), (step, sorted(found))  # {}: nothing yet, or between two renames
            check = None if kind == "file" else lambda: None
            with files.reserved(folder / "b", check):  # first action of the next writer
                if kind == "file":
                    files.remove_unfinished(folder)
                settled = {k: v for k, v in contents(folder).items() if k != ".b.lock"}
                assert settled in ((newer, {}) if first else (newer, older)), (step, sorted(settled))
            if not killed:
                break
            old()
            assert contents(folder) == older, (step, sorted(contents(folder)))
            step += 1
        assert step > (2 if kind == "file" else 5), step
        print(f"{kind}: {step} kills, {'nothing' if first else 'an earlier one'} in the place")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
