"""Gaussians as SplatTransform reads them and writes them on: glTF with KHR_gaussian_splatting, SPZ and SOG."""

import json
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns.interchange.gaussians import Gaussians, write_gaussians
from bitymi_ns.ply import parse_ply
from tests.opened_elsewhere.node import MODULES, said_by
from tests.opened_elsewhere.splat import gaussians
from tests.required import skip_without

COUNT = 100
UNKNOWN = {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}  # the validator does not know the extension


@pytest.fixture(params=["gaussians", "surfels"])
def written(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Gaussians, Path]:
    splats = gaussians(COUNT)
    splats.opacity_logits[:] *= 0.5  # SOG rounds opacities to bytes: logits near 0 and 1 would not come back
    write_gaussians(tmp_path / "a.ply", splats, flat=request.param == "surfels")
    return splats, tmp_path / "a.ply"


def convert(source: Path, target: Path) -> Path:
    program = MODULES / "@playcanvas" / "splat-transform"
    if shutil.which("node") is None or not program.is_dir():
        skip_without("npm", f"no node, or {program} is missing: make web-test")
    command = ["node", str(program / "bin" / "cli.mjs"), "-q", "-w", "-g", "cpu", str(source), str(target)]
    subprocess.run(command, check=True, capture_output=True, timeout=100)
    return target


def test_gltf_keeps_every_gaussian(written: tuple[Gaussians, Path], tmp_path: Path) -> None:
    splats, source = written
    file = convert(source, tmp_path / "a.glb")
    found = said_by("validate_gltf.mjs", "gltf-validator", file)["issues"]["messages"]
    assert {each["code"] for each in found if each["severity"] < 3} <= UNKNOWN
    data = file.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    tree, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    (primitive,) = tree["meshes"][0]["primitives"]
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension["kernel"] == "ellipse" and extension["colorSpace"] == "srgb_rec709_display"

    def values(name: str) -> np.ndarray:
        accessor = tree["accessors"][primitive["attributes"][name]]
        assert accessor["count"] == COUNT and accessor["componentType"] == 5126
        view = tree["bufferViews"][accessor["bufferView"]]
        start, width = view["byteOffset"] + accessor.get("byteOffset", 0), {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
        floats = np.frombuffer(body, "<f4", COUNT * width[accessor["type"]], start)
        return floats.reshape(COUNT, -1)

    assert np.allclose(values("POSITION") * (-1, -1, 1), splats.means, atol=1e-6)
    found_opacity = values("KHR_gaussian_splatting:OPACITY")[:, 0]
    assert np.allclose(found_opacity, splats.opacity_logits.sigmoid(), atol=1e-6)
    assert np.allclose(values("KHR_gaussian_splatting:SCALE")[:, :2], splats.log_scales[:, :2].exp(), rtol=1e-5)


@pytest.mark.parametrize("form", ["spz", "sog"])
def test_compressed_formats_bring_gaussians_back(written: tuple[Gaussians, Path], form: str, tmp_path: Path) -> None:
    splats, source = written
    back = convert(convert(source, tmp_path / f"a.{form}"), tmp_path / "back.ply")
    vertex = parse_ply(back.read_bytes())["vertex"]
    positions = torch.from_numpy(np.stack([vertex[name] for name in "xyz"], 1))
    nearest = torch.cdist(splats.means, positions).argmin(1)
    assert len(positions) == COUNT and len(nearest.unique()) == COUNT
    assert torch.allclose(positions[nearest], splats.means, atol=2e-3)
    assert np.allclose(vertex["opacity"][nearest], splats.opacity_logits, atol=0.1)
