"""Photographs that stand on both sides of the hold-out, where they make its figures look better than they are."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bitymi_ns.plugin.console import listed, warn

Pair = tuple[int, int]
"""Number of a training photograph, and of a held-out one."""


def same_files(train: Sequence[Path], held_out: Sequence[Path]) -> list[Pair]:
    """The pairs whose files are one file, or hold the same bytes. Only files of equal size are read."""
    sizes = [[path.stat().st_size for path in paths] for paths in (train, held_out)]
    shared = set(sizes[0]) & set(sizes[1])
    contents = [
        [_digest(path) if size in shared else path for path, size in zip(paths, of, strict=True)]
        for paths, of in zip((train, held_out), sizes, strict=True)
    ]
    return same_contents(*contents)


def same_contents(train: Sequence[Any], held_out: Sequence[Any]) -> list[Pair]:
    """The pairs that are equal; None equals nothing. A held-out one is named once, with the first of its equals."""
    first: dict[Any, int] = {}
    for i, content in enumerate(train):
        first.setdefault(content, i)
    return [(first[content], j) for j, content in enumerate(held_out) if content is not None and content in first]


def _digest(path: Path) -> bytes:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.digest()


def warn_of(pairs: Sequence[Pair], train: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Name the pairs, if there are any. Where all views are used for both, on request, there is nothing to say."""
    if not pairs or list(train) == list(held_out):
        return
    named = listed([f"{held_out[j]} = {train[i]}" for i, j in pairs])
    warn(
        f"{len(pairs)} of {len(held_out)} held-out photographs are training photographs, too: {named}. Figures on them "
        "say nothing about new views: remove the duplicates from the capture."
    )
