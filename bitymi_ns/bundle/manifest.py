"""bundle.json: its schema, for writing and reading, and the digest that protects it."""

from __future__ import annotations

import base64
import binascii
import json
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import AfterValidator, Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError
from torch import Tensor

from bitymi_ns.codec.limits import ALPHA_SCALE, EXTENTS, LIMITS, RESIDUAL_LIMIT
from bitymi_ns.ops.constants import ALPHA_MAX, ALPHA_MIN, COLOR_BIAS, SUPPORT, TRANSMITTANCE_MIN
from bitymi_ns.ops.view_kinds import Kind
from bitymi_ns.ranges import describe_problems, short
from . import strict_json
from .statistics import Decibels, Part, Share, Statistics, Whole
from .world import Coordinate, WorldEntry

FORMAT = "bitymi-bundle"
SURFELS, ATLAS, MANIFEST = "surfels.ply", "atlas.ktx2", "bundle.json"
COMPACT_SURFELS, TEXELS = "surfels.bin", "texels.bin"
VERSION = "6.0"
EARLIER = {"1.4": (SURFELS,), "2.3": (SURFELS,), "4.0": (SURFELS,), "5.0": (COMPACT_SURFELS,)}
"""Versions that are read as `VERSION`, and their files of surfels: whole view colours, reduced ones, alphas of texels,
entropy-coded columns."""
POSTER = "poster.webp"  # optional picture of a viewer's first view: `bundle.poster`
ACTIVATIONS = {"opacity": "sigmoid", "scale": "exp", "beta": "4 * sigmoid", "rotation": "wxyz, unit"}
_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


class BundleError(ValueError):
    """A bundle that cannot be written or read; the message says why and what to do."""


def check_file_name(name: str, source: str) -> None:
    """Raise BundleError of `source` unless a name is a plain file name: no bundle reaches out of its folder."""
    if not _is_file_name(name):
        raise BundleError(f"{source}: {short(name)} cannot be the name of a file of the bundle")


def _is_file_name(name: str) -> bool:
    return _FILE_NAME.fullmatch(name) is not None and name != MANIFEST


def _only(value: float) -> AfterValidator:
    """Build the check of a renderer's constant, which is stated for other programs."""

    def check(stated: float) -> float:
        if stated != value:
            raise PydanticCustomError("constant", "must be {value}, which is what is drawn with", {"value": value})
        return stated

    return AfterValidator(check)


def points_text(points: Tensor) -> str:
    """Encode points [P, 4] as base64 of little-endian float32 rows x, y, z, rate (pixels per unit of length)."""
    return base64.b64encode(points.detach().float().cpu().numpy().astype("<f4").tobytes()).decode()


def points_of(text: str) -> Tensor:
    """Decode the points [P, 4] float32 of `points_text`. Raises PydanticCustomError: malformed, or out of range."""
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise PydanticCustomError("points", "must be base64 of float32 numbers") from error
    if len(data) % 16 or len(data) > 16 * _MOST_POINTS:
        told = "must hold rows of four float32 numbers, at most {most}"
        raise PydanticCustomError("points", told, {"most": _MOST_POINTS})
    points = torch.from_numpy(np.frombuffer(bytearray(data), "<f4").reshape(-1, 4))
    low, high = _RATES
    good = (points[:, :3].abs() <= LIMITS["means"][0]).all() and ((points[:, 3] >= low) & (points[:, 3] <= high)).all()
    if not bool(good):  # also for NaN
        raise PydanticCustomError("points", "must hold positions and rates in range")
    return points


def _points(text: str) -> str:
    points_of(text)
    return text


_MOST_POINTS = 4096
_RATES = (1e-12, 1e12)  # pixels per unit of length

Side = Annotated[int, Field(ge=1, le=1 << 20)]
Bent = Annotated[float, Field(ge=-100, le=100)]
Point = tuple[Coordinate, Coordinate, Coordinate]


class ColumnEntry(Part):
    """Integer column: `bytes` are the `sizes` of `streams.Compressed`."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_]{1,20}$")]
    step: Annotated[float, Field(ge=1e-12, le=1e6)] | None = None
    bytes: Annotated[list[Annotated[int, Field(ge=0, le=1 << 40)]], Field(max_length=16)]


class PositionFrame(Part):
    """Grid of positions, `codec.surfel_codes.PositionGrid`."""

    center: Point
    scale: Annotated[float, Field(gt=0, le=LIMITS["means"][0])]
    low: tuple[Bent, Bent, Bent]


class Surfels(Part):
    """Contents and interpretation of surfels.ply or surfels.bin."""

    file: Literal["surfels.ply", "surfels.bin"] = SURFELS
    count: Whole
    frame: PositionFrame | None = None
    columns: Annotated[list[ColumnEntry], Field(max_length=64)] | None = None  # of surfels.bin, in order
    view_color: Kind
    kernel: str = "min(alpha_max, opacity * max((1 - (u^2 + v^2) / support^2)+ ^ beta, exp(-low_pass * d^2)))"
    support: Annotated[float, _only(SUPPORT)] = SUPPORT
    residual: str = "of a surfel without a tile: residual_0..2, at weights of at least render.weight_bound"
    activations: dict[str, str] = ACTIVATIONS
    sites: Whole | None = None  # Spherical Voronoi sites per surfel, if all are kept
    terms: Whole | None = None  # terms of all reduced view colours; None: view colours are complete
    view_terms: str | None = None  # formula of a reduced view colour


class AtlasEntry(Part):
    """Contents of atlas.ktx2, residual = offset + scale * value with value = stored / 255 for bc7 and uint8; or of
    texels.bin (format dct), whose texels are rounded to 8 bits of that range."""

    file: Literal["atlas.ktx2", "texels.bin"] = ATLAS
    format: Literal["bc7", "uint8", "fp16", "dct"]
    texels: Whole | None = None  # texels of all tiles in texels.bin
    step: Annotated[float, Field(ge=1e-6, le=100)] | None = None  # of coefficients at grade 0 (`texel_codes.GRADES`)
    page_width: Side | None = None
    page_rows: Side | None = None
    """Arguments of `codec.packing.pack`, which lays out the tiles."""
    columns: Annotated[list[ColumnEntry], Field(max_length=64)] | None = None  # of texels.bin, in order
    width: Side
    height: Side
    layers: Side
    extent: Annotated[float, Field(ge=EXTENTS[0], le=EXTENTS[1])] = SUPPORT
    """Half side of the tiles if surfels.ply has no column of extents."""
    extent_column: str | None = None
    offset: Annotated[float, Field(ge=-RESIDUAL_LIMIT, le=RESIDUAL_LIMIT)]
    scale: Annotated[float, Field(gt=0, le=2 * RESIDUAL_LIMIT)]
    range: str | None = None
    alpha_scale: Annotated[float, Field(gt=0, le=2)] | None = None
    """Scale of the fourth channel: alpha = alpha_scale * value multiplies the surfel's opacity. None: opaque texels."""
    clipped_fraction: Share | None = None
    encoder: str | None = None
    psnr: Decibels = None

    @model_validator(mode="after")
    def _fits_its_format(self) -> AtlasEntry:
        format, coded = self.format, self.format == "dct"
        if format == "fp16" and (self.offset, self.scale) != (0.0, 1.0):
            raise PydanticCustomError("range", "must have offset 0 and scale 1, as its format is fp16")
        scale = 1.0 if format == "fp16" else ALPHA_SCALE
        if self.alpha_scale not in (None, scale):
            told = "must have alpha_scale {scale}, as its format is {format}"
            raise PydanticCustomError("alpha", told, {"scale": scale, "format": format})
        parts = (self.texels, self.step, self.page_width, self.page_rows, self.columns)
        if coded != (self.file == TEXELS) or (coded and None in parts):
            raise PydanticCustomError("file", "file, format, texels, step, pages and columns do not fit each other")
        return self


class RenderEntry(Part):
    """Constants of the renderers."""

    alpha_max: Annotated[float, _only(ALPHA_MAX)] = ALPHA_MAX
    alpha_min: Annotated[float, _only(ALPHA_MIN)] = ALPHA_MIN
    t_min: Annotated[float, _only(TRANSMITTANCE_MIN)] = TRANSMITTANCE_MIN
    near: Annotated[float, Field(ge=1e-9, le=1e6)]
    weight_bound: Share
    low_pass: Annotated[float, _only(1.0)] = 1.0
    prefilter: Literal["low_pass"] | None = None  # which earlier versions state
    photographed: Annotated[str, AfterValidator(_points)] | None = None
    """Points of the scene with the pixels per unit of length of their photographs (`points_text`)."""
    background: tuple[Share, Share, Share]


class Bounds(Part):
    """Axis-aligned bounding box of the surfels' means."""

    min: Point
    max: Point


class FileEntry(Part):
    bytes: Annotated[int, Field(ge=0, le=1 << 36)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Manifest(Part):
    """bundle.json."""

    format: Literal["bitymi-bundle"] = FORMAT
    version: Annotated[str, Field(pattern=r"^[0-9]{1,6}\.[0-9]{1,6}$")]
    generator: str = "an unnamed program"
    surfels: Surfels
    atlas: AtlasEntry | None
    color_bias: Annotated[float, _only(COLOR_BIAS)] = COLOR_BIAS
    render: RenderEntry
    world: WorldEntry
    bounds: Bounds
    statistics: Statistics
    files: Annotated[dict[str, FileEntry], Field(max_length=1 << 14)]
    decoded: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """SHA-256 of the integers of surfels.bin and texels.bin (`compact.decoded_hash`): 5.0 has none."""
    digest: str | None = None  # SHA-256 of the canonical JSON of everything else

    @model_validator(mode="after")
    def _files_fit(self) -> Manifest:
        for name in self.files:
            if not _is_file_name(name):
                raise PydanticCustomError("files", "files: {name} cannot be the name of a file", {"name": short(name)})
        if self.surfels.file not in self.files:
            raise PydanticCustomError("files", f"files must list {self.surfels.file}")
        atlas = None if self.atlas is None else self.atlas.file
        for name in (ATLAS, TEXELS):
            if (name in self.files) != (name == atlas):
                raise PydanticCustomError("files", f"files and atlas disagree whether there is an {name}")
        surfels, compact = self.surfels, self.surfels.file == COMPACT_SURFELS
        if compact and None in (surfels.frame, surfels.columns, surfels.terms):
            raise PydanticCustomError("file", "surfels.bin needs surfels.frame, columns and terms")
        if self.atlas is not None and compact != (self.atlas.file == TEXELS):
            raise PydanticCustomError("file", "atlas.file must be texels.bin beside surfels.bin, and atlas.ktx2 else")
        return self

    @property
    def has_alpha(self) -> bool:
        """True if texels multiply their surfels' opacities."""
        return self.atlas is not None and self.atlas.alpha_scale is not None


def describe(info: Mapping[str, Any]) -> Manifest:
    """Build the manifest of `info`; arrays become lists, non-finite numbers null. Raises BundleError: a value is
    missing or out of range."""
    try:
        return Manifest.model_validate_json(strict_json.canonical(strict_json.plain(info)))
    except ValidationError as error:
        raise BundleError(f"the bundle cannot be described: {describe_problems(error)}") from error


def dump(manifest: Manifest) -> bytes:
    """Serialise a manifest to bundle.json, with its digest. Raises BundleError: `parse` would refuse a value."""
    info = describe(manifest.model_dump(mode="json", exclude={"digest"})).model_dump(mode="json")
    info["digest"] = strict_json.digest(info)
    return (json.dumps(info, indent=2, ensure_ascii=False) + "\n").encode()


def parse(data: bytes, source: str = MANIFEST) -> Manifest:
    """Parse bundle.json and check everything that readers rely on; unknown keys are kept and ignored. Raises
    BundleError: not a bundle, too new, a value missing or out of range, or the digest of other contents."""
    try:
        info = strict_json.loads(data)
        if not isinstance(info, dict) or info.get("format") != FORMAT:
            raise BundleError(f"{source} is not a bundle: its format is not {FORMAT!r}")
        stated = info.pop("digest", None)
        _check_version(info, source)
        text = strict_json.canonical(info)
        digest = strict_json.digest(info)
    except BundleError:
        raise
    except ValueError as error:
        raise BundleError(f"{source} is not a bundle: it cannot be read as JSON ({error})") from error
    try:
        manifest = Manifest.model_validate_json(text)
    except ValidationError as error:
        raise BundleError(f"{source}: {describe_problems(error)}") from error
    if stated is None:
        raise BundleError(f"{source}: digest is missing{_ON_PURPOSE.format(digest)}")
    if stated != digest:
        raise BundleError(f"{source} is altered: its digest is not that of its contents{_ON_PURPOSE.format(digest)}")
    manifest.digest = stated
    return manifest


_ON_PURPOSE = '; if you have edited it on purpose, set "digest" to "{}"'


def _check_version(info: Mapping[str, Any], source: str) -> None:
    version, surfels = info.get("version"), info.get("surfels")
    match = re.fullmatch(r"([0-9]{1,6})\.[0-9]{1,6}", version) if isinstance(version, str) else None
    if match is None:
        raise BundleError(f"{source}: version must look like {VERSION}, not {short(version)}")
    newest, stated = VERSION.split(".")[0], f"{source} has version {version}"
    if int(match[1]) > int(newest):
        raise BundleError(f"{stated}, this program reads up to {newest}.x: update bitymi-ns to open it")
    file = surfels.get("file", SURFELS) if isinstance(surfels, dict) else None
    if match[1] != newest and file not in EARLIER.get(match[0], ()):
        raise BundleError(f"{stated} with {short(file)}, which is read no longer: export it again")
