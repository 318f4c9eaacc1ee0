"""Order photographs by name, and find their neighbours."""

import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

Position = tuple[int, ...]


def natural(name: str) -> list[tuple[int, int, str]]:
    """Make a sort key with numbers by value: frame_2 before frame_10."""
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part.lower()) for part in re.split(r"(\d+)", name)]


class Neighbours:
    """Sequences of photographs: files in one folder whose names differ only in numbers."""

    def __init__(self, files: Sequence[Path]) -> None:
        sequences = defaultdict(list)
        for index, file in enumerate(files):
            sequence, position = _numbered(file)
            sequences[sequence].append((position, index))
        self._sequences = {sequence: sorted(members) for sequence, members in sequences.items()}

    def of(self, file: Path) -> tuple[int, int, float] | None:
        """Return the indices of the previous and next photograph, and the file's position between them, 0 to 1, by the
        first number that differs; beyond an end of the sequence, that end twice and 0. None: unknown sequence."""
        sequence, position = _numbered(file)
        members = self._sequences.get(sequence)
        if members is None:
            return None
        after = bisect_left(members, (position,))
        (low, first) = members[max(after - 1, 0)]
        (high, last) = members[min(after, len(members) - 1)]
        share = next(((n - a) / (b - a) for a, n, b in zip(low, position, high, strict=True) if a != b), 0.0)
        return first, last, share


def _numbered(file: Path) -> tuple[tuple[str, ...], Position]:
    """Split a path into a sequence's key (folder, text) and the numbers in its name."""
    parts = natural(file.stem)
    return (str(file.parent), *(text for kind, _, text in parts if not kind)), tuple(n for kind, n, _ in parts if kind)
