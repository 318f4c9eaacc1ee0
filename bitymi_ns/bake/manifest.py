"""bundle.json: what a bundle states about itself, and its checks."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

FORMAT = "bitymi-bundle"
VERSION = (2, 0)
"""The newest version that is read. Lean view colours are version 2, which readers of version 1 refuse."""
FULL_VERSION = (1, 1)
"""Version of a bundle whose surfels have all parameters."""
SURFELS, ATLAS, MANIFEST = "surfels.ply", "atlas.ktx2", "bundle.json"
_NUMBER_LIMIT = 1e30
_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_DIGEST = re.compile(r"[0-9a-f]{64}")


class BundleError(ValueError):
    """A bundle cannot be written or read; the message says what is wrong and what to do."""


class Fields:
    """Typed access to a JSON object, by path: `fields.integer("surfels.count")`."""

    def __init__(self, info: Any, source: str) -> None:
        self.info, self.source = info, source

    def _fail(self, path: str, what: str) -> BundleError:
        return BundleError(f"{self.source}: {path} {what}")

    def get(self, path: str) -> Any:
        """The value at `path`."""
        value = self.info
        for key in path.split("."):
            if not isinstance(value, dict) or key not in value:
                raise self._fail(path, "is missing")
            value = value[key]
        return value

    def text(self, path: str, *choices: str) -> str:
        """A string, one of `choices` when any are given."""
        value = self.get(path)
        if not isinstance(value, str) or (choices and value not in choices):
            raise self._fail(path, f"must be {' or '.join(choices) if choices else 'text'}, not {_short(value)}")
        return value

    def integer(self, path: str, low: int = 0, high: int = 2**31 - 1) -> int:
        """A whole number in [low, high]."""
        value = self.get(path)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise self._fail(path, f"must be a whole number from {low} to {high}, not {_short(value)}")
        return value

    def number(self, path: str) -> float:
        """A finite number."""
        return self._number(path, self.get(path))

    def numbers(self, path: str, *shape: int) -> np.ndarray:
        """Nested lists of finite numbers of the given shape, as float64."""

        def nested(value: Any, sizes: tuple[int, ...]) -> list:
            if not isinstance(value, list) or len(value) != sizes[0]:
                raise self._fail(path, f"must be numbers of shape {list(shape)}")
            return [nested(each, sizes[1:]) if len(sizes) > 1 else self._number(path, each) for each in value]

        return np.array(nested(self.get(path), shape))

    def _number(self, path: str, value: Any) -> float:
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) <= _NUMBER_LIMIT:
            raise self._fail(path, f"must be a finite number, not {_short(value)}")
        return float(value)


def dump(info: Mapping[str, Any]) -> bytes:
    """bundle.json of `info`; values that JSON cannot hold (NaN, infinity) become null."""
    return (json.dumps(_plain(info), indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def parse(data: bytes, source: str = MANIFEST) -> dict[str, Any]:
    """Reads bundle.json and checks everything a reader relies on; keys it does not know are kept and ignored.

    Raises:
        BundleError: not a bundle, a newer major version, or a value that is missing or out of range.
    """
    try:
        info = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise BundleError(f"{source} is not a bundle: it cannot be read as JSON ({error})") from error
    if not isinstance(info, dict) or info.get("format") != FORMAT:
        raise BundleError(f"{source} is not a bundle: its format is not {FORMAT!r}")
    fields = Fields(info, source)
    version = re.fullmatch(r"([0-9]{1,6})\.([0-9]{1,6})", fields.text("version"))
    if version is None:
        raise BundleError(f"{source}: version must look like 1.0, not {_short(info['version'])}")
    if int(version[1]) > VERSION[0]:
        raise BundleError(
            f"{source} has version {version[0]}, this program reads up to {VERSION[0]}.x: update bitymi-ns to open it"
        )
    fields.integer("surfels.count")
    fields.text("surfels.view_color", "sv", "sh", "sb", "sg")
    if "terms" in fields.get("surfels"):  # lean view colours
        fields.integer("surfels.terms")
    fields.number("color_bias")
    for name in ("alpha_max", "alpha_min", "t_min", "near", "weight_bound", "low_pass"):
        fields.number(f"render.{name}")
    if "prefilter" in info["render"]:  # bundles of earlier versions have the low pass
        fields.text("render.prefilter", "low_pass", "pixel")
    fields.numbers("render.background", 3)
    fields.numbers("world.transform", 3, 4)
    fields.number("world.scale")
    fields.numbers("bounds.min", 3)
    fields.numbers("bounds.max", 3)
    _check_files(fields)
    if fields.get("atlas") is not None:
        _check_atlas(fields)
    return info


def _check_files(fields: Fields) -> None:
    files = fields.get("files")
    if not isinstance(files, dict) or SURFELS not in files:
        raise BundleError(f"{fields.source}: files must list {SURFELS}")
    if (ATLAS in files) != (fields.get("atlas") is not None):
        raise BundleError(f"{fields.source}: files and atlas disagree whether there is an {ATLAS}")
    for name, entry in files.items():
        check_file_name(name, fields.source)
        each = Fields(entry, f"{fields.source}: {name}")
        each.integer("bytes", high=2**50)
        if _DIGEST.fullmatch(each.text("sha256")) is None:
            raise BundleError(f"{fields.source}: {name}: sha256 must be 64 hexadecimal digits")


def _check_atlas(fields: Fields) -> None:
    fields.text("atlas.format", "bc7", "uint8", "fp16")
    for name in ("width", "height", "layers"):
        fields.integer(f"atlas.{name}", low=1, high=1 << 20)
    fields.number("atlas.offset")
    if not fields.number("atlas.scale") > 0:
        raise BundleError(f"{fields.source}: atlas.scale must be positive")
    if not fields.number("atlas.extent") > 0:
        raise BundleError(f"{fields.source}: atlas.extent must be positive")


def check_file_name(name: Any, source: str) -> None:
    """Refuses names that are not a plain file name: a bundle never reaches out of its folder."""
    if not isinstance(name, str) or _FILE_NAME.fullmatch(name) is None or name == MANIFEST:
        raise BundleError(f"{source}: {_short(name)} cannot be the name of a file of the bundle")


def _plain(value: Any) -> Any:
    """`value` with arrays as lists and non-finite numbers as None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, (Tensor, np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int)):
        return value
    return str(value)


def _short(value: Any) -> str:
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of too many digits
        text = f"a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."
