"""Split a capture into training and held-out photographs: by rule, or by names."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from bitymi_ns.safe_reading import read_text
from bitymi_ns.trust import listed, told_apart
from .find_files import find_named
from .folder_contents import kind_of
from .kinds import LISTS, PROCESSED, Kind
from .types import Photograph, fail, parsing, warn

Mode = Literal["fraction", "filename", "interval", "all"]


class NameLists(NamedTuple):
    """Names of photographs by split (train, val, test), and who states them."""

    names: dict[str, list[str]]
    source: str = "the capture's own lists"


@dataclass
class SplitOptions:
    """Photographs to hold out for evaluation."""

    eval_mode: Mode = "interval"
    """Photographs to hold out: evenly spaced ones, those with eval in their names, every n-th, or none (all for
    both)."""
    eval_interval: int = 8  # Hold out every n-th photograph by name, with --eval-mode interval.
    train_split_fraction: float = 0.9  # Share of the photographs to train on, with --eval-mode fraction.
    eval_names: tuple[str, ...] = ()
    """Names of photographs to hold out, or a text file (.txt) with one per line; overrides --eval-mode."""


class Split(NamedTuple):
    """Ascending indices of the photographs on each side, and the rule in words."""

    train: list[int]
    held_out: list[int]
    rule: str

    def describe(self, names: Sequence[Path]) -> str:
        if not self.held_out:
            return f"All {len(self.train)} photographs are trained on: none is held out for evaluation."
        if self.rule == "all":
            return f"All {len(names)} photographs are trained on, and evaluated on, too (--eval-mode all)."
        short = told_apart(names)
        shown = listed([short[i] for i in self.held_out], most=2)
        return f"Held out for evaluation: {len(self.held_out)} of {len(names)} photographs, {self.rule} ({shown})."


def split_members(split: Split, groups: Sequence[int]) -> Split:
    """Extend a split of groups to their members, as of rig frames to photographs."""
    sides = [set(side) for side in (split.train, split.held_out)]
    train, held_out = ([i for i, group in enumerate(groups) if group in side] for side in sides)
    return Split(train, held_out, split.rule)


def choose_split(photographs: Sequence[Photograph], lists: NameLists, options: SplitOptions) -> Split:
    """Split photographs by `eval_names`, else the capture's lists or names, else a rule; frames of a rig stay together,
    except by lists. Raises CaptureError: a name matches no photograph, or several."""
    names = [photograph.file for photograph in photographs]
    first: dict[object, int] = {}
    frames = [i if photograph.frame is None else first.setdefault(photograph.frame, i)
              for i, photograph in enumerate(photographs)]  # fmt: skip
    groups = sorted(set(frames))
    if options.eval_names:
        split = by_names(names, options.eval_names, "--eval-names")
        held = {frames[i] for i in split.held_out}
        return split_members(Split(sorted(set(frames) - held), sorted(held), split.rule), frames)
    if not lists.names and (options.eval_mode, options.eval_interval) == ("interval", SplitOptions.eval_interval):
        lists = lists_by_name(names, PROCESSED, "ns-process-data's names")  # unless the user states a rule
    if lists.names:
        return by_lists(names, lists)
    of_first = [names[i] for i in groups]
    split = by_mode(of_first, options.eval_mode, options.eval_interval, options.train_split_fraction)
    sides = ([groups[i] for i in side] for side in (split.train, split.held_out))
    return split_members(Split(*sides, rule=split.rule), frames)


def by_mode(names: Sequence[Path], mode: Mode, interval: int, fraction: float) -> Split:
    """Split ordered photographs by a rule of nerfstudio."""
    indices = list(range(len(names)))
    if mode == "interval":
        suffix = {1: "st", 2: "nd", 3: "rd"}.get(interval % 10 * (interval % 100 not in (11, 12, 13)), "th")
        rule = f"every {interval}{suffix} by name"
        return Split([i for i in indices if i % interval], indices[::interval], rule)
    if mode == "all":
        return Split(indices, indices, "all")
    if mode == "fraction":
        train = sorted(set(np.linspace(0, len(names) - 1, math.ceil(len(names) * fraction), dtype=int).tolist()))
        rule = f"evenly spaced ones (--train-split-fraction {fraction:g})"
        return Split(train, sorted(set(indices) - set(train)), rule)
    train = [i for i in indices if "train" in names[i].name]
    held_out = [i for i in indices if "train" not in names[i].name and "eval" in names[i].name]
    if neither := sorted(set(indices) - {*train, *held_out}):
        which = listed([told_apart(names)[i] for i in neither])
        fail(f"--eval-mode filename: {which} has neither train nor eval in its name. Use `--eval-names`.")
    return Split(train, held_out, "those with eval in their names")


def by_names(names: Sequence[Path], wanted: Sequence[str], source: str) -> Split:
    """Hold out photographs by name. Raises CaptureError: a name matches no photograph, or several."""
    held_out = set(find_named(names, wanted, source))
    return Split(sorted(set(range(len(names))) - held_out), sorted(held_out), f"by {source}")


def by_lists(names: Sequence[Path], lists: NameLists) -> Split:
    """Split by lists; "val" and "test" are held out, without them what is not in "train"."""

    def indices(split: str) -> set[int]:  # downscaled photographs are in other folders
        return set(find_named(names, lists.names.get(split, []), lists.source, any_folder=True))

    every = set(range(len(names)))
    train = indices("train")
    held_out = indices("val") | indices("test")
    held_out = held_out if lists.names.keys() - {"train"} else every - train
    train = train if "train" in lists.names else every - held_out
    return Split(sorted(train), sorted(held_out), f"by {lists.source}")


def read_names(names_or_file: Sequence[str]) -> tuple[str, ...]:
    """Return the names; read them from a text file if one is named, one per line."""
    if len(names_or_file) != 1 or not names_or_file[0].lower().endswith((".txt", ".lst", ".list")):
        return tuple(names_or_file)
    path = Path(os.path.expanduser(names_or_file[0]))
    names = _names_in(path, f"--eval-names: {path}")
    if not names:
        fail(f"--eval-names: {path} lists no names. Write the name of one photograph per line.")
    return tuple(names)


def _names_in(path: Path, what: object) -> list[str]:
    with parsing(what, "Write one name on each line, in UTF-8."):
        return [line.strip() for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]


def read_split_lists(folder: Path, model: Path, files: Sequence[Path]) -> NameLists:
    """Read the lists of nerfstudio's COLMAP parser (`*_list.txt`), else 3DGS's `test.txt` in the model's folder, which
    may name more than the photographs' `files`."""
    stated = [(row.what, folder / name) for row in LISTS for name in row.names.split()]
    lists = {split: _names_in(path, path) for split, path in stated if path.is_file()}
    test = model / "test.txt"
    if lists or not test.is_file():
        return NameLists(lists)
    there = {part for file in files for part in (file.name, file.stem)}
    named = _names_in(test, test)
    known = [name for name in named if {Path(name).name, Path(name).stem} & there]
    if len(known) < len(named):
        warn(f"{test}: {len(named) - len(known)} of {len(named)} names are of no photograph of the capture.")
    return NameLists({"test": known} if known else {}, str(test))


def lists_by_name(files: Sequence[Path], rows: Sequence[Kind], source: str) -> NameLists:
    """List photographs by names of splits; no lists unless rows name all, some for training and some for others."""
    lists: dict[str, list[str]] = {}
    for file in files:
        row = kind_of(file, rows)
        lists.setdefault("" if row is None else row.what, []).append(str(file))
    return NameLists({} if "" in lists or "train" not in lists or len(lists) < 2 else lists, source)


Pair = tuple[int, int]  # index of a training photograph, and of a held-out one


def duplicates(train: Sequence[Any], held_out: Sequence[Any]) -> list[Pair]:
    """Pair held-out items with the first equal training item; None equals nothing."""
    first = {content: i for i, content in reversed([*enumerate(train)])}
    return [(first[content], j) for j, content in enumerate(held_out) if content is not None and content in first]


def warn_of_duplicates(pairs: Sequence[Pair], train: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Warn of held-out photographs that are trained on, unless all views serve for both."""
    if not pairs or list(train) == list(held_out):
        return
    which = listed([f"{held_out[j]} = {train[i]}" for i, j in pairs])
    advice = "Figures on them say nothing about new views: remove the duplicates."
    warn(f"{len(pairs)} of {len(held_out)} held-out photographs are training photographs, too: {which}. {advice}")
