"""PLY file of a bundle: binary little-endian, float and int properties, element `vertex` first."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bitymi_ns.ply import HEADER_LIMIT, Header, PlyError, parse_header

__all__ = ["HEADER_LIMIT", "PlyError", "parse_ply", "read_header", "write_ply"]


def write_ply(
    path: str | Path,
    columns: Mapping[str, npt.NDArray],
    comments: Sequence[str] = (),
    more: Mapping[str, Mapping[str, npt.NDArray]] | None = None,
) -> None:
    """Write columns [N] as properties of `vertex`, in order: integers as `int`, others as `float`. `comments`: lines of
    the header. `more`: columns of further elements by name, in order."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    body = []
    for element, properties in {"vertex": columns, **(more or {})}.items():
        count = {len(column) for column in properties.values()}
        if len(count) != 1:
            raise PlyError(f"the columns of a PLY element need one length, not {sorted(count)}")
        integer = {name: np.issubdtype(column.dtype, np.integer) for name, column in properties.items()}
        rows = np.empty(count.pop(), dtype=[(name, "<i4" if integer[name] else "<f4") for name in properties])
        for name, column in properties.items():
            rows[name] = column
        header += [f"element {element} {len(rows)}"]
        header += [f"property {'int' if integer[name] else 'float'} {name}" for name in properties]
        body.append(rows)
    with open(path, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        for rows in body:
            file.write(rows.tobytes())


def read_header(data: bytes | bytearray, size: int) -> Header:
    """Parse the header in the first `HEADER_LIMIT` bytes of a file, or more. `size`: bytes of the whole file. Raises
    PlyError: another kind of PLY, or a size that does not match."""
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
    """Parse a whole file written by `write_ply`: element to name to [N] float32 or int32 array, in the file's order;
    the first element is `vertex`. Raises PlyError: another kind of PLY, a length that does not match the header, or a
    value that is not finite."""
    header = read_header(data, len(data))
    elements, at = {}, header.start
    for element, declared in header.elements.items():
        rows = np.frombuffer(data, dtype=declared.row, count=declared.count, offset=at)
        at += rows.nbytes
        elements[element] = {name: np.ascontiguousarray(rows[name]) for name in declared.names}
        for name, column in elements[element].items():
            bad = ~np.isfinite(column)
            if bad.any():
                raise PlyError(f"{name} is not finite in row {int(np.flatnonzero(bad)[0])}")
    return elements
