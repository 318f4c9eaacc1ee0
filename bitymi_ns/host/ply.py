"""PLY files of points: what their header says, rows that are no points, and colours that are no bytes.

The reader that nerfstudio uses does not say: it returns whatever the memory held for points that the file lacks, or
that follow one it cannot read, and divides every colour by 255, also those that lie between 0 and 1.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

_HEADER_LIMIT = 1 << 16
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_COLOURS = ("red", "green", "blue")


class Header(NamedTuple):
    """What a PLY file says about its points.

    Attributes:
        order: of the bytes, < or >; "" in a text file.
        count: of the points; None where there is no element `vertex`.
        names: of a point's properties.
        row: a point's numbers as numpy's type; None where it has lists, or kinds that are not known.
        lines, body: length of the header, in lines and bytes.
        ahead: what lies between the header and the points: lines of a text file, else bytes; None where that cannot be
            told.
    """

    order: str
    count: int | None
    names: list[str]
    row: np.dtype | None
    lines: int
    body: int
    ahead: int | None


def read_header(path: Path) -> Header | None:
    """The header; None for files that are not PLY."""
    with open(path, "rb") as file:
        head = file.read(_HEADER_LIMIT)
    body = head.find(b"\n", head.find(b"end_header")) + 1
    if not head.startswith(b"ply") or b"end_header" not in head or body == 0:
        return None
    lines = [line.split() for line in head[:body].decode("ascii", "replace").split("\n")[:-1]]
    kind = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "ascii")
    order = _ORDERS.get(kind, "")
    ahead: int | None = 0
    starts = [i for i, words in enumerate(lines) if words[:1] == ["element"] and len(words) == 3]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        _, name, stated = lines[start]
        properties = [words for words in lines[start + 1 : end] if words[:1] == ["property"] and len(words) > 2]
        row = _row(properties, order)
        count = int(stated) if stated.isdecimal() else None
        if name == "vertex":
            return Header(order, count, [words[-1] for words in properties], row, len(lines), body, ahead)
        if ahead is None or count is None or (order and row is None):
            ahead = None
        else:
            ahead += count * row.itemsize if order and row is not None else count
    return Header(order, None, [], None, len(lines), body, 0)


def _row(properties: list[list[str]], order: str) -> np.dtype | None:
    types = [_TYPES.get(words[1]) if len(words) == 3 else None for words in properties]
    return None if None in types else np.dtype([(f"{i}", f"{order}{kind}") for i, kind in enumerate(types)])


def rows_there(path: Path, header: Header) -> int | None:
    """How many points the file has room for; None where that cannot be told from the header."""
    if header.ahead is None:
        return None
    if not header.order:
        return sum(1 for _ in _lines(path, header))
    if header.row is None:
        return None
    return max(0, path.stat().st_size - header.body - header.ahead) // max(1, header.row.itemsize)


def bad_line(path: Path, header: Header) -> str | None:
    """The first line of a text file that is no point, in words; None = none."""
    if header.order or header.row is None or header.ahead is None or not header.count:
        return None
    values = _read_text(path, header)
    if values is not None and not any(np.isinf(values[name]).any() for name in values.dtype.names):
        return None
    types = [header.row[i] for i in range(len(header.names))]
    for number, line in islice(_lines(path, header), header.count):
        words = line.split()
        if len(words) != len(types):
            return f"line {number} has {len(words)} numbers, but its points have {len(types)}"
        for word, name, kind in zip(words, header.names, types, strict=True):
            if not _fits(word, kind):
                return f"line {number} has {word[:30]!r} for {name}, which is no number of that kind ({kind.name})"
    return None


def colours(path: Path) -> npt.NDArray[np.uint8] | str | None:
    """Colours [N, 3] of points whose file has them as other than bytes, by which white they fit.

    Returns:
        None = they are bytes, or there are none; text = why they cannot be told.
    """
    header = read_header(path)
    if header is None or not header.count or not set(_COLOURS) <= set(header.names):
        return None
    if header.row is None or header.ahead is None:
        return None  # then the reader's stand
    columns = [str(header.names.index(name)) for name in _COLOURS]
    if all(header.row[column] == np.uint8 for column in columns):
        return None
    rows = _read_text(path, header)
    if header.order:
        rows = np.fromfile(path, header.row, header.count, offset=header.body + header.ahead)
    if rows is None:
        return None
    values = np.stack([rows[column] for column in columns], -1).astype(np.float64)
    values[~np.isfinite(values)] = 0.0
    low, high = values.min(), values.max()
    floating = any(header.row[column].kind == "f" for column in columns)
    white = next((white for white in ((1.0, 255.0) if floating else (255.0, 65535.0)) if high <= white), None)
    if white is None or low < 0.0:
        return f"its colours lie between {low:g} and {high:g}, which is neither 0 to 1 nor 0 to 255 nor 0 to 65535"
    return np.uint8(values * (255.0 / white) + 0.5)


def _lines(path: Path, header: Header) -> Iterator[tuple[int, str]]:
    """Number, from 1 in the file, and text of each line of points; empty ones do not count."""
    with open(path, encoding="latin-1") as file:
        filled = ((number, line) for number, line in enumerate(file, 1) if number > header.lines and line.strip())
        yield from islice(filled, header.ahead, None)


def _read_text(path: Path, header: Header) -> np.ndarray | None:
    """The points of a text file; None where a line is none."""
    if header.order:
        return None
    text = (line for _, line in islice(_lines(path, header), header.count))
    with warnings.catch_warnings(), np.errstate(over="ignore"):
        warnings.simplefilter("error", DeprecationWarning)  # a fraction for a whole number
        try:
            return np.loadtxt(text, header.row, comments=None, ndmin=1)
        except (ValueError, DeprecationWarning):
            return None


def _fits(word: str, kind: np.dtype) -> bool:
    try:
        if kind.kind == "f":
            return not abs(float(word)) > float(np.finfo(kind).max)
        return np.iinfo(kind).min <= int(word) <= np.iinfo(kind).max
    except ValueError:
        return False
