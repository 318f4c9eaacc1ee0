"""Checks of a bundle's files before they are read: headers, bundle.json, memory."""

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from bitymi_ns.bundle import compact, ktx2, ply
from bitymi_ns.bundle.manifest import ATLAS, COMPACT_SURFELS, MANIFEST, SURFELS, TEXELS, BundleError, Manifest
from bitymi_ns.bundle.surfel_table import TERMS
from bitymi_ns.files import size_text

SCENE_FILES = frozenset((SURFELS, ATLAS, COMPACT_SURFELS, TEXELS))  # the files of which a scene is made
HEAD = max(ply.HEADER_LIMIT, ktx2.HEADER_LIMIT)  # bytes from the start of a file that `check_head` reads
_SURFEL_BYTES, _TERM_BYTES, _TEXEL_BYTES = 340, 150, 60
"""Bytes of a compact bundle while it is decoded: 2 million surfels took 370 each, 4 million terms 165, 17 million
texels 67 with their pages."""


def check_head(info: Manifest, name: str, head: bytes, size: int) -> None:
    """Refuse a file of surfels or texels whose beginning contradicts its size or bundle.json; other files pass.

    Raises:
        PlyError, Ktx2Error, StreamError: say why.
    """
    surfels, atlas = info.surfels, info.atlas
    if name == SURFELS:
        elements = ply.read_header(head, size).elements
        count, terms = elements["vertex"].count, elements[TERMS].count if TERMS in elements else None
        if count != surfels.count:
            raise ply.PlyError(f"it has {count} surfels, surfels.count of {MANIFEST} says {surfels.count}")
        if terms != surfels.terms:
            raise ply.PlyError(f"it has {terms} view-colour terms, surfels.terms of {MANIFEST} says {surfels.terms}")
    elif name == ATLAS:
        header = ktx2.read_header(head, size)
        found = (header.format, header.width, header.height, header.layers)
        if atlas is None or found != (atlas.format, atlas.width, atlas.height, atlas.layers):
            raise ktx2.Ktx2Error(f"format and size {found} are not those of {MANIFEST}")
    elif name == COMPACT_SURFELS:
        compact.check_surfels_size(surfels, size)
    elif name == TEXELS and atlas is not None:
        compact.check_texels_size(atlas, size, info.files[COMPACT_SURFELS].bytes)


@contextmanager
def enough_memory(bundle: Path, info: Manifest) -> Iterator[None]:
    """Report a lack of memory for a bundle's contents as a BundleError with the size of the files."""
    try:
        yield
    except MemoryError as error:
        size = sum(entry.bytes for name, entry in info.files.items() if name in SCENE_FILES)
        raise BundleError(f"{bundle} needs more memory than there is: its files have {size / 1e6:.0f} MB") from error


def check_memory(bundle: Path, info: Manifest, name: str) -> None:
    """Refuse a file of surfels or texels whose contents cannot be held on this machine, before they are read.

    Raises:
        BundleError: says what they take at least.
    """
    least, there = least_memory(info, name), machine_memory()
    if least > there:
        needs = f"{bundle / name} needs more memory than there is: its contents take at least {size_text(least)}"
        raise BundleError(f"{needs}, this machine has {size_text(there)}")


def least_memory(info: Manifest, name: str) -> int:
    """Bytes that reading such a file takes at least: itself, what it is decoded to on the way, pages."""
    surfels, atlas, total = info.surfels, info.atlas, info.files[name].bytes
    if name == COMPACT_SURFELS:
        total += _SURFEL_BYTES * surfels.count + _TERM_BYTES * (surfels.terms or 0)
    elif name in (ATLAS, TEXELS) and atlas is not None:
        total += 4 * atlas.width * atlas.height * atlas.layers + _TEXEL_BYTES * (atlas.texels or 0)
    return total


def machine_memory() -> int:
    """Bytes of memory that this machine has, or that this process may use of it."""
    return int(min(psutil.virtual_memory().total, memory_limit()))


def memory_limit(mount: Path = Path("/sys/fs/cgroup"), cgroups: Path = Path("/proc/self/cgroup")) -> float:
    """Bytes that the control groups (v2 and v1) of this process may take; infinite where none has a limit."""
    found = [math.inf]
    with suppress(OSError):  # no Linux
        for line in cgroups.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers and "memory" not in controllers.split(","):
                continue
            base, name = (mount / "memory", "memory.limit_in_bytes") if controllers else (mount, "memory.max")
            folder = base / path.lstrip("/")
            for each in (folder, *folder.parents):
                with suppress(OSError, ValueError):  # of another namespace; "max"
                    found.append(float((each / name).read_text()))
                if each == base:
                    break
    return min(found)
