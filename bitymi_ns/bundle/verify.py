"""Checks of a bundle on its own: files, numbers, tiles, statements of bundle.json."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from . import compact
from .manifest import MANIFEST, BundleError, Manifest
from .notes import read_notes
from .parts import NOTES, Parts, parts_of
from .read import CONTENTS, Bundle, assemble, manifest_of, read_file
from .sizes import enough_memory
from .world import World, WorldEntry

SLACK_STEPS = 0.02  # 8-bit steps by which a measured error may exceed the stated one


@dataclass(frozen=True)
class Check:
    name: str
    ok: bool
    detail: str


def check_files(folder: str | Path) -> tuple[Bundle | None, list[Check]]:
    """Check a bundle: sizes and hashes of its files, formats, numbers, tiles. Returns it; None: unreadable."""
    try:
        with parts_of(folder) as parts:
            info = manifest_of(parts)
            checks = [Check(MANIFEST, True, f"version {info.version}, by {info.generator}{_format_world(info.world)}")]
            bundle = _check_contents(parts, info, checks)
            if bundle is not None:
                checks += [_tiles(bundle), _check_counts(bundle), *check_certificate(bundle)]
                try:
                    notes = read_notes(parts)
                    checks += [] if notes is None else [Check(NOTES, True, notes[1].contents)]
                except BundleError as error:
                    checks.append(Check(NOTES, False, str(error)))
            return bundle, checks
    except BundleError as error:
        return None, [Check(MANIFEST, False, str(error))]


def _check_contents(parts: Parts, info: Manifest, checks: list[Check]) -> Bundle | None:
    """Add the checks of the files that bundle.json lists, and return what they hold; None: unreadable."""
    files: dict[str, bytearray] = {}
    try:
        with enough_memory(parts.bundle, info):
            for name, entry in info.files.items():
                try:
                    files[name] = read_file(parts, info, name, keep=name in CONTENTS)
                    checks.append(Check(name, True, f"{entry.bytes:,} bytes, sha256 as stated"))
                except BundleError as error:
                    checks.append(Check(name, False, str(error)))
            if not all(check.ok for check in checks):
                return None
            bundle = assemble(parts.bundle, info, files)
    except BundleError as error:
        checks.append(Check("contents", False, str(error)))
        return None
    checks.append(Check("contents", True, f"{len(bundle):,} surfels, all numbers finite, tiles inside the atlas"))
    if info.decoded is not None:  # the integers of a compact bundle, as decoded here
        same = compact.decoded_hash(info, files) == info.decoded
        checks.append(Check("decoder", same, f"the integers are {'those' if same else 'not those'} that were written"))
    return bundle


def _format_world(frame: WorldEntry) -> str:
    """Format up vector and metres per unit, if stated."""
    text = "" if frame.up is None else f", up ({', '.join(f'{x:.3f}' for x in frame.up)}) by {frame.up_from}"
    return text + ("" if frame.metres_per_unit is None else f", {frame.metres_per_unit:.4g} m per unit")


def check_world(stated: WorldEntry, world: World) -> Check:
    """Compare the frame in bundle.json with that of the training run."""
    wrong = []
    for key, of_run in world.described().items():
        value = getattr(stated, key)
        if value is None:
            continue
        same = value == of_run if isinstance(of_run, str) else np.allclose(value, of_run, rtol=1e-4, atol=1e-5)
        wrong += [] if same else [f"{key} is {value}, that of the run {of_run}"]
    return Check("frame of the scene", not wrong, "; ".join(wrong) or "as the run has it")


def check_certificate(bundle: Bundle) -> list[Check]:
    """Check that the certificate's numbers, if there are any, fit each other."""
    stated = bundle.info.statistics.certificate
    if stated is None:
        return []
    worst, count = stated.worst, stated.within + stated.beyond
    detail = f"{stated.within:,} of {count:,} surfels within {stated.tolerance:g} steps of the {stated.against} as seen"
    detail += f" in colour, at most {steps_text(worst)}"
    wrong = count > len(bundle) or (worst is not None and (worst > stated.tolerance) != (stated.beyond > 0))
    return [Check("certificate", not wrong, detail + (": these numbers contradict each other" if wrong else ""))]


def steps_text(error: float | None) -> str:
    return "not as a number" if error is None else f"{error:.3f}"


def _tiles(bundle: Bundle) -> Check:
    """Check that tiles are powers of two on the grid of 4 x 4 blocks and do not overlap."""
    tiled = bundle.scene.tiles[bundle.scene.tiles[:, 3] > 0].long()
    if len(tiled) == 0:
        return Check("tiles", True, "none")
    sides = tiled[:, 3:]
    if ((sides & (sides - 1)) != 0).any() or (tiled[:, [0, 1, 3, 4]] % 4 != 0).any():
        return Check("tiles", False, "a tile is not a power of two on the grid of 4 x 4 blocks")
    blocks = int((sides // 4).prod(1).sum())
    owned = int((_count_tiles(tiled, bundle.scene.atlas) > 0).sum())
    if owned != blocks:
        return Check("tiles", False, f"{blocks - owned:,} blocks belong to more than one tile")
    return Check("tiles", True, f"{len(tiled):,} of {len(bundle):,} surfels, {16 * blocks:,} texels, no two overlap")


def _count_tiles(tiles: Tensor, atlas: Tensor | None) -> Tensor:
    """Count the tiles over each 4 x 4 block, [layers, height / 4, width / 4], by prefix sums of corner marks."""
    layers, height, width = (1, 4, 4) if atlas is None else atlas.shape[:3]
    counts = torch.zeros(layers, height // 4 + 1, width // 4 + 1, dtype=torch.int32)
    x, y, layer, r_u, r_v = tiles.unbind(1)
    one = torch.ones(len(tiles), dtype=torch.int32)
    for dx, dy, sign in ((0, 0, 1), (1, 0, -1), (0, 1, -1), (1, 1, 1)):
        counts.index_put_((layer, (y + dy * r_v) // 4, (x + dx * r_u) // 4), sign * one, accumulate=True)
    return counts.cumsum(1).cumsum(2)[:, :-1, :-1]


def _check_counts(bundle: Bundle) -> Check:
    statistics, scene = bundle.info.statistics, bundle.scene
    surfels, texels, reduced = statistics.surfels, statistics.texels, statistics.view_color
    counts = [
        ("surfels kept", surfels and surfels.kept, len(bundle)),
        ("texels kept", texels and texels.kept, int(scene.tiles[:, 3:].long().prod(1).sum())),
        ("surfels without_tile", surfels and surfels.without_tile, int((scene.tiles[:, 3] == 0).sum())),
    ]
    if reduced is not None and "view_terms" in scene.surfels:
        one_color = int((scene.surfels["view_span"][:, 1] == 0).sum())
        counts += [
            ("view colour sites", reduced.sites.after, len(bundle) + len(scene.surfels["view_terms"])),
            ("surfels of one colour", reduced.one_color, one_color),
        ]
    for name, stated, there in counts:
        if stated is not None and stated != there:
            return Check("statistics", False, f"{name}: {stated:,} stated, {there:,} found")
    detail = "agree with the files"
    if reduced is not None:
        detail += (
            f"; error of a view colour at most {steps_text(reduced.error.p100)} steps, tolerance {reduced.tolerance:g}"
        )
    return Check("statistics", True, detail)
