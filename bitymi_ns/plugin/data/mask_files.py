"""Masks of the photographs of a capture: found where its files name none, and checked before anything uses them."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bitymi_ns.capture.masks import in_proportion, mask_folder, mask_of
from bitymi_ns.capture.pictures import DYNAMIC_MASK
from bitymi_ns.plugin.console import fail, listed, say
from bitymi_ns.plugin.data.images import image_size, in_threads, read_mask, wrong_size
from bitymi_ns.plugin.data.views import Photograph

LEAVE_OUT = "`bitymi-data --use-masks False` leaves masks out"
"""Says in messages how to do without the masks of a capture."""


def masks_named(masks: Path, names: Sequence[str], needed: bool = True) -> list[Path] | None:
    """Find the masks of photographs by their names in a folder of masks; None = it has none of them, where none is
    `needed`.

    Raises:
        InputError: some photographs have a mask, and others none.
    """
    found = {name: mask_of(masks, name) for name in names}
    missing = [name for name, file in found.items() if file is None]
    if len(missing) == len(found) and not needed:
        return None
    if missing:
        others = "" if len(missing) == len(found) else ", but of others"
        fail(
            f"{masks} has no mask of {listed(missing)}{others}. Give every photograph a mask of its name with .png (a "
            f"white picture lets all pixels count); {LEAVE_OUT}."
        )
    return [file for name in names if (file := found[name]) is not None]


def with_masks(photographs: Sequence[Photograph], capture: Path, base: Path | None = None) -> list[Photograph]:
    """Give photographs without masks those that lie beside them, with a line that says so: instant-ngp's, of which
    some may be missing, or those of a folder `masks`; see `mask_folder`.

    Args:
        capture: folder of the capture.
        base: folder to which the names of masks are relative; None = the one that holds all photographs.

    Raises:
        InputError: the folder has masks of some photographs only.
    """
    files = [each.file for each in photographs]
    dynamic = [file.with_name(f"{DYNAMIC_MASK}{file.stem}.png") for file in files]
    found: Sequence[Path | None] | None = [file if file.is_file() else None for file in dynamic]
    if any(found):
        count = sum(file is not None for file in found)
        said = f"{count} masks {DYNAMIC_MASK}*.png beside {len(files)} photographs are used, of which black counts"
    else:
        base = base or Path(os.path.commonpath([os.path.abspath(file.parent) for file in files]))
        masks = mask_folder(base, capture)
        names = [os.path.relpath(file, base) for file in files]
        found = None if masks is None else masks_named(masks, names, needed=False)
        said = f"The masks of {masks} are used, of which black does not count"
    if found is None:
        return list(photographs)
    say(f"{said}; {LEAVE_OUT}.")
    return [replace(each, mask=mask) for each, mask in zip(photographs, found, strict=True)]


def check_masks(photographs: Sequence[Photograph]) -> None:
    """Fail where masks are missing or cannot be used, before time is spent on the photographs."""
    masked = {each.mask: each for each in photographs if each.mask is not None}
    missing = [mask for mask in masked if not mask.exists()]
    if missing:
        fail(
            f"{len(missing)} of {len(masked)} masks of the capture are missing: {listed(missing)}. Put them there, or "
            f"correct their names; {LEAVE_OUT}."
        )
    sizes = in_threads(image_size, masked)
    for (mask, photograph), known in zip(masked.items(), sizes, strict=True):
        size = known or read_mask(mask).size  # which says what is wrong with it
        if not in_proportion(size, photograph.camera.size):
            fail(f"{wrong_size(mask, size, photograph.camera.size)} {LEAVE_OUT[0].upper()}{LEAVE_OUT[1:]}.")
