"""A bundle: the folder that the renderers read. surfels.ply, atlas.ktx2, bundle.json; no pickle anywhere."""

from __future__ import annotations

import errno
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns import __version__
from bitymi_ns.bake import ktx2, ply
from bitymi_ns.bake.folder import check_target, complete_folder
from bitymi_ns.bake.manifest import (
    ATLAS,
    FORMAT,
    FULL_VERSION,
    MANIFEST,
    SURFELS,
    VERSION,
    BundleError,
    check_file_name,
    dump,
    parse,
)
from bitymi_ns.bake.quantise import EncodedAtlas, decode_pages
from bitymi_ns.bake.surfel_table import (
    EXTENT_COLUMN,
    TERMS,
    from_columns,
    mean_residuals,
    term_columns,
    tile_extents,
    to_columns,
    view_color_kind,
)
from bitymi_ns.ops.constants import ALPHA_MAX, ALPHA_MIN, COLOR_BIAS, SUPPORT, TRANSMITTANCE_MIN
from bitymi_ns.ops.view_color import check_lean

__all__ = ["Bundle", "BundleError", "World", "check_target", "read_bundle", "verify_bundle", "write_bundle"]

GENERATOR = f"bitymi-ns {__version__}"
_MANIFEST_LIMIT = 64 << 20
_CHUNK = 1 << 22
_LEAN_FORMULAS = {
    "sv": "(view_base + sum exp(b . d) rgb) / (1 + sum exp(b . d)); a term is b, rgb; d from the camera to the surfel",
    "sh": "view_base is the coefficient of degree 0, terms are those that follow",
    "sb": "view_base is the base colour, a term is a lobe",
    "sg": "view_base is the base colour, a term is a lobe",
}


@dataclass(frozen=True)
class World:
    """How the scene's frame lies in the capture's own: x_scene = scale * (transform @ [x_capture, 1]).

    Attributes:
        transform: [3, 4] (the dataparser's transform).
        scale: the dataparser's scale.
    """

    transform: npt.ArrayLike = field(default_factory=lambda: np.eye(4)[:3])
    scale: float = 1.0


@dataclass
class Bundle:
    """A loaded bundle.

    Attributes:
        surfels: per-surfel parameters as in docs/architecture.md, float32 on the CPU; the view colour may be lean
            (`ops.view_color.LEAN`).
        view_color: sv, sh, sb or sg.
        tiles: [N, 5] int32 (x, y, layer, r_u, r_v), zeros for a surfel without a tile.
        atlas: [layers, height, width, 4] uint8 (bc7, uint8) or float32 (fp16); None when the scene has no texture, or
            its blocks were not decoded.
        blocks: [layers, height / 4, width / 4, 16] uint8, the atlas as it is in the file; None unless it is BC7.
        offset, scale: residual colour = offset + scale * value, value = stored / 255 for uint8, stored for float32.
        extent: [N] float32 half side of the tile in scale units.
        mean_residual: [N, 3] float32 mean of the tile; the residual of a surfel without a tile.
        info: bundle.json.
    """

    surfels: dict[str, Tensor]
    view_color: str
    tiles: Tensor
    atlas: Tensor | None
    blocks: Tensor | None
    offset: float
    scale: float
    extent: Tensor
    mean_residual: Tensor
    info: dict[str, Any]

    def __len__(self) -> int:
        return len(self.tiles)

    def residuals(self) -> Tensor:
        """Residual colours of the atlas: [layers, height, width, 3] float32."""
        if self.atlas is None:
            raise BundleError("the bundle has no atlas" if self.blocks is None else "the atlas was not decoded")
        rgb = self.atlas[..., :3].float()
        unorm = rgb / 255.0 if self.atlas.dtype == torch.uint8 else rgb
        return unorm * self.scale + self.offset


def write_bundle(
    folder: str | Path,
    surfels: Mapping[str, Tensor],
    tiles: npt.NDArray[np.int32],
    atlas: EncodedAtlas | None,
    *,
    extent: Tensor | None = None,
    mean_residual: Tensor | None = None,
    near: float = 0.2,
    weight_bound: float = 0.0,
    prefilter: str = "low_pass",
    view_color: str | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    world: World | None = None,
    statistics: Mapping[str, Any] | None = None,
    extra_files: Mapping[str, bytes] | None = None,
    loose_files: Mapping[str, bytes] | None = None,
    overwrite: bool = False,
) -> Path:
    """Writes a bundle; the folder appears complete or not at all.

    Args:
        folder: the bundle's folder.
        surfels: per-surfel parameters, N rows each, all finite; the view colour all or lean.
        tiles: [N, 5] int32.
        atlas: the encoded atlas, None for a scene without texture.
        extent: [N] half side of each tile in scale units, None = 3, the kernel's support.
        mean_residual: [N, 3] mean of each tile; the residual of the surfels without a tile, and part of the colour that
            other viewers show. None = 0.
        near: nearest drawn depth.
        weight_bound: fragments of smaller blending weight get no residual.
        prefilter: low_pass or pixel (`SceneConfig.prefilter`).
        view_color: sv, sh, sb or sg; lean colours need it, None = the kind whose parameters are there.
        background: colour behind the surfels.
        world: place in the capture's own frame.
        statistics: anything worth knowing about the bake, for people and reports.
        extra_files: further files by name, such as preview.png.
        loose_files: files that bundle.json does not vouch for, because they may be edited later.
        overwrite: replace an existing bundle.

    Returns:
        the folder.

    Raises:
        BundleError: the target exists, the disk is full, the parameters are not finite.
    """
    folder = Path(folder)
    kind = view_color or view_color_kind(surfels)
    _check_surfels(surfels, tiles, kind)
    for name in (*(extra_files or {}), *(loose_files or {})):
        check_file_name(name, "extra_files")
        if name in (SURFELS, ATLAS):
            raise BundleError(f"extra_files may not replace {name}")
    info = _describe(surfels, kind, atlas, near, weight_bound, prefilter, background, world or World(), statistics)
    try:
        with complete_folder(folder, overwrite) as new:
            columns = to_columns(surfels, tiles, mean_residual, extent, kind)
            terms = {TERMS: term_columns(surfels)} if "view_terms" in surfels else None
            ply.write_ply(new / SURFELS, columns, [GENERATOR, "2D Beta surfels; see bundle.json"], terms)
            if atlas is not None:
                ktx2.write_ktx2(new / ATLAS, atlas.payload, atlas.format, atlas.width, atlas.height, GENERATOR)
            for name, data in (extra_files or {}).items():
                (new / name).write_bytes(data)
            info["files"] = {path.name: _fingerprint(path) for path in sorted(new.iterdir())}
            (new / MANIFEST).write_bytes(dump(info))
            for name, data in (loose_files or {}).items():
                (new / name).write_bytes(data)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            size = sum(value.numel() * 4 for value in surfels.values()) + (atlas.nbytes if atlas else 0)
            raise BundleError(
                f"the disk is full: {folder} needs about {size / 1e6:.0f} MB; nothing was left behind"
            ) from error
        raise BundleError(f"{folder} cannot be written: {error}; nothing was left behind") from error
    return folder


def read_bundle(folder: str | Path, verify: bool = True, decode: bool = True) -> Bundle:
    """Loads a bundle.

    Args:
        folder: the bundle's folder.
        verify: compare every file with its sha256 (sizes are always compared).
        decode: also decode a BC7 atlas, four bytes a texel; a CUDA device draws from the blocks alone.

    Raises:
        BundleError: a file is missing, truncated, altered or malformed, or the version is too new.
    """
    folder = Path(folder)
    info = read_manifest(folder)
    for name, entry in info["files"].items():
        if name not in (SURFELS, ATLAS):
            _checked(folder / name, entry, verify, keep=False)
    try:
        elements = ply.parse_ply(_checked(folder / SURFELS, info["files"][SURFELS], verify))
        columns, terms = elements["vertex"], elements.get(TERMS)
        stated = info["surfels"].get("terms")
        if stated != (None if terms is None else len(next(iter(terms.values())))):
            raise BundleError(f"{folder / SURFELS}: {MANIFEST} states another number of view-colour terms: {stated}")
        surfels, tiles = from_columns(columns, info["surfels"]["view_color"], terms)
        extent = tile_extents(columns, float(info["atlas"]["extent"]) if info["atlas"] else SUPPORT)
        mean_residual = mean_residuals(columns)
    except ply.PlyError as error:
        raise BundleError(f"{folder / SURFELS}: {error}") from error
    if len(tiles) != info["surfels"]["count"]:
        raise BundleError(f"{folder / SURFELS}: {len(tiles)} surfels, but {MANIFEST} says {info['surfels']['count']}")
    pages = info["atlas"] and tuple(info["atlas"][name] for name in ("layers", "height", "width"))
    _check_tiles(tiles, pages, folder / SURFELS)
    atlas, blocks = _read_atlas(folder, info, verify, decode)
    offset, scale = (info["atlas"]["offset"], info["atlas"]["scale"]) if info["atlas"] else (0.0, 1.0)
    kind = info["surfels"]["view_color"]
    return Bundle(surfels, kind, tiles, atlas, blocks, float(offset), float(scale), extent, mean_residual, info)


def verify_bundle(folder: str | Path) -> dict[str, Any]:
    """Checks everything `read_bundle` checks, hashes included, and returns bundle.json."""
    return read_bundle(folder, verify=True).info


def _describe(
    surfels: Mapping[str, Tensor],
    kind: str,
    atlas: EncodedAtlas | None,
    near: float,
    weight_bound: float,
    prefilter: str,
    background: Sequence[float],
    world: World,
    statistics: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """bundle.json without its list of files."""
    means, lean = surfels["means"].detach(), "view_terms" in surfels
    version = VERSION if lean else FULL_VERSION
    empty = len(means) == 0
    described: dict[str, Any] = {
        "format": FORMAT,
        "version": f"{version[0]}.{version[1]}",
        "generator": GENERATOR,
        "surfels": {
            "file": SURFELS,
            "count": len(means),
            "view_color": kind,
            "kernel": "min(alpha_max, opacity * max((1 - (u^2 + v^2) / support^2)+ ^ beta, exp(-low_pass * d^2)))",
            "support": SUPPORT,
            "residual": "of a surfel without a tile: residual_0..2, at weights of at least render.weight_bound",
            "activations": {"opacity": "sigmoid", "scale": "exp", "beta": "4 * sigmoid", "rotation": "wxyz, unit"},
        },
        "atlas": None,
        "color_bias": COLOR_BIAS,
        "render": {
            "alpha_max": ALPHA_MAX,
            "alpha_min": ALPHA_MIN,
            "t_min": TRANSMITTANCE_MIN,
            "near": near,
            "weight_bound": weight_bound,
            "low_pass": 1.0,
            "prefilter": prefilter,
            "background": list(background),
        },
        "world": {"transform": np.asarray(world.transform, dtype=np.float64)[:3], "scale": float(world.scale)},
        "bounds": {
            "min": [0.0] * 3 if empty else means.amin(0),
            "max": [0.0] * 3 if empty else means.amax(0),
        },
        "statistics": dict(statistics or {}),
    }
    if lean:
        described["surfels"]["terms"] = len(surfels["view_terms"])
        described["surfels"]["view_terms"] = _LEAN_FORMULAS[kind]
    elif kind == "sv":
        described["surfels"]["sites"] = surfels["sv_log_tau"].shape[1]
        described["surfels"]["activations"] |= {"sv_sites": "unit", "sv_log_tau": "exp"}
    if atlas is not None:
        described["atlas"] = {
            "file": ATLAS,
            "format": atlas.format,
            "width": atlas.width,
            "height": atlas.height,
            "layers": len(atlas.payload),
            "extent": SUPPORT,
            "extent_column": EXTENT_COLUMN,
            "offset": atlas.range.offset,
            "scale": atlas.range.scale,
            "range": atlas.range.rule,
            "clipped_fraction": atlas.clipped_fraction,
            "encoder": atlas.encoder,
            "psnr": atlas.psnr,
        }
    return described


def _check_surfels(surfels: Mapping[str, Tensor], tiles: npt.NDArray[np.int32], kind: str) -> None:
    if "view_terms" in surfels:
        try:
            check_lean(kind, surfels, len(tiles))
        except ValueError as error:
            raise BundleError(str(error)) from error
    for name, value in surfels.items():
        if name != "view_terms" and len(value) != len(tiles):
            raise BundleError(f"{name} has {len(value)} rows, the tiles have {len(tiles)}")
        finite = torch.isfinite(value).flatten(1).all(1) if value.dim() > 1 else torch.isfinite(value)
        if not finite.all():
            raise BundleError(f"{name} is not finite in row {int(torch.nonzero(~finite)[0])}")


def _check_tiles(tiles: Tensor, pages: tuple[int, ...] | None, source: Path) -> None:
    """Refuses tiles that reach out of the atlas."""
    layers, height, width = pages or (1, 0, 0)
    x, y, layer, r_u, r_v = tiles.long().unbind(1)
    good = (tiles >= 0).all(1) & (x + r_u <= width) & (y + r_v <= height) & (layer < layers)
    good &= (r_u > 0) == (r_v > 0)
    if not good.all():
        raise BundleError(f"{source}: the tile of surfel {int(torch.nonzero(~good)[0])} lies outside the atlas")


def read_manifest(folder: Path) -> dict[str, Any]:
    """bundle.json of a bundle, checked as far as it can be without the other files."""
    path = folder / MANIFEST
    if not path.is_file():
        raise BundleError(f"{folder} is not a bundle: it has no {MANIFEST}")
    try:
        if path.stat().st_size > _MANIFEST_LIMIT:
            raise BundleError(f"{path} is too large for a bundle.json")
        return parse(path.read_bytes(), str(path))
    except OSError as error:
        raise BundleError(f"{path} cannot be read: {error}") from error


def _read_atlas(folder: Path, info: dict[str, Any], verify: bool, decode: bool) -> tuple[Tensor | None, Tensor | None]:
    """The texels, and the BC7 blocks where the atlas has such."""
    stated = info["atlas"]
    if stated is None:
        return None, None
    path = folder / ATLAS
    try:
        image = ktx2.parse_ktx2(_checked(path, info["files"][ATLAS], verify))
    except ktx2.Ktx2Error as error:
        raise BundleError(f"{path}: {error}") from error
    found = (image.format, image.width, image.height, len(image.payload))
    if found != (stated["format"], stated["width"], stated["height"], stated["layers"]):
        raise BundleError(f"{path}: format and size {found} are not those of {MANIFEST}")
    blocks = None
    if image.format == "bc7":
        pages = [np.frombuffer(page, np.uint8) for page in image.payload]
        blocks = torch.from_numpy(np.stack(pages).reshape(len(pages), image.height // 4, image.width // 4, 16))
        if not decode:
            return None, blocks
    texels = torch.from_numpy(decode_pages(image.payload, image.format, image.width, image.height))
    if image.format != "fp16":
        return texels, blocks
    if not torch.isfinite(texels).all():
        raise BundleError(f"{path}: a texel is not finite")
    return texels.float(), None


def _fingerprint(path: Path) -> dict[str, Any]:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return {"bytes": path.stat().st_size, "sha256": digest.hexdigest()}


def file_problem(path: Path, entry: dict[str, Any]) -> str | None:
    """What is wrong with a file's size or hash; None when both are as bundle.json states."""
    try:
        _checked(path, entry, verify=True, keep=False)
    except BundleError as error:
        return str(error)
    return None


def _checked(path: Path, entry: dict[str, Any], verify: bool, keep: bool = True) -> bytes:
    """The file's bytes (none with keep=False), after comparing its size and hash with what bundle.json says."""
    if not path.is_file():
        raise BundleError(f"{path} is missing")
    try:
        size = path.stat().st_size
        if size != entry["bytes"]:
            problem = "truncated" if size < entry["bytes"] else "altered"
            raise BundleError(f"{path} is {problem}: it has {size} bytes, {entry['bytes']} were written")
        data = path.read_bytes() if keep or verify else b""
    except OSError as error:
        raise BundleError(f"{path} cannot be read: {error}") from error
    if verify and hashlib.sha256(data).hexdigest() != entry["sha256"]:
        raise BundleError(f"{path} is altered: its sha256 is not the one in {MANIFEST}")
    return data
