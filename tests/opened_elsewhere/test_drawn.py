"""Gaussians as PlayCanvas draws them."""

import base64
import io
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from bitymi_ns.bundle import read_bundle
from bitymi_ns.interchange import extras
from bitymi_ns.interchange.extras import write_extras
from bitymi_ns.interchange.gaussians import Gaussians, write_gaussians
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.losses import psnr
from tests.bundle.made import make
from tests.opened_elsewhere.node import HERE, MODULES
from tests.opened_elsewhere.splat import draw_gaussians
from tests.opened_elsewhere.test_splats import convert
from tests.required import skip_without
from tests.view.browser import drive, plain_server

NEAR, FAR = 0.01, 100.0
BACKGROUND = (0.1, 0.5, 0.3)
NEAR_OURS = 34.0
"""PSNR, dB, of PlayCanvas's pictures to splat.py's: PLY and glTF 37.2, SOG 35.0 to 35.7, wrong drawings up to 33."""
FILES = {"gaussians.ply": 0, "gaussians.sog": 0, "gaussians.glb": 180, "surfels.glb": 180}
"""Files and their frames' turns about z, in degrees: SplatTransform writes glTF with y up."""


def seen(degrees: float, distance: float) -> Camera:
    """Return a camera that sees the origin, with unequal focal lengths and the principal point off the centre."""
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.from_numpy(Rotation.from_euler("YXZ", [degrees, 25, 10], degrees=True).as_matrix())
    viewmat[2, 3] = distance
    return Camera(viewmat, torch.tensor([[110.0, 0.0, 74.0], [0.0, 95.0, 71.0], [0.0, 0.0, 1.0]]), 160, 120)


def of_opengl(camera: Camera) -> dict[str, object]:
    """Return a camera's size, and its pose and projection in OpenGL's axes, columns first."""
    w, h, K = camera.width, camera.height, camera.K.tolist()
    pose = torch.linalg.inv(camera.viewmat) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    projection = [
        [2 * K[0][0] / w, 0, 1 - 2 * K[0][2] / w, 0],
        [0, 2 * K[1][1] / h, 2 * K[1][2] / h - 1, 0],
        [0, 0, (FAR + NEAR) / (NEAR - FAR), 2 * FAR * NEAR / (NEAR - FAR)],
        [0, 0, -1, 0],
    ]
    columns = {"pose": pose.T.flatten().tolist(), "projection": np.transpose(projection).flatten().tolist()}
    return {"width": w, "height": h, **columns}


def drawn(
    folder: Path, files: dict[str, int], cameras: Sequence[Camera], background: Sequence[float]
) -> dict[str, Tensor]:
    """Let PlayCanvas draw the files of a folder; returns pictures [V, H, W, 3] of each; skips the test without it."""
    engine = MODULES / "playcanvas" / "build" / "playcanvas.mjs"
    if not engine.is_file():
        skip_without("npm", f"{engine} is missing: make web-test")
    for source in (engine, HERE / "draw_splats.html"):
        (folder / source.name).symlink_to(source)
    views = json.dumps([of_opengl(camera) for camera in cameras])
    calls = [f"draw('{file}', {turn}, {views}, {json.dumps(background)})" for file, turn in files.items()]
    with plain_server(folder, ranges=False) as (address, _):
        steps = [["goto", f"{address}draw_splats.html"], ["until", "!!window.draw"], *(["ask", each] for each in calls)]
        outcome = drive(steps)
    assert outcome.problems == []

    def pixels(url: str) -> Tensor:
        picture = Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")
        return torch.from_numpy(np.asarray(picture) / np.float32(255))

    pictures = outcome.results[2:]
    return {file: torch.stack([pixels(url) for url in urls]) for file, urls in zip(files, pictures, strict=True)}


@pytest.mark.slow
def test_playcanvas_draws_what_splat_draws(surfels, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def moderate(count: int, kind: str) -> dict[str, Tensor]:
        """Make surfels that cover pixels, with few colours above 1, where the engine's eight bits end."""
        params = surfels(count, kind)
        return params | {"log_scales": params["log_scales"] + 0.8, "sh_dc": 0.4 * params["sh_dc"]}

    background, cameras = torch.tensor(BACKGROUND), [seen(0, 4.0), seen(140, 5.0)]
    make(moderate, tmp_path / "bundle", "sh", count=60, mean_residual=torch.full((60, 3), 0.1), background=BACKGROUND)
    bundle, out = read_bundle(tmp_path / "bundle"), tmp_path / "out"
    photographs = torch.stack([bundle.scene.render(camera, background).rgb.clamp(0, 1) for camera in cameras])
    written: list[Gaussians] = []

    def write(path: Path, gaussians: Gaussians, *args: Any, **kwargs: Any) -> None:
        written.append(gaussians)
        write_gaussians(path, gaussians, *args, **kwargs)

    monkeypatch.setattr(extras, "write_gaussians", write)
    write_extras(bundle, out, ["gaussians", "surfels"], cameras=cameras)
    for file in FILES:
        if not file.endswith(".ply"):
            convert(out / f"{Path(file).stem}.ply", out / file)

    def ours(splats: Gaussians) -> Tensor:
        return torch.stack([draw_gaussians(splats, camera, background).clamp(0, 1) for camera in cameras])

    splats = written[0]
    expected, odd = ours(splats), torch.tensor([1.0, *3 * [-1.0], *5 * [1.0], *7 * [-1.0]])[:, None]
    wrong = {
        "mirrored": expected.flip(2),
        "linear colours": expected**2.2,
        "a pixel to the right": expected.roll(1, 2),
        "inverse rotations": ours(replace(splats, quats=splats.quats * torch.tensor([1.0, -1.0, -1.0, -1.0]))),
        "scales 1.1 times": ours(replace(splats, log_scales=splats.log_scales + 0.1)),
        "directions to the camera": ours(replace(splats, harmonics=splats.harmonics * odd)),
    }
    for file, pictures in drawn(out, FILES, cameras, BACKGROUND).items():
        assert psnr(pictures, expected) > NEAR_OURS, file
        assert abs(psnr(pictures, photographs) - psnr(expected, photographs)) < 1.3, file
        assert {name for name, other in wrong.items() if psnr(pictures, other) > NEAR_OURS} == set(), file
