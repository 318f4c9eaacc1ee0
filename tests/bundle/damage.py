"""Damaged bundles with valid digests, as a determined forger would make them."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bitymi_ns import ply
from bitymi_ns.bundle import ktx2, strict_json
from bitymi_ns.codec.streams import compress, decompress


def signed(info: Mapping[str, Any], files: Mapping[str, bytes] | None = None) -> bytes:
    """Serialise bundle.json with its digest, and with the sizes and hashes of `files` if given."""
    info = {key: value for key, value in info.items() if key != "digest"}
    for name, data in (files or {}).items():
        if name in info["files"]:
            stated = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            info["files"] = {**info["files"], name: stated}
    return json.dumps({**info, "digest": strict_json.digest(info)}).encode()


def amend(folder: Path, change: Callable[[dict[str, Any]], object] = lambda info: None) -> None:
    info = json.loads((folder / "bundle.json").read_text())
    files = {name: (folder / name).read_bytes() for name in info["files"] if (folder / name).exists()}
    info = json.loads(signed(info, files))
    change(info)
    (folder / "bundle.json").write_bytes(signed(info))


def recode(folder: Path, name: str, change: Callable[..., object], rows: int) -> None:
    """Apply change(codes [rows, n]), in place, to a column of a compact bundle, with valid hashes and digest."""
    info = json.loads((folder / "bundle.json").read_text())
    for part in (info["surfels"], info["atlas"]):
        at, data = 0, (folder / part["file"]).read_bytes()
        for column in part["columns"]:
            size = sum(column["bytes"])
            if column["name"] == name:
                codes = decompress(memoryview(data)[at : at + size], rows, column["bytes"])
                change(codes)
                found = compress(codes)
                (folder / part["file"]).write_bytes(data[:at] + found.data + data[at + size :])
                column["bytes"] = found.sizes
            at += size
    (folder / "bundle.json").write_text(json.dumps(info))
    amend(folder)


def change_texel(folder: Path, channel: int, value: float) -> None:
    """Set a channel of the texel (5, 3) of an atlas in half floats, with valid hash and digest."""
    image = ktx2.parse_ktx2((folder / "atlas.ktx2").read_bytes())
    layer = np.frombuffer(bytes(image.payload[0]), "<f2").reshape(image.height, image.width, 4).copy()
    layer[3, 5, channel] = value
    ktx2.write_ktx2(folder / "atlas.ktx2", [layer.tobytes()], "fp16", image.width, image.height, "test")
    amend(folder)


def change_columns(folder: Path, change: Callable[..., object], element: str = "vertex") -> None:
    """Apply change(columns of the element) to surfels.ply, with valid hash and digest."""
    elements = ply.parse_ply((folder / "surfels.ply").read_bytes())
    change(elements[element])
    columns = elements.pop("vertex")
    ply.write_ply(folder / "surfels.ply", columns, more=elements)
    amend(folder)
