"""Knobs and pictures of a trained scene, and what the report makes of them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bitymi_ns import cli
from bitymi_ns.measure import knobs as host_knobs
from bitymi_ns.measure.knobs import measure_to_file
from bitymi_ns.measure.pictures import KINDS, decompose, draw_worst, residual_parts
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.data.cameras import to_camera
from bitymi_ns.plugin.export.trained import load_trained
from bitymi_ns.plugin.run.config import BitymiTrainerConfig


@pytest.fixture(scope="session")
def config(field_run: BitymiTrainerConfig) -> Path:
    return field_run.get_base_dir() / "config.yml"


@pytest.fixture(scope="session")
def points(config: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict]:
    """All knobs of the trained room, those that need a bake each at a few values. Not to be changed."""
    output = tmp_path_factory.mktemp("knobs") / "knobs.jsonl"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host_knobs, "TOLERANCES", (0.0, 4.0))
        patch.setattr(host_knobs, "TILE_SIDES", (8, 64))
        measure_to_file(config, output, (), 1, 1)
    return [json.loads(line) for line in output.read_text().splitlines()]


def test_every_knob_is_measured_against_its_exact_setting(points: list[dict]) -> None:
    assert {p["knob"] for p in points} == set(host_knobs.KNOBS)
    for p in points:
        assert p["scene"] == "room" and p["method"] == "bitymi-field" and p["views"] == 1 and p["made"]["machine"]
        assert p["ms"] > 0 and 0 <= p["mean_steps"] <= p["max_steps"] < 256 and 5 < p["psnr"] < 60
        assert (p["max_steps"] == 0.0) or not p["exact"]
    groups = {(p["knob"], p["renderer"] if p["knob"] == "weight_bound" else "") for p in points}
    assert len(groups) == sum(p["exact"] for p in points)


def test_more_of_a_knob_is_more_error_and_fewer_bytes(points: list[dict]) -> None:
    def errors(knob: str, renderer: str = "baked") -> list[float]:
        return [p["mean_steps"] for p in points if (p["knob"], p["renderer"]) == (knob, renderer)]

    for knob in ("weight_bound", "transmittance", "resolution"):
        assert errors(knob) == sorted(errors(knob)) and errors(knob)[-1] > 0
    of_format = {p["value"]: p for p in points if p["knob"] == "format"}
    sizes = [of_format[name]["bytes"] for name in ("float32", "fp16", "uint8", "bc7")]
    assert sizes == sorted(sizes, reverse=True) and sizes[1] / sizes[3] == pytest.approx(8, rel=0.2)
    assert of_format["fp16"]["mean_steps"] < of_format["bc7"]["mean_steps"] < 1
    sides = [p for p in points if p["knob"] == "r_max" and not p["exact"]]
    assert sides[0]["mean_steps"] >= sides[-1]["mean_steps"] and sides[0]["bytes"] <= sides[-1]["bytes"]
    tolerances = [p for p in points if p["knob"] == "tolerance" and not p["exact"]]
    assert [p["value"] for p in tolerances] == [0.0, 0.75, 4.0]
    assert tolerances[0]["mean_steps"] <= tolerances[-1]["mean_steps"]
    assert {p["value"] for p in points if p["default"]} >= {0.02, 1e-4, 64, "bc7", 1.0, 0.75}


def test_texels_have_their_sizes_already(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    run = trained.get_base_dir() / "config.yml"
    measure_to_file(load_config=run, output=tmp_path / "k.jsonl", knobs=("r_max", "tolerance"), views=1, repeats=1)
    points = [json.loads(line) for line in (tmp_path / "k.jsonl").read_text().splitlines()]
    assert {p["knob"] for p in points} == {"tolerance"}
    errors = [p["mean_steps"] for p in points if not p["exact"]]
    assert errors[0] < 1e-3 < errors[-1] and errors == sorted(errors)
    draw_worst(run, tmp_path / "pictures", 1)
    listed = json.loads((tmp_path / "pictures" / "pictures.json").read_text())["views"]
    assert list(listed[0]["files"]) == list(KINDS)


def test_some_knobs_by_the_command(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--output", str(tmp_path / "k.jsonl"), "--knobs", "resolution", "--views", "1", "--repeats", "1"]
    assert cli.main(["bench", "knobs", "--load-config", str(config), *words]) == 0
    lines = (tmp_path / "k.jsonl").read_text().splitlines()
    assert {json.loads(line)["knob"] for line in lines} == {"resolution"}
    assert cli.main(["report", str(tmp_path), "--output-dir", str(tmp_path / "report")]) == 0
    assert "Resolution of rendering" in (tmp_path / "report" / "index.html").read_text("utf8")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"knobs": ("speed",)}, "there is no knob speed; there are weight_bound"),
        ({"repeats": 0}, "--repeats must be at least 1"),
        ({"output": Path("/nowhere/k.jsonl")}, "there is no folder /nowhere"),
        ({"load_config": Path("/nowhere/config.yml")}, "there is no /nowhere/config.yml"),
    ],
)
def test_mistakes_are_named(config: Path, tmp_path: Path, options: dict, reason: str) -> None:
    given = {"load_config": config, "output": tmp_path / "k.jsonl", "knobs": (), "views": 1, "repeats": 1, **options}
    with pytest.raises(InputError, match=reason):
        measure_to_file(**given)


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
    assert gap.min() > -1e-4 and gap.mean() < 0.02  # above where a colour was cut off at 0
    pictures = decompose(scene, camera, torch.zeros(3), torch.zeros(36, 48, 3))
    assert list(pictures) == list(KINDS)
