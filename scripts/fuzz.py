"""Fuzz the readers of untrusted files, guided by coverage.

    python -m scripts.fuzz TARGET --seconds 600     a target, or `all` in turn
    python -m scripts.fuzz TARGET --input FILE      reproduce a finding, with its traceback

Needs atheris (`pip install atheris`), on Linux with Python 3.11 or later. Any exception other than the reader's
documented ones is a finding: the input is saved in --findings, one per line of the package that raised, and the exit
status is 1. A crash or a hang of compiled code ends the target.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import random
import struct
import subprocess
import sys
import tempfile
import traceback
import types
from collections.abc import Callable
from pathlib import Path

import atheris
import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE

import bitymi_ns.capture.known_poses
import bitymi_ns.capture.poses
from scripts.fuzz_targets import CUT, TARGETS, Target, no_colmap
from tests.hostile import mutated

ODD_BYTES = [
    *(struct.pack(form, number) for form in "<d <f".split() for number in (0.0, -1.0, 1e-38, 3e38, np.nan, np.inf)),
    *(
        struct.pack(f"{order}{size}", number)
        for order in "<>"
        for size in "hiq"
        for number in (0, 1, -1, -32768, 32767)
    ),
    *(struct.pack("<q", number) for number in (2**31, 2**32, 2**62, 2**63 - 1, -(2**63))),
]


def changed_json(data: bytes, dice: random.Random) -> bytes | None:
    """Change a few entries of JSON; None if the data is no JSON."""
    try:
        return json.dumps(mutated([json.loads(data)], dice)[0]).encode("utf8", "surrogatepass")
    except (ValueError, RecursionError, IndexError):
        return None


def changed_numbers(data: bytes, dice: random.Random) -> bytes:
    packed, start = dice.choice(ODD_BYTES), dice.randrange(len(data) + 1)
    return data[:start] + packed + data[start + len(packed) :]


def mutator(target: Target) -> Callable[[bytes, int, int], bytes]:
    """Create a mutator of JSON and numbers, mixed with libFuzzer's own mutations of bytes."""

    def mutate(data: bytes, most: int, seed: int) -> bytes:
        dice = random.Random(seed)
        *before, last = data.split(CUT)
        if dice.random() < 0.7 and target.json:
            lines = last.split(b"\n") if b"\n{" in last else [last]
            k = dice.randrange(len(lines))
            changed = changed_json(lines[k], dice)
            if changed is not None:
                whole = CUT.join([*before, b"\n".join([*lines[:k], changed, *lines[k + 1 :]])])
                if len(whole) <= most:
                    return whole
        elif dice.random() < 0.3:
            return changed_numbers(data, dice)[:most]
        return atheris.Mutate(data, most)

    return mutate


def place_of(error: BaseException) -> str:
    """Name the package's last line of a traceback, and the exception's type."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "bitymi_ns" in f.filename]
    where = f"{Path(frames[-1].filename).name}-{frames[-1].lineno}" if frames else "elsewhere"
    return f"{where}-{type(error).__name__}"


def follow() -> None:
    """Instrument the package for atheris, whose import hook does not see editable installs."""
    for function in gc.get_objects():
        if isinstance(function, types.FunctionType) and str(function.__module__).startswith("bitymi_ns."):
            with contextlib.suppress(Exception):  # some code cannot be rewritten
                atheris.instrument_func(function)


def fuzz(name: str, seconds: int, folder: Path, work: Path) -> None:
    """Fuzz a target; does not return."""
    target, known = TARGETS[name](work), {path.name for path in folder.iterdir()}
    follow()

    def one(data: bytes) -> None:
        try:
            target.run(data)
        except target.refusals:
            pass
        except Exception as error:
            file = f"{name}-{place_of(error)}"
            if file not in known:
                known.add(file)
                (folder / file).write_bytes(data)
                print(f"FOUND {file}: {error}"[:300], file=sys.stderr, flush=True)

    for seed in target.seeds:
        one(seed)  # late imports would count as a hang
    corpus = work / "corpus"
    corpus.mkdir()
    for k, seed in enumerate(target.seeds):
        (corpus / f"seed-{k}").write_bytes(seed)
    limits = [f"-max_total_time={seconds}", "-timeout=20", "-rss_limit_mb=4096", f"-max_len={1 << 16}"]
    shown = ["-print_final_stats=1", "-verbosity=0", f"-artifact_prefix={folder}/{name}-"]
    atheris.Setup([sys.argv[0], *limits, *shown, str(corpus)], one, custom_mutator=mutator(target))
    atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", choices=[*TARGETS, "all"])
    parser.add_argument("--seconds", type=int, default=600, help="time for each target")
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"), help="folder for inputs")
    parser.add_argument("--input", type=Path, nargs="+", help="inputs to run instead")
    given = parser.parse_args()
    CONSOLE.quiet = True
    torch.set_num_threads(1)
    bitymi_ns.capture.known_poses.triangulate = bitymi_ns.capture.poses.find_poses = no_colmap
    with tempfile.TemporaryDirectory() as scratch:
        if given.input is not None:
            target = TARGETS[given.target](Path(scratch))
            for path in given.input:
                try:
                    target.run(path.read_bytes())
                    print(f"{path}: read")
                except target.refusals as error:
                    print(f"{path}: refused: {error}")
            return 0
        given.findings.mkdir(exist_ok=True)
        if given.target != "all":
            fuzz(given.target, given.seconds, given.findings, Path(scratch))
    for name in TARGETS:
        options = ["--seconds", str(given.seconds), "--findings", str(given.findings)]
        subprocess.run([sys.executable, "-m", "scripts.fuzz", name, *options], check=False)
    findings = sorted(path.name for path in given.findings.iterdir())
    print(f"{len(findings)} findings in {given.findings}: {', '.join(findings)}" if findings else "nothing was found")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
