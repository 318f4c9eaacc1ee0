"""Writing of bundles: compact columns, or surfels.ply and atlas.ktx2, with bundle.json."""

from __future__ import annotations

import errno
import hashlib
import importlib.metadata
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from bitymi_ns import ply
from bitymi_ns.codec.limits import ALPHA_LIMIT
from bitymi_ns.codec.quantise import Atlas, EncodedAtlas
from bitymi_ns.codec.texel_codes import SceneCodes
from bitymi_ns.files import complete_folder, reason, size_text
from bitymi_ns.ops.view_color import check_reduced
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.scene.baked import BakedScene
from . import compact, ktx2
from .manifest import (
    ACTIVATIONS,
    ATLAS,
    COMPACT_SURFELS,
    MANIFEST,
    POSTER,
    SURFELS,
    TEXELS,
    VERSION,
    BundleError,
    check_file_name,
    describe,
    dump,
    points_text,
)
from .parts import NOTES, check_target, notes_data, parts_of
from .poster import Pixels, encode_poster, most_bytes
from .read import Bundle, read_bundle, read_manifest
from .surfel_table import ALPHA_COLUMN, EXTENT_COLUMN, TERMS, check_limits, check_range, term_columns, to_columns
from .world import World, same_frame

GENERATOR = f"bitymi-ns {importlib.metadata.version('bitymi-ns')}"
_CHUNK = 1 << 22


def write_bundle(
    folder: str | Path,
    scene: BakedScene,
    atlas: Atlas | None = None,
    codes: SceneCodes | None = None,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    world: World | None = None,
    statistics: Mapping[str, Any] | None = None,
    extra_files: Mapping[str, bytes] | None = None,
    loose_files: Mapping[str, bytes] | None = None,
    overwrite: bool = False,
    interchange: bool = False,
    poster: Pixels | None = None,
) -> Bundle:
    """Write a bundle and read it, before it replaces an earlier one; the folder appears complete or not at all.

    Args:
        scene: on the CPU, all numbers finite; its own atlas is ignored. An atlas with alphas requires mean alphas.
        atlas: of the texels, an `EncodedAtlas` where there are no codes; None: no texture.
        codes: of a compact bundle; scene and atlas must be decoded from them.
        statistics: of the bake (`statistics.Statistics`).
        extra_files: further files by name, such as preview.png.
        loose_files: such files that bundle.json does not cover.
        overwrite: replace an existing bundle, carrying over its notes.json.
        interchange: also write surfels.ply into a compact bundle, for other programs.
        poster: [H, W, 3] picture of the viewer's first view.

    Returns the bundle as read. Raises BundleError: the target exists or cannot be written, a value is not finite or
    beyond its limit (`limits.py`, `manifest.py`), or what was written cannot be read."""
    folder = Path(folder)
    surfels = scene.surfels
    _check_surfels(scene)
    _check_alpha(scene, atlas, codes)
    for argument, names in (("extra_files", extra_files or {}), ("loose_files", loose_files or {})):
        for name in names:
            check_file_name(name, argument)
            if name in (SURFELS, ATLAS, COMPACT_SURFELS, TEXELS, POSTER, NOTES):
                raise BundleError(f"{argument} may not replace {name}")
    info = _describe(scene, atlas, background, world or World(), statistics)
    parts = {} if codes is None else _compact_parts(codes, info)
    try:
        with complete_folder(folder, lambda: check_target(folder, overwrite)) as new:
            if codes is None or interchange:
                comments = [GENERATOR, "2D Beta surfels; see bundle.json"]
                terms = {TERMS: term_columns(surfels)} if "view_terms" in surfels else None
                ply.write_ply(new / SURFELS, to_columns(scene, _has_alpha(atlas)), comments, terms)
            if codes is None and isinstance(atlas, EncodedAtlas):
                ktx2.write_ktx2(new / ATLAS, atlas.payload, atlas.format, atlas.width, atlas.height, GENERATOR)
            for name, data in parts.items():
                (new / name).write_bytes(data)
            of_scene = sum(map(len, parts.values())) or sum(path.stat().st_size for path in new.iterdir())
            shown = None if poster is None else encode_poster(poster, most_bytes(of_scene))
            for name, data in {**({POSTER: shown} if shown else {}), **(extra_files or {})}.items():
                (new / name).write_bytes(data)
            info["files"] = {path.name: _fingerprint(path) for path in sorted(new.iterdir())}
            (new / MANIFEST).write_bytes(dump(describe(info)))
            for name, data in (loose_files or {}).items():
                (new / name).write_bytes(data)
            with parts_of(folder) as earlier:
                notes = notes_data(earlier)
            if notes is not None:
                (new / NOTES).write_bytes(notes)
            try:
                bundle = read_bundle(new)
            except BundleError as error:
                raise BundleError(f"{folder} was not written, since it could not be read: {error}") from error
            if notes is not None and not same_frame(read_manifest(folder).world, bundle.info.world):
                kept = f"{folder / NOTES} is kept, in the frame of the earlier scene"
                warnings.warn(f"{kept}: check its views, notes and crops, or remove it", stacklevel=2)
        return bundle
    except OSError as error:
        size = sum(map(len, parts.values())) or sum(value.numel() * 4 for value in surfels.values())
        size += atlas.nbytes if isinstance(atlas, EncodedAtlas) else 0
        needs = f" (it needs about {size_text(size)})" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        why = reason(error, folder)
        raise BundleError(f"{folder} cannot be written{needs}: {why}. Nothing was left behind") from error


def _compact_parts(codes: SceneCodes, info: dict[str, Any]) -> dict[str, bytes]:
    """Encode surfels.bin and texels.bin, adding their description to `info`."""
    digest = hashlib.sha256()
    of_surfels, surfels = compact.encode_surfels(
        codes.surfels, codes.residual, codes.residual_step, codes.alpha, digest
    )
    info["surfels"] |= {"file": COMPACT_SURFELS, **of_surfels}
    parts = {COMPACT_SURFELS: surfels}
    if codes.texels is not None:
        of_texels, parts[TEXELS] = compact.encode_texels(codes.texels, digest)
        pages = {"page_width": codes.page_width, "page_rows": codes.page_rows}
        info["atlas"] |= {"file": TEXELS, "format": "dct", **pages, **of_texels}
        info["atlas"].pop("extent_column")
        if "atlas" in info["statistics"]:
            cost = dict(info["statistics"]["atlas"])
            info["statistics"]["atlas"] = {**cost, "bytes": len(parts[TEXELS])}
    info["decoded"] = digest.hexdigest()
    return parts


def _describe(
    scene: BakedScene,
    atlas: Atlas | None,
    background: Sequence[float],
    world: World,
    statistics: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Build the `info` of `manifest.describe`, without the list of files."""
    surfels, kind = scene.surfels, scene.view_color
    entry = VIEW_COLORS[kind]
    means, reduced = surfels["means"].detach(), "view_terms" in surfels
    empty = len(means) == 0
    described: dict[str, Any] = {
        "version": VERSION,
        "generator": GENERATOR,
        "surfels": {"count": len(means), "view_color": kind},
        "atlas": None,
        "render": {
            "near": scene.near,
            "weight_bound": scene.weight_bound,
            "photographed": None if scene.photographed is None else points_text(scene.photographed),
            "background": list(background),
        },
        "world": world.described(),
        "bounds": {"min": [0.0] * 3 if empty else means.amin(0), "max": [0.0] * 3 if empty else means.amax(0)},
        "statistics": dict(statistics or {}),
    }
    if reduced:
        described["surfels"]["terms"] = len(surfels["view_terms"])
        described["surfels"]["view_terms"] = entry.reduced_formula
    else:
        if entry.stated is not None:
            described["surfels"][entry.stated] = entry.terms(surfels)
        own = {p.name: p.activation for p in entry.parameters if p.activation is not None}
        if own:
            described["surfels"]["activations"] = {**ACTIVATIONS, **own}
    if atlas is not None:
        same = ("format", "width", "height", "layers", "clipped_fraction", "encoder", "psnr")
        described["atlas"] = {
            **{name: getattr(atlas, name) for name in same},
            "extent_column": EXTENT_COLUMN,
            "offset": atlas.range.offset,
            "scale": atlas.range.scale,
            "range": atlas.range.rule,
            "alpha_scale": atlas.alpha_scale or None,
        }
    return described


def _has_alpha(atlas: Atlas | None) -> bool:
    return atlas is not None and atlas.alpha_scale > 0


def _check_alpha(scene: BakedScene, atlas: Atlas | None, codes: SceneCodes | None) -> None:
    """Check that atlas and codes agree on having alphas, and that mean alphas are in range."""
    if codes is not None and codes.texels is not None and (codes.alpha is not None) != _has_alpha(atlas):
        raise BundleError("the atlas and the codes of the texels disagree whether there are alphas")
    if not _has_alpha(atlas):
        return
    if scene.mean_alpha is None:
        raise BundleError("the atlas has alphas, the surfels have no mean alphas")
    check_range(ALPHA_COLUMN, scene.mean_alpha, 0.0, ALPHA_LIMIT, BundleError)


def _check_surfels(scene: BakedScene) -> None:
    surfels = scene.surfels
    tiles = scene.tiles
    kind = scene.view_color
    mean_residual = scene.mean_residual
    if "view_terms" in surfels:
        try:
            check_reduced(kind, surfels, len(tiles))
        except ValueError as error:
            raise BundleError(str(error)) from error
    for name, value in surfels.items():
        if name != "view_terms" and len(value) != len(tiles):
            raise BundleError(f"{name} has {len(value)} rows, the tiles have {len(tiles)}")
        finite = torch.isfinite(value).unsqueeze(-1).flatten(1).all(1)
        if not finite.all():
            raise BundleError(f"{name} is not finite in row {int(torch.nonzero(~finite)[0])}")
    check_limits({**surfels, **({} if mean_residual is None else {"mean_residual": mean_residual})}, kind, BundleError)
    turned = surfels["quats"].norm(dim=1) > 1e-12
    if not turned.all():
        raise BundleError(f"quats has the length 0 in row {int(torch.nonzero(~turned)[0])}")


def _fingerprint(path: Path) -> dict[str, Any]:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return {"bytes": path.stat().st_size, "sha256": digest.hexdigest()}
