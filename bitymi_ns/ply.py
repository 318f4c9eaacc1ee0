"""Read PLY files, binary or text, and write binary ones. plyfile is not used: it is under the GPL, and allocates memory
for as many rows of text as a header claims."""

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import TextIOWrapper
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .safe_reading import open_regular

HEADER_LIMIT = 1 << 16  # maximum length of a header, bytes
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
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_MAGIC = re.compile(rb"ply[ \t]*\r?\n")
_END = re.compile(rb"\nend_header[ \t]*\r?\n")


class PlyError(ValueError):
    """The data is no PLY file, or not of the required kind."""


@dataclass(frozen=True)
class Element:
    count: int  # of rows
    names: tuple[str, ...]  # of properties
    row: np.dtype | None  # a field per property; None if one is a list


@dataclass(frozen=True)
class Header:
    order: str  # byte order, < or >; "" in a text file
    elements: dict[str, Element]  # by name, in the file's order
    start: int  # offset of the rows, bytes
    lines: int  # number of lines of the header

    def ahead(self, name: str) -> int | None:
        """Count the lines (of a text file) or bytes between the header and an element's rows; None if unknown because
        of lists."""
        total = 0
        for earlier, element in self.elements.items():
            if earlier == name:
                break
            if self.order and element.row is None:
                return None
            total += element.count * (element.row.itemsize if self.order and element.row is not None else 1)
        return total


def read_header(path: Path) -> Header:
    with open_regular(path) as file:
        return parse_header(file.read(HEADER_LIMIT))


def parse_header(data: bytes | bytearray) -> Header:
    """Parse the header from a file's contents, or its first `HEADER_LIMIT` bytes. Raises PlyError."""
    end = _END.search(data, 0, HEADER_LIMIT)
    if not _MAGIC.match(data) or end is None:
        raise PlyError("not a PLY file")
    lines = data[: end.start()].decode("latin-1").split("\n")[1:]
    lines = [line for line in lines if line.split()[:1] not in ([], ["comment"], ["obj_info"])]
    if not all(line.isascii() for line in lines):
        raise PlyError("the PLY header is not ASCII text")
    form = lines[0].split() if lines else []
    if len(form) != 3 or form[0] != "format" or form[1] not in _ORDERS or form[2] != "1.0":
        raise PlyError(f"the PLY header names no known format: {' '.join(form)!r}")
    order = _ORDERS[form[1]]
    elements = _elements(lines[1:], order)
    return Header(order, elements, end.end(), data.count(b"\n", 0, end.end()))


def _elements(lines: Sequence[str], order: str) -> dict[str, Element]:
    found: dict[str, tuple[int, dict[str, str | None]]] = {}
    properties: dict[str, str | None] = {}
    for line in lines:
        match line.split():
            case ["element", name, count] if name not in found:
                if not re.fullmatch(r"[0-9]{1,10}", count):
                    raise PlyError(f"the count {count!r} of the element {name} is not a number")
                properties = {}
                found[name] = int(count), properties
            case ["property", *kind, name] if found and _known(kind):
                if name in properties:
                    raise PlyError(f"the PLY header declares the property {name} twice")
                properties[name] = _TYPES[kind[0]] if len(kind) == 1 else None
            case _:
                raise PlyError(f"the PLY header has a line that is not understood: {line.strip()!r}")
    return {name: Element(count, tuple(own), _row(own, order)) for name, (count, own) in found.items()}


def _known(kind: Sequence[str]) -> bool:
    if len(kind) == 3 and kind[0] == "list":
        kind = kind[1:]
    else:
        kind = kind if len(kind) == 1 else [""]
    return all(name in _TYPES for name in kind)


def _row(properties: dict[str, str | None], order: str) -> np.dtype | None:
    types = [(name, f"{order}{kind}") for name, kind in properties.items() if kind is not None]
    return np.dtype(types) if len(types) == len(properties) else None


def read_rows(path: Path, header: Header, name: str) -> npt.NDArray[np.void]:
    """Read the rows of an element, [count], a field per property. Raises PlyError: the element or a binary element
    before it has lists, rows are missing, or a line of text is malformed."""
    element, ahead = header.elements[name], header.ahead(name)
    if element.row is None or ahead is None:
        raise PlyError(f"the rows of the element {name} have lists, or stand behind some")
    if not header.order:
        text = (line for _, line in islice(text_lines(path, header, name), element.count))
        with warnings.catch_warnings(), np.errstate(over="ignore"):
            warnings.simplefilter("error", DeprecationWarning)  # a fraction for an integer
            warnings.filterwarnings("ignore", "loadtxt", UserWarning)  # no lines
            parse = partial(np.loadtxt, dtype=element.row, comments=None, ndmin=1)
            try:
                rows = parse(text)
            except (ValueError, DeprecationWarning):
                for number, line in islice(text_lines(path, header, name), element.count):
                    try:
                        parse([line])
                    except (ValueError, DeprecationWarning) as error:
                        row = ", ".join(f"{one} ({element.row[one]})" for one in element.names)
                        raise PlyError(f"line {number} is not {row[:200]}, but {line.strip()[:40]!r}") from error
                raise
    else:
        there = max(0, path.stat().st_size - header.start - ahead) // max(1, element.row.itemsize)  # fromfile allocates
        rows = np.fromfile(path, element.row, min(there, element.count), offset=header.start + ahead)
    if len(rows) < element.count:
        raise PlyError(f"it is cut off: it has {len(rows)} of {element.count} rows of the element {name}")
    return rows


def text_lines(path: Path, header: Header, name: str) -> Iterator[tuple[int, str]]:
    """Iterate over the nonempty lines from an element's first row on: line number in the file, from 1, and text."""
    with TextIOWrapper(open_regular(path), encoding="latin-1", newline="\n") as file:
        filled = ((number, line) for number, line in enumerate(file, 1) if number > header.lines and line.strip())
        yield from islice(filled, header.ahead(name), None)


def write_ply(
    path: str | Path,
    columns: Mapping[str, npt.NDArray],
    comments: Sequence[str] = (),
    more: Mapping[str, Mapping[str, npt.NDArray]] | None = None,
) -> None:
    """Write columns [N] as properties of `vertex`, binary little-endian: uint8 as `uchar`, other integers as `int`,
    others as `float`. `comments`: lines of the header. `more`: columns of further elements by name."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    body = []
    for element, properties in {"vertex": columns, **(more or {})}.items():
        count = {len(column) for column in properties.values()}
        if len(count) != 1:
            raise PlyError(f"the columns of a PLY element need one length, not {sorted(count)}")
        kinds = {name: _kind_of(column.dtype) for name, column in properties.items()}
        rows = np.empty(count.pop(), [(name, f"<{_TYPES[kind]}") for name, kind in kinds.items()])
        for name, column in properties.items():
            rows[name] = column
        header += [f"element {element} {len(rows)}", *(f"property {kind} {name}" for name, kind in kinds.items())]
        body.append(rows)
    with open(path, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        for rows in body:
            file.write(rows.tobytes())


def _kind_of(dtype: np.dtype) -> str:
    return "uchar" if dtype == np.uint8 else "int" if np.issubdtype(dtype, np.integer) else "float"


def write_cloud(path: Path, points: npt.NDArray, colors: npt.NDArray) -> None:
    """Write points [n, 3] with colors [n, 3] uint8."""
    names = zip(("x", "y", "z", "red", "green", "blue"), (*points.T, *colors.astype(np.uint8).T), strict=True)
    write_ply(path, dict(names))


def header_of(data: bytes | bytearray, size: int) -> Header:
    """Parse the header in the first `HEADER_LIMIT` bytes of a bundle's file of `size` bytes. Raises PlyError: not
    binary little-endian, `vertex` is not first, a property is not float or int, or the size differs."""
    header = parse_header(data)
    if header.order != "<":
        raise PlyError("not a binary little-endian PLY file of version 1.0")
    if next(iter(header.elements), "") != "vertex" or not all(e.names for e in header.elements.values()):
        raise PlyError("the PLY header declares no vertices, or an element without properties")
    total = header.start
    for name, element in header.elements.items():
        kinds = {element.row[column] for column in element.names} if element.row is not None else {None}
        if not kinds <= {np.dtype("<f4"), np.dtype("<i4")}:
            raise PlyError(f"the element {name} has properties that are not float or int")
        total += element.count * (element.row.itemsize if element.row is not None else 0)
    if total != size:
        counts = ", ".join(f"{element.count} of {name}" for name, element in header.elements.items())
        raise PlyError(f"truncated or too long: {counts} need {total} bytes, the file has {size}")
    return header


def parse_ply(data: bytes | bytearray) -> dict[str, dict[str, npt.NDArray]]:
    """Parse a whole file: element to name to [N] float32 or int32 array, in the file's order. Raises PlyError: as
    `header_of`, or a value is not finite."""
    header = header_of(data, len(data))
    elements, offset = {}, header.start
    for element, declared in header.elements.items():
        rows = np.frombuffer(data, dtype=declared.row, count=declared.count, offset=offset)
        offset += rows.nbytes
        elements[element] = {name: np.ascontiguousarray(rows[name]) for name in declared.names}
        for name, column in elements[element].items():
            bad = ~np.isfinite(column)
            if bad.any():
                raise PlyError(f"{name} is not finite in row {int(np.flatnonzero(bad)[0])}")
    return elements
