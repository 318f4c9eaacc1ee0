"""Write compact.json: small compact bundles and their contents as the package reads them; run from a checkout."""

import base64
import json
import tempfile
from pathlib import Path

import numpy as np
from torch import Tensor

from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from tests.bundle.compact_scene import FINEST, make_codes, write_compact


def text(data: bytes | Tensor) -> str:
    """Encode bytes, or a tensor's numbers, in base64."""
    raw = data if isinstance(data, bytes) else np.ascontiguousarray(data.numpy()).tobytes()
    return base64.b64encode(raw).decode()


def described(folder: Path) -> dict[str, object]:
    """Collect the files of a bundle and its scene."""
    scene = read_bundle(folder).scene
    found = {**scene.surfels, "tiles": scene.tiles, "extent": scene.extent, "mean_residual": scene.mean_residual}
    if scene.mean_alpha is not None:
        found["mean_alpha"] = scene.mean_alpha
    if scene.atlas is not None:
        found["atlas"] = scene.atlas
    return {
        "files": {path.name: text(path.read_bytes()) for path in sorted(folder.iterdir())},
        "scene": {name: text(value) for name, value in found.items()},
    }


def main() -> None:
    bundles = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in sorted(VIEW_COLORS):
            bundles[kind] = described(write_compact(Path(folder) / kind, make_codes(kind)))
        bundles["finest"] = described(write_compact(Path(folder) / "finest", make_codes(steps=FINEST)))
        bundles["alpha"] = described(write_compact(Path(folder) / "alpha", make_codes(alpha=True)))
        bundles["plain"] = described(write_compact(Path(folder) / "plain", make_codes(textured=False)))
    path = Path(__file__).with_name("compact.json")
    path.write_text(json.dumps(bundles) + "\n", "utf8")


if __name__ == "__main__":
    main()
