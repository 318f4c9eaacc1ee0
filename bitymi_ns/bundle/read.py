"""Reading of bundles: headers and sizes are checked first, and each file is read once."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bitymi_ns import ply
from bitymi_ns.codec.bc7_encode import Profile, bc7_blocks
from bitymi_ns.codec.limits import ALPHA_LIMIT, RESIDUAL_LIMIT
from bitymi_ns.codec.quantise import Range, byte_pages, decode_pages
from bitymi_ns.codec.streams import StreamError
from bitymi_ns.codec.texel_codes import constants, mean_alphas_of
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.scene.baked import BakedOutput, BakedScene
from bitymi_ns.scene.camera import Camera
from . import compact, ktx2
from .cameras import CapturedCamera, parse_cameras
from .manifest import (
    ATLAS,
    COMPACT_SURFELS,
    MANIFEST,
    SURFELS,
    TEXELS,
    AtlasEntry,
    BundleError,
    Manifest,
    parse,
    points_of,
)
from .notes import NotesError, crop_of
from .parts import CAMERAS, MANIFEST_LIMIT, NOTES, MissingPart, Parts, instead_of, parts_of
from .sizes import HEAD, SCENE_FILES, check_head, check_memory, enough_memory
from .surfel_table import TERMS, from_columns

REMEDY = "Copy the bundle again from where it is whole, or export the scene again with ns-export bitymi-atlas."
"""Advice on a damaged bundle."""
BESIDE_LIMIT = 64 << 20
"""Largest file other than surfels and texels that is kept in memory, bytes."""
LARGE_ATLAS = 64 << 20
"""Least size in bytes of a decoded compact atlas that is encoded to BC7 for a CUDA device, a quarter of the memory.
Smaller ones fit any device, and encoding costs time and some quality."""
LOAD_PROFILE: Profile = "veryfast"  # for `LARGE_ATLAS`; the next faster profile loses more than twice as many dB
CONTENTS = SCENE_FILES | {CAMERAS}  # files used by `assemble`
_CHUNK = 1 << 22


@dataclass
class Bundle:
    """A loaded bundle: scene on the CPU, with whole or reduced view colours, bundle.json, and the cameras of the
    capture, training and held out; empty without cameras.json."""

    scene: BakedScene
    info: Manifest
    cameras: Sequence[CapturedCamera] = ()

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def hidden(self) -> str:
        """Statement of the surfels that a crop left out; empty if none."""
        count = self.info.surfels.count
        return f"{count - len(self):,} of {count:,} surfels are hidden by {NOTES}" if len(self) < count else ""

    def to(self, device: torch.device | str) -> Bundle:
        return replace(self, scene=self.scene.to(device))

    def render(self, camera: Camera, background: Tensor | None = None, maps: bool = False) -> BakedOutput:
        """Render a view as `BakedScene.render`; `background`: None: the bundle's own."""
        if background is None:
            background = torch.tensor(self.info.render.background, device=self.scene.tiles.device, dtype=torch.float32)
        return self.scene.render(camera, background, maps)


def read_bundle(folder: str | Path, verify: bool = True, decode: bool = True, crop: bool = False) -> Bundle:
    """Load a bundle.

    Args:
        folder: the bundle's folder, or its single file.
        verify: compare every file with its SHA-256 (sizes are always compared).
        decode: decode a BC7 atlas to four bytes per texel, which a CUDA device does not need. False also encodes
            compact atlases of at least `LARGE_ATLAS` to BC7.
        crop: leave out the surfels that notes.json hides.

    Raises BundleError: a file of the scene is missing, truncated, altered or malformed, a value is out of range, the
    version is too new, or memory is insufficient; other such files are left out, with a warning. Raises NotesError:
    `crop`, and notes.json is refused or hides no surfels, or all."""
    with parts_of(folder) as parts:
        info = manifest_of(parts)
        with enough_memory(parts.bundle, info):
            files = {}
            for name in info.files:
                try:
                    files[name] = read_file(parts, info, name, verify, name in CONTENTS)
                except BundleError as error:
                    if name in CONTENTS:
                        raise
                    warnings.warn(f"{error}. It is left out: the scene does not need it.", stacklevel=2)
            bundle = assemble(parts.bundle, info, files, decode)
        return _cropped(bundle, parts) if crop else bundle


def _cropped(bundle: Bundle, parts: Parts) -> Bundle:
    crop, path = crop_of(parts), parts.bundle / NOTES
    if crop is None:
        raise NotesError(f"{path} hides no surfels: save a crop there with `bitymi view`, or do not ask for it")
    kept = crop.keeps(bundle.scene.surfels["means"])
    if not kept.any():
        raise NotesError(f"{path} hides all surfels: correct its crop with `bitymi view`, or do not ask for it")
    return replace(bundle, scene=bundle.scene.only(kept))


def read_manifest(folder: str | Path) -> Manifest:
    """Read bundle.json of a folder or single file. Raises BundleError: missing, or as `manifest.parse`."""
    with parts_of(folder) as parts:
        return manifest_of(parts)


def read_cameras(folder: str | Path) -> list[CapturedCamera]:
    """Read only cameras.json of a bundle; empty without one. Raises as `read_bundle`."""
    with parts_of(folder) as parts:
        info = manifest_of(parts)
        return parse_cameras(read_file(parts, info, CAMERAS), parts.bundle / CAMERAS) if CAMERAS in info.files else []


def manifest_of(parts: Parts) -> Manifest:
    try:
        data = parts.read(MANIFEST, MANIFEST_LIMIT)
    except MissingPart as error:
        why = instead_of(parts.bundle) or f"it has no {MANIFEST}"
        raise BundleError(f"{parts.bundle} is not a bundle: {why}") from error
    return parse(data, str(parts.bundle / MANIFEST))


def download_bytes(folder: Path, info: Manifest) -> int:
    """Count the bytes to download: bundle.json and the files it lists, or the single file."""
    if folder.is_file():
        return folder.stat().st_size
    return (folder / MANIFEST).stat().st_size + sum(entry.bytes for entry in info.files.values())


def read_file(parts: Parts, info: Manifest, name: str, verify: bool = True, keep: bool = True) -> bytearray:
    """Read a file listed in bundle.json. `verify`: compare it with its SHA-256. `keep`: False: only check it. Raises
    BundleError: the file is missing, its size or hash differs, its header contradicts its size or bundle.json, or its
    contents exceed this machine's memory; all but the hash is checked before reading."""
    path, entry = parts.bundle / name, info.files[name]
    with parts.opened(name) as (file, size):
        if size != entry.bytes:
            problem = "truncated" if size < entry.bytes else "altered"
            raise BundleError(f"{path} is {problem}: it has {size} bytes, {entry.bytes} were written")
        if keep and name not in SCENE_FILES and size > BESIDE_LIMIT:
            raise BundleError(f"{path} has {size} bytes, at most {BESIDE_LIMIT} are read of such a file")
        head = file.read(min(size, HEAD))
        try:
            check_head(info, name, head, size)
        except (ply.PlyError, ktx2.Ktx2Error, StreamError) as error:
            raise BundleError(f"{path}: {error}") from error
        if keep and name in SCENE_FILES:
            check_memory(parts.bundle, info, name)
        sha256 = hashlib.sha256()
        data = _read_whole(file, head, size, keep, path, sha256.update if verify else len)
    if verify and sha256.hexdigest() != entry.sha256:
        raise BundleError(f"{path} is altered: its sha256 is not the one in {MANIFEST}")
    return data


def _read_whole(
    file: BufferedReader, head: bytes, size: int, keep: bool, path: Path, take: Callable[[Any], object]
) -> bytearray:
    """Read a file of `size` bytes, of which `head` is read already; `take` gets all of them."""
    data, at = bytearray(size if keep else min(size, max(_CHUNK, len(head)))), len(head)
    view = memoryview(data)
    view[:at] = head
    take(head)
    while at < size:
        window = view[at : at + _CHUNK] if keep else view[: min(_CHUNK, size - at)]
        count = file.readinto(window)
        if not count:
            raise BundleError(f"{path} is truncated: it ended after {at} bytes while it was read")
        take(window[:count])
        at += count
    return data if keep else bytearray()


def assemble(folder: Path, info: Manifest, files: dict[str, bytearray], decode: bool = True) -> Bundle:
    """Assemble a bundle from files by name. Raises BundleError: malformed, or a value is out of range."""
    render, atlas, points = info.render, info.atlas, info.render.photographed
    contents = _compact_contents if info.surfels.file == COMPACT_SURFELS else _ply_contents
    scene = BakedScene(
        view_color=info.surfels.view_color,
        near=render.near,
        weight_bound=render.weight_bound,
        photographed=None if points is None else points_of(points),
        **contents(folder, info, files, decode),
    )
    if atlas is not None:
        scene.offset = atlas.offset
        scene.scale = atlas.scale
        scene.alpha_scale = atlas.alpha_scale or 0.0
    cameras = parse_cameras(files[CAMERAS], folder / CAMERAS) if CAMERAS in files else []
    return Bundle(scene, info, cameras)


def _ply_contents(folder: Path, info: Manifest, files: Mapping[str, bytearray], decode: bool) -> dict[str, Any]:
    """Decode surfels.ply and atlas.ktx2 to fields of `BakedScene`."""
    path, atlas = folder / SURFELS, info.atlas
    try:
        elements = ply.parse_ply(files[SURFELS])
        extent = SUPPORT if atlas is None else atlas.extent
        kind, terms = info.surfels.view_color, elements.get(TERMS)
        fields = from_columns(elements["vertex"], kind, terms, extent, info.has_alpha)
    except ply.PlyError as error:
        raise BundleError(f"{path}: {error}") from error
    _check_tiles(fields["tiles"], atlas, path)
    if atlas is None:
        return fields
    try:
        image = ktx2.parse_ktx2(files[ATLAS])
    except ktx2.Ktx2Error as error:
        raise BundleError(f"{folder / ATLAS}: {error}") from error
    texels, blocks = _texels(image, decode, info.has_alpha, folder / ATLAS)
    return {**fields, "atlas": texels, "blocks": blocks}


def _compact_contents(folder: Path, info: Manifest, files: Mapping[str, bytearray], decode: bool) -> dict[str, Any]:
    """Decode surfels.bin and texels.bin to fields of `BakedScene`."""
    atlas, where = info.atlas, folder / COMPACT_SURFELS
    try:
        data = memoryview(files[COMPACT_SURFELS])
        codes, residual, step, alpha = compact.decode_surfels(info.surfels, data, info.has_alpha)
        sizes = torch.from_numpy(codes.sizes)
        tiles, texels, blocks = torch.zeros(len(codes), 5, dtype=torch.int32), None, None
        if atlas is not None:
            packing = compact.packing_of(atlas, sizes)
            tiles, where = torch.from_numpy(packing.tiles), folder / TEXELS
            coded = compact.decode_texels(atlas, sizes, residual, step, memoryview(files[TEXELS]), alpha)
            texels = byte_pages(coded.decoded(), packing, Range(atlas.offset, atlas.scale, ""))
            if not decode and texels.numel() >= LARGE_ATLAS:
                blocks = _encode_blocks(texels, info.has_alpha)
                texels = texels if blocks is None else None
        elif bool((sizes > 0).any()):
            raise StreamError("a surfel has a tile, and there is no atlas")
    except StreamError as error:
        raise BundleError(f"{where}: {error}") from error
    return {
        "surfels": codes.surfels(),
        "tiles": tiles,
        "atlas": texels,
        "blocks": blocks,
        "extent": codes.extent(SUPPORT),
        "mean_residual": constants(residual, step),
        "mean_alpha": None if alpha is None else mean_alphas_of(alpha),
    }


def _encode_blocks(texels: Tensor, alpha: bool) -> Tensor | None:
    """Encode decoded texels to BC7 blocks; None, with a warning, without the encoder."""
    try:
        return torch.from_numpy(bc7_blocks(texels.numpy(), LOAD_PROFILE, alpha))
    except RuntimeError as error:
        if not isinstance(error.__cause__, ImportError):
            raise
        size = f"{texels.numel() / 1e6:.0f} MB on the GPU where BC7 takes a quarter"
        remedy = "the encoder is not installed (pip install ispc_texcomp)"
        warnings.warn(f"the texels stay decoded, {size}: {remedy}", stacklevel=2)
        return None


def _check_tiles(tiles: Tensor, atlas: AtlasEntry | None, source: Path) -> None:
    layers, height, width = (1, 0, 0) if atlas is None else (atlas.layers, atlas.height, atlas.width)
    x, y, layer, r_u, r_v = tiles.long().unbind(1)
    good = (tiles >= 0).all(1) & (x + r_u <= width) & (y + r_v <= height) & (layer < layers)
    good &= (r_u > 0) == (r_v > 0)
    if not good.all():
        raise BundleError(f"{source}: the tile of surfel {int(torch.nonzero(~good)[0])} lies outside the atlas")


def _texels(image: ktx2.Ktx2Image, decode: bool, has_alpha: bool, source: Path) -> tuple[Tensor | None, Tensor | None]:
    """Return the texels and, for bc7, the blocks."""
    blocks = None
    if image.format == "bc7":
        pages = [np.frombuffer(page, np.uint8) for page in image.payload]
        blocks = torch.from_numpy(np.stack(pages).reshape(len(pages), image.height // 4, image.width // 4, 16))
        if not decode:
            return None, blocks
    texels = decode_pages(image.payload, image.format, image.width, image.height)
    if image.format != "fp16":
        return torch.from_numpy(texels), blocks
    _check_floats(texels[..., :3] if has_alpha else texels, -RESIDUAL_LIMIT, RESIDUAL_LIMIT, source, "texel")
    if has_alpha:
        _check_floats(texels[..., 3:], 0.0, ALPHA_LIMIT, source, "alpha of the texel")
    return torch.from_numpy(texels.astype(np.float32)), None


def _check_floats(values: np.ndarray, low: float, high: float, source: Path, what: str) -> None:
    bad = ~((values >= low) & (values <= high))
    if bad.any():
        layer, y, x, _ = (int(i) for i in np.argwhere(bad)[0])
        raise BundleError(f"{source}: the {what} ({x}, {y}) of layer {layer} is not from {low:g} to {high:g}")
