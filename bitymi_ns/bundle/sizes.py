"""Checks of a bundle's files before reading: headers, bundle.json, memory."""

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from bitymi_ns import ply
from bitymi_ns.exit_messages import out_of_memory
from bitymi_ns.files import size_text
from . import compact, ktx2
from .manifest import ATLAS, COMPACT_SURFELS, MANIFEST, SURFELS, TEXELS, BundleError, Manifest
from .surfel_table import TERMS

SCENE_FILES = frozenset((SURFELS, ATLAS, COMPACT_SURFELS, TEXELS))  # surfels and texels
HEAD = max(ply.HEADER_LIMIT, ktx2.HEADER_LIMIT)  # leading bytes that `check_head` reads
_SURFEL_BYTES, _TERM_BYTES, _TEXEL_BYTES = 340, 150, 60
"""Lower bounds of the memory for decoding a compact bundle, bytes; measured: 370 per surfel (2 million), 165 per term
(4 million), 67 per texel with its pages (17 million)."""


def check_head(info: Manifest, name: str, head: bytes, size: int) -> None:
    """Check the beginning of a file of surfels or texels against its size and bundle.json. Raises PlyError, Ktx2Error,
    StreamError: they differ."""
    surfels, atlas = info.surfels, info.atlas
    if name == SURFELS:
        elements = ply.header_of(head, size).elements
        count = elements["vertex"].count
        terms = elements[TERMS].count if TERMS in elements else None
        if count != surfels.count:
            raise ply.PlyError(f"it has {count} surfels, surfels.count of {MANIFEST} says {surfels.count}")
        if terms != surfels.terms:
            raise ply.PlyError(f"it has {terms} view-colour terms, surfels.terms of {MANIFEST} says {surfels.terms}")
    elif name == ATLAS:
        header = ktx2.read_header(head, size)
        kind = (header.format, header.width, header.height, header.layers)
        if atlas is None or kind != (atlas.format, atlas.width, atlas.height, atlas.layers):
            raise ktx2.Ktx2Error(f"format and size {kind} are not those of {MANIFEST}")
    elif name == COMPACT_SURFELS or (name == TEXELS and atlas is not None):
        compact.check_size(info, name, size)


@contextmanager
def enough_memory(bundle: Path, info: Manifest) -> Iterator[None]:
    """Convert a lack of memory into a BundleError that states the size of the files."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not out_of_memory(error):
            raise
        size = sum(entry.bytes for name, entry in info.files.items() if name in SCENE_FILES)
        raise BundleError(f"{bundle} needs more memory than there is: its files have {size / 1e6:.0f} MB") from error


def check_memory(bundle: Path, info: Manifest, name: str) -> None:
    """Check that a file of surfels or texels fits into this machine's memory. Raises BundleError: states the memory
    needed."""
    least, there = least_memory(info, name), machine_memory()
    if least > there:
        takes = f"its contents take at least {size_text(least)}, this machine has {size_text(there)}"
        raise BundleError(f"{bundle / name} needs more memory than there is: {takes}")


def least_memory(info: Manifest, name: str) -> int:
    """Estimate the least memory for reading a file of surfels or texels, bytes."""
    surfels, atlas, total = info.surfels, info.atlas, info.files[name].bytes
    if name == COMPACT_SURFELS:
        total += _SURFEL_BYTES * surfels.count + _TERM_BYTES * (surfels.terms or 0)
    elif name in (ATLAS, TEXELS) and atlas is not None:
        total += 4 * atlas.width * atlas.height * atlas.layers + _TEXEL_BYTES * (atlas.texels or 0)
    return total


def machine_memory() -> int:
    """Return the memory of this machine, or this process's lower limit, in bytes."""
    return int(min(psutil.virtual_memory().total, memory_limit()))


def memory_limit(mount: Path = Path("/sys/fs/cgroup"), cgroups: Path = Path("/proc/self/cgroup")) -> float:
    """Return the memory limit of this process's control groups (v2 and v1), bytes; infinite without one."""
    limits = [math.inf]
    with suppress(OSError):  # not Linux
        for line in cgroups.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers and "memory" not in controllers.split(","):
                continue
            base, name = (mount / "memory", "memory.limit_in_bytes") if controllers else (mount, "memory.max")
            folder = base / path.lstrip("/")
            for group in (folder, *folder.parents):
                with suppress(OSError, ValueError):  # another namespace; "max"
                    limits.append(float((group / name).read_text()))
                if group == base:
                    break
    return min(limits)
