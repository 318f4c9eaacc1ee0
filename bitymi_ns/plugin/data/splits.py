"""Which photographs of a capture are held out of training, for evaluation."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path, PurePath
from typing import Literal, NamedTuple

import numpy as np
from nerfstudio.data.utils.dataparsers_utils import get_train_eval_split_filename, get_train_eval_split_fraction

from bitymi_ns.files import encoding_of
from bitymi_ns.plugin.console import fail, listed
from bitymi_ns.plugin.data.names import folded, without_ending

Mode = Literal["fraction", "filename", "interval", "all"]


class Split(NamedTuple):
    """Numbers of the photographs on each side, ascending, and by what rule."""

    train: list[int]
    held_out: list[int]
    rule: str

    def told(self, names: Sequence[Path]) -> str:
        """A line on what is held out of these."""
        if not self.held_out:
            return f"All {len(self.train)} photographs are trained on: none is held out for evaluation."
        if self.rule == "all":
            return f"All {len(names)} photographs are trained on, and evaluated on, too (--eval-mode all)."
        shown = listed([names[i].name for i in self.held_out], most=2)
        return f"Held out for evaluation: {len(self.held_out)} of {len(names)} photographs, {self.rule} ({shown})."


def ordinal(number: int) -> str:
    """1st, 2nd, 3rd, 4th and so on."""
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def by_mode(names: Sequence[Path], mode: Mode, interval: int, fraction: float) -> Split:
    """The split of photographs in this order by nerfstudio's rules."""
    numbers = list(range(len(names)))
    if mode == "interval":
        which = f"every {ordinal(interval)} by name"
        return Split([i for i in numbers if i % interval], [i for i in numbers if i % interval == 0], which)
    if mode == "all":
        return Split(numbers, numbers, "all")
    if mode == "fraction":
        train, held_out = get_train_eval_split_fraction(list(names), fraction)
        rule = f"evenly spaced ones (--train-split-fraction {fraction:g})"
    else:
        try:
            train, held_out = get_train_eval_split_filename(list(names))
        except ValueError as error:
            fail(f"--eval-mode filename: {error}. Use `--eval-names`, or another mode.", error)
        rule = "those with eval in their names"
    return Split(np.asarray(train, int).tolist(), np.asarray(held_out, int).tolist(), rule)


def by_names(names: Sequence[Path], wanted: Sequence[str], where: str) -> Split:
    """Hold out the photographs of these names.

    Args:
        names: of all photographs, with their folders.
        wanted: names, each with as many of its folders as tell it from others.
        where: they were given, for messages.

    Raises:
        InputError: one of them is the name of no photograph, or of several.
    """
    held_out = set(find(names, wanted, where))
    return Split([i for i in range(len(names)) if i not in held_out], sorted(held_out), f"by {where}")


def find(names: Sequence[Path], wanted: Sequence[str], where: str, anywhere: bool = False) -> list[int]:
    """The numbers of the photographs of these names, which may differ in case, the form of Unicode, or their ending.

    Args:
        names, wanted, where: see `by_names`.
        anywhere: wanted names may have leading folders that the photographs do not lie in.
    """
    forms: list[Callable[[str], tuple[str, ...]]] = [
        lambda name: PurePath(name.replace("\\", "/")).parts,
        folded,
        lambda name: without_ending(folded(name) or ("",)),
    ]
    whole = [[form(str(name)) for name in names] for form in forms]
    numbers: list[dict[str, list[int]]] = [defaultdict(list) for _ in forms]
    for table, keys in zip(numbers, whole, strict=True):
        for i, key in enumerate(keys):
            table[key[-1]].append(i)

    def fitting_names(name: str) -> list[int]:
        for form, table, keys in zip(forms, numbers, whole, strict=True):
            parts = form(name)
            for start in range(len(parts) if anywhere else min(1, len(parts))):
                tail = parts[start:]
                fitting = [i for i in table.get(tail[-1], []) if keys[i][-len(tail) :] == tail]
                if fitting:
                    return fitting
        return []

    unknown, found = [], []
    for name in wanted:
        fitting = fitting_names(name)
        if len(fitting) > 1:
            fail(
                f"{where}: {name} is the name of {len(fitting)} photographs, {listed([names[i] for i in fitting])}. "
                "Give its folder, too."
            )
        found += fitting
        unknown += [] if fitting else [name]
    if unknown:
        fail(
            f"{where}: {len(unknown)} of {len(wanted)} names are of no photograph of the capture: {listed(unknown)}. "
            f"Its photographs are {listed([name.name for name in names])}."
        )
    return found


def read_names(given: Sequence[str]) -> tuple[str, ...]:
    """Names as they were given, or those in a text file, one per line, where its name was given instead."""
    if len(given) != 1 or not given[0].lower().endswith((".txt", ".lst", ".list")):
        return tuple(given)
    path = Path(os.path.expanduser(given[0]))
    try:
        lines = path.read_text(encoding_of(path)).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        fail(f"--eval-names: {path} cannot be read: {error}. Give names, or a text file with one per line.", error)
    names = tuple(line.strip() for line in lines if line.strip() and not line.startswith("#"))
    if not names:
        fail(f"--eval-names: {path} lists no names. Write the name of one photograph per line.")
    return names
