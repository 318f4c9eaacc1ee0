"""Image metrics, training curve and timers."""

import json
import math
import resource
import time
from pathlib import Path

import pytest
import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run import metrics
from bitymi_ns.plugin.run.callbacks import TrainingCurve
from bitymi_ns.plugin.run.trainer import BitymiPipeline
from bitymi_ns.train.step import Stopwatch
from tests.captures import printed
from tests.typed import Printed


def pair() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    reference = torch.rand(40, 50, 3, generator=generator)
    return (reference + 0.1).clamp(0, 1), reference


def test_metrics_agree_with_their_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    flip_evaluator = pytest.importorskip("flip_evaluator")
    monkeypatch.setattr(metrics, "_lpips_missing", ["lpips"])
    image, reference = pair()
    result = metrics.image_metrics(image, reference)
    _, flip, _ = flip_evaluator.evaluate(reference.numpy(), image.numpy(), "LDR")
    assert result["flip"] == pytest.approx(flip, abs=1e-6)
    assert 0 < result["ssim"] < 1 and all(isinstance(v, float) and math.isfinite(v) for v in result.values())
    result = metrics.image_metrics(image, image)
    assert result["ssim"] == pytest.approx(1.0) and result["flip"] == pytest.approx(0.0, abs=1e-6)
    assert "lpips" not in result
    monkeypatch.setattr(metrics, "_lpips_missing", [])
    monkeypatch.setattr(metrics.lpips, "lpips", lambda *_: 0.25)
    assert metrics.image_metrics(*pair())["lpips_vgg"] == 0.25
    assert "lpips" not in metrics.image_metrics(image[:, :31], image[:, :31])  # too small


def test_quality_is_stated_as_it_is_and_after_a_fit_of_the_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "_lpips_missing", ["lpips"])
    _, reference = pair()
    darker = 0.7 * reference + 0.02
    result = metrics.image_metrics(darker, reference)
    assert result["psnr"] < 20 and result["fitted_psnr"] > 50
    assert result["ssim"] < 0.95 and result["fitted_ssim"] == pytest.approx(1.0, abs=1e-3)
    mask = torch.zeros(40, 50, 1, dtype=torch.bool)
    mask[::2] = True
    spoilt = torch.where(mask, darker, 1.0)
    assert metrics.image_metrics(spoilt, reference, mask)["fitted_psnr"] > 50
    assert metrics.image_metrics(spoilt, reference)["fitted_psnr"] < 30
    assert not any(name.startswith("mean_exposure") for name in result)
    result = metrics.image_metrics(torch.where(mask, (darker - 0.02) / 0.7, 1.0), reference, mask, spoilt)
    assert result["psnr"] > 50 and result["ssim"] > 0.99 and result["mean_exposure_psnr"] < 20


def test_available_lpips_are_stated(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def one_of_two(image: torch.Tensor, reference: torch.Tensor, backbone: str) -> float:
        if backbone == "vgg":
            raise metrics.lpips.LpipsUnavailable("its weights are not there")
        return 0.25

    monkeypatch.setattr(metrics, "_lpips_missing", [])
    monkeypatch.setattr(metrics.lpips, "lpips", one_of_two)
    for _ in range(2):
        found = metrics.image_metrics(*pair())
        assert found["lpips"] == found["fitted_lpips"] == 0.25 and "lpips_vgg" not in found
    assert capsys.readouterr().out.count("LPIPS_VGG is left out") == 1


def test_rendering_is_timed_alone() -> None:
    calls = []

    def render() -> None:
        calls.append(1)
        time.sleep(0.05 if len(calls) == 1 else 0.01)  # the first run is slow

    assert 8 < metrics.render_milliseconds(render, torch.device("cpu")) < 40
    assert len(calls) == 4


def test_the_clock_counts_between_start_and_stop_only() -> None:
    clock = Stopwatch(1.0, 2.0)
    clock.start()
    clock.stop()
    time.sleep(0.5)
    clock.stop()
    assert 1.0 <= clock.seconds < 1.4 and clock.cpu_seconds >= 2.0


def test_a_full_disk_costs_a_point_not_the_run_and_leaves_no_half_line(tmp_path: Path, capsys: Printed) -> None:
    curve = TrainingCurve(tmp_path / "new" / "a.jsonl")
    curve.add({"step": 1})
    before, limits = curve.path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 5, limits[1]))
    try:
        curve.add({"step": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert curve.path.read_bytes() == before and "could not be written" in printed(capsys)
    curve.add({"step": 3})
    assert [json.loads(line)["step"] for line in curve.path.read_text().splitlines()] == [1, 3]


def test_a_resumed_curve_goes_on_where_the_checkpoint_was(tmp_path: Path) -> None:
    first = TrainingCurve(tmp_path / "a.jsonl")
    for step in (10, 20, 30):
        first.add({"step": step})
    with open(tmp_path / "a.jsonl", "a") as file:
        file.write('{"step": 4')  # killed here
    TrainingCurve(tmp_path / "b.jsonl", tmp_path / "a.jsonl", steps_done=20).add({"step": 40})
    assert [json.loads(line)["step"] for line in (tmp_path / "b.jsonl").read_text().splitlines()] == [10, 20, 40]
    TrainingCurve(tmp_path / "a.jsonl")
    assert (tmp_path / "a.jsonl").read_text() == ""


def test_a_missing_metric_is_left_out(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    averages = {"psnr": math.nan, "psnr_std": math.nan, "ssim": 0.9, "ssim_std": math.nan}
    monkeypatch.setattr(VanillaPipeline, "get_average_image_metrics", lambda self, views: averages)
    pipeline = BitymiPipeline.__new__(BitymiPipeline)
    assert BitymiPipeline.get_average_image_metrics(pipeline, ["a view"]) == {"ssim": 0.9, "ssim_std": 0.0}
    assert "psnr is left out" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(InputError, match="no held-out view"):
        BitymiPipeline.get_average_image_metrics(pipeline, [])
