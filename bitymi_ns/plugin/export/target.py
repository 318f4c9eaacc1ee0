"""Checks of the output folder before the work: writable, free, with enough disk space."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.manifest import MANIFEST
from bitymi_ns.bundle.parts import check_target
from bitymi_ns.codec.quantise import BYTES_PER_TEXEL
from bitymi_ns.files import explained, free_bytes, reserved, size_text
from bitymi_ns.plugin.console import InputError, fail, warn

SURFEL_BYTES = 60 * 4  # bytes of a surfel's parameters. A checkpoint holds them three times, with Adam's two moments.
TYPICAL_SIDE = 32  # side of a texture tile in texels, estimated generously: within a tolerance most are far smaller


@contextmanager
def reserve_bundle(folder: Path, overwrite: bool) -> Iterator[None]:
    """Lock the folder of a bundle; stop where another process has it, or a bundle may not or cannot be written.

    Raises:
        BundleError: there is a bundle, or other files.
    """
    with ExitStack() as stack:
        with explained(folder, InputError, " (--output-dir)."):
            stack.enter_context(reserved(folder, warn))
            check_target(folder, overwrite)
        yield


def check_room(folder: Path, load_config: Path, options: BakeOptions, exact: bool) -> None:
    """Stop where there may be too little room for a bundle."""
    needed, free = space_needed(load_config, options, exact), free_bytes(folder)
    if free < needed:
        beside = " beside the earlier one" if folder.exists() else ""
        fail(
            f"there may be too little room for {folder}: {size_text(free)} are free, and a bundle of this scene may "
            f"take up to {size_text(needed)}{beside} (a generous estimate by the size of its checkpoint). Free some "
            "space, give an --output-dir on another disk, or try it all the same with --check-room False: if the disk "
            "gets full, nothing is left behind."
        )


def space_needed(load_config: Path, options: BakeOptions, exact: bool) -> int:
    """A generous estimate of the bytes of a run's bundle.

    It assumes that the newest checkpoint holds nothing but surfels, each with a tile of 32 x 32 texels, or with the
    largest tile where everything is kept.

    Args:
        load_config: config.yml of the run; without a checkpoint beside it the estimate is 0.
        exact: whether everything is kept.
    """
    newest = max(load_config.parent.glob("*/step-*.ckpt"), default=None)
    surfels = newest.stat().st_size // (3 * SURFEL_BYTES) if newest is not None else 0
    side = options.r_max if exact else min(options.r_max, TYPICAL_SIDE)
    texel = 1 if options.bundle_format == "compact" else BYTES_PER_TEXEL[options.texel_format]
    return surfels * (SURFEL_BYTES + side * side * texel)


def bundle_version(folder: Path) -> tuple[int, int] | None:
    """Identity of the bundle file in a folder, inode and time; None where there is none."""
    try:
        found = (folder / MANIFEST).stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns
