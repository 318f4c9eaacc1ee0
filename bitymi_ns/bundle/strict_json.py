"""Strict JSON: unique keys, finite numbers, and a canonical form for digests."""

import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor


def loads(data: bytes | bytearray) -> Any:
    """Parse UTF-8 JSON. Raises ValueError: not JSON, a duplicate key, a number that is not finite (also 1e999), or
    nested too deeply."""
    try:
        return json.loads(
            data.decode("utf-8"), object_pairs_hook=_object, parse_constant=_constant, parse_float=_finite
        )
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def canonical(value: Any) -> bytes:
    """Serialise JSON: sorted keys, no white space, ASCII. Raises ValueError: a number is not finite, or nested too
    deeply."""
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode("ascii")
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def digest(value: Any) -> str:
    """Compute the SHA-256 of `canonical(value)`, 64 hexadecimal digits."""
    return hashlib.sha256(canonical(value)).hexdigest()


def plain(value: Any) -> Any:
    """Convert to JSON types: arrays to lists, non-finite numbers to None, anything unknown to text."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, (Tensor, np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int)):
        return value
    return str(value)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members: dict[str, Any] = {}
    for key, value in pairs:
        if key in members:
            raise ValueError(f"the key {key[:60]!r} occurs twice")
        members[key] = value
    return members


def _constant(text: str) -> float:
    raise ValueError(f"{text} is not a finite number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is not a finite number")
    return value
