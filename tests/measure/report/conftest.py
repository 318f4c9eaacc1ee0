"""Results of short runs (two scenes, two methods, three atlas formats), and a benchmark's work folder."""

import json
import math
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from PIL import Image

from bitymi_ns.measure.report.page import build, compose, to_page
from bitymi_ns.measure.report.records import Evaluation, Records, evaluation_from

RUNS = {
    ("fox", "bitymi"): (27.413, 18_942),
    ("fox", "bitymi-quality"): (27.902, 27_310),
    ("snowmiku", "bitymi"): (31.055, 11_207),
    ("snowmiku", "bitymi-quality"): (31.618, 16_550),
}
"""Scene, method: PSNR, surfels."""
FORMATS = {"fp16": (0.001, 6), "uint8": (-0.004, 4), "bc7": (-0.031, 1)}
"""Format: change of PSNR, bytes per texel."""


def evaluation(scene: str, method: str, **results: float) -> dict:
    """Write ns-eval's JSON object, with its standard deviations and rates."""
    results = {"lpips": math.nan, "num_rays_per_sec": 81_234.5, "fps": 0.63, **results}
    spread = {f"{key}_std": abs(value) * 0.04 for key, value in results.items()}
    return {"experiment_name": scene, "method_name": method, "results": results | spread}


def make(scene: str = "fox", method: str = "bitymi", source: str = "a/eval.json", **results: float) -> Evaluation:
    data = {"experiment_name": scene, "method_name": method, "results": results}
    return evaluation_from(data, Path(source))


def view(path: Path, index: int, noise: float, phase: float) -> None:
    """Write a photograph beside its render, like the method's `img`."""
    y, x = np.mgrid[0:90, 0:160] / 90.0
    photo = np.stack([x / 1.8, 0.5 + 0.5 * np.sin(9 * x + index + phase), 1 - y], -1)
    rendered = photo + noise * np.random.default_rng(index).normal(size=photo.shape)
    both = np.concatenate([photo, rendered], 1).clip(0, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((both * 255).astype(np.uint8)).save(path)


def write_results(root: Path) -> Path:
    evals = root / "evals"
    for i, ((scene, method), (psnr, surfels)) in enumerate(RUNS.items()):
        run = root / "outputs" / scene / method / "2025-03-01_101500"
        run.mkdir(parents=True)
        (run / "config.yml").write_text("!!python/object:nobody.reads.this {}\n")
        named = {"experiment_name": scene, "method_name": method}
        curve = [named | {"step": s, "seconds": s / 9, "cpu_seconds": s / 5, "surfels": s} for s in range(0, 999, 99)]
        for point in curve[::3]:
            point["psnr"] = psnr - 9 * math.exp(-point["seconds"] / 70)
        write_lines(run / "curve.jsonl", curve)
        shared = {"ssim": psnr / 33, "flip": 3 / psnr, "surfels": surfels, "fragments_per_pixel": 14.2}
        write_lines(
            evals / scene / f"{method}.json",
            [evaluation(scene, method, psnr=psnr, render_ms=surfels / 300, atlas_bytes=0, **shared)],
        )
        for name, (delta, texel) in FORMATS.items():
            sizes = {"atlas_bytes": surfels * 190 * texel, "bundle_bytes": surfels * 200 * texel}
            baked = evaluation(scene, method, psnr=psnr + delta, render_ms=surfels / 1300, **sizes, **shared)
            write_lines(evals / scene / f"{method}-{name}.json", [baked])
        for index in range(7) if method == "bitymi" else ():  # other photographs in every scene
            view(root / "renders" / scene / "trained" / f"eval_img_{index:04d}.png", index, 0.04, 0.5 * i)
            view(root / "renders" / scene / "bc7" / f"eval_img_{index:04d}.png", index, 0.05, 0.5 * i)
    (root / "outputs" / "transforms.json").write_text('{"frames": []}')
    return root


def cell(kind: str, value: dict[str, Any], bundle: str = "", **key: Any) -> dict[str, Any]:
    settings = {
        "cell": kind, "suite": "local", "row": "bitymi", "scene": "fox", "data": "/data/fox", "parser": [],
        "method": "bitymi", "options": [], "steps": 100, "seed": 0, **key,
    }  # fmt: skip
    if bundle:
        settings |= {"bundle": bundle, "export": ["--format", bundle]}
    return {"key": settings, "value": value, "made": {"machine": "Abacus, 10 beads", "seconds": 3.0}}


def figures(psnr: float, ms: float, **more: float) -> dict[str, Any]:
    return {"results": {"psnr": psnr, "ssim": 0.8, "flip": 0.1, "surfels": 5000.0, "render_ms": ms, **more}}


def write_lines(path: Path, lines: list[dict[str, Any]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def write_work(folder: Path) -> Path:
    """Write a work folder: two seeds of one row, baked, with pictures of one seed."""
    cells = []
    for seed, shift in ((0, 0.0), (1, 0.2)):
        curve = folder / "runs" / str(seed) / "training_curve.jsonl"
        write_lines(curve, [{"step": s, "seconds": s / 10, "psnr": 20 + s / 50} for s in (50, 100)])
        train = {"steps": 100, "seconds": 10.0 + seed, "cpu_seconds": 20.0, "surfels": 5000}
        cells.append(cell("train", {**train, "curve": f"runs/{seed}/training_curve.jsonl"}, seed=seed))
        cells.append(cell("eval", figures(25.0 + shift, 30.0) | {"pictures": f"evals/{seed}"}, seed=seed))
        cells.append(cell("export", {"bytes": 3_000_000, "format": "bc7"}, "bc7", seed=seed))
        cells.append(cell("eval", figures(24.9 + shift, 10.0, atlas_bytes=2e6), "bc7", seed=seed))
    view(folder / "evals/0/eval_img_0000.png", 0, 0.04, 0.0)
    write_lines(folder / "cells.jsonl", cells)
    return folder


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four runs, sixteen evaluations, rendered views, broken files. Not to be changed."""
    root = write_results(tmp_path_factory.mktemp("report") / "results")
    (root / "evals" / "fox" / "broken.json").write_text('{"results": {"psnr": 2')
    (root / "renders" / "fox" / "trained" / "eval_img_0099.png").write_bytes(b"\x89PNG\r\n\x1a\nrubbish")
    return root


@pytest.fixture(scope="session")
def page(results: Path) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(matplotlib.rcParams, "text.usetex", True)  # a local matplotlibrc may set this
        return build([results], results.with_name("report"), title="Two <scenes>").read_text("utf8")


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark's work folder. Not to be changed."""
    return write_work(tmp_path_factory.mktemp("bench") / "work")


@pytest.fixture
def eval_json(tmp_path: Path):
    """Return a function that writes an evaluation and returns its path."""

    def write(name: str = "eval.json", scene: str = "fox", method: str = "bitymi", **results):
        return write_lines(tmp_path / name, [evaluation(scene, method, **results)])

    return write


def page_of(**parts: Any) -> str:
    """Render the HTML page of a report with only these parts."""
    return to_page({**compose(Records(), ""), **parts})
