"""Pictures of a trained scene."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bitymi_ns.measure.pictures import KINDS, decompose, draw_worst, residual_parts
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.data.cameras import to_camera
from bitymi_ns.plugin.export.trained import load_trained
from bitymi_ns.plugin.run.config import BitymiTrainerConfig


@pytest.fixture(scope="session")
def config(field_run: BitymiTrainerConfig) -> Path:
    return field_run.get_base_dir() / "config.yml"


def test_pictures_of_texels(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    run = trained.get_base_dir() / "config.yml"
    draw_worst(run, tmp_path / "pictures", 1)
    listed = json.loads((tmp_path / "pictures" / "pictures.json").read_text())["views"]
    assert list(listed[0]["files"]) == list(KINDS)


def test_worst_views_are_drawn_in_order(config: Path, tmp_path: Path) -> None:
    draw_worst(config, tmp_path / "pictures", 2)
    listed = json.loads((tmp_path / "pictures" / "pictures.json").read_text())
    first, second = listed["views"]
    assert first["metrics"]["psnr"] <= second["metrics"]["psnr"] and first["of"] == 2
    assert list(first["files"]) == list(KINDS)
    for name in first["files"].values():
        with Image.open(tmp_path / "pictures" / name) as image:
            assert image.size == (48, 36)
    photo, final = (np.asarray(Image.open(tmp_path / "pictures" / first["files"][k])) / 255 for k in ("photo", "final"))
    mse = float(((photo - final) ** 2).mean())
    assert -10 * np.log10(mse) == pytest.approx(first["metrics"]["psnr"], abs=0.1)
    with pytest.raises(InputError, match="--views must be at least 1"):
        draw_worst(config, tmp_path / "none", 0)


def test_the_parts_make_the_whole(config: Path) -> None:
    _, pipeline = load_trained(config)
    scene = pipeline.model.scene
    camera = to_camera(pipeline.datamanager.eval_view(0)[0], "cpu")
    with torch.no_grad():
        scene.field.field_w3.normal_(std=0.1, generator=torch.Generator().manual_seed(0))
        output = scene.render(camera, None, "frozen")
        plain = scene.render(camera, None, "off").rgb
        positive, negative = residual_parts(scene, output)
    assert positive.min() >= 0 and negative.min() >= 0 and positive.max() > 1e-3 and negative.max() > 1e-3
    gap = output.rgb - (plain + positive - negative)
    assert gap.min() > -1e-4 and gap.mean() < 0.02  # positive where a colour was clipped at 0
    pictures = decompose(scene, camera, torch.zeros(3), torch.zeros(36, 48, 3))
    assert list(pictures) == list(KINDS)
