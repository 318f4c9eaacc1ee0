"""Results as a few short runs would leave them: two scenes, two methods, three atlas formats."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

# scene, method: PSNR, SSIM, FLIP, surfels, milliseconds of the trained renderer
RUNS = {
    ("fox", "bitymi"): (27.413, 0.871, 0.118, 18_942, 61.7),
    ("fox", "bitymi-quality"): (27.902, 0.879, 0.113, 27_310, 88.4),
    ("snowmiku", "bitymi"): (31.055, 0.944, 0.071, 11_207, 48.9),
    ("snowmiku", "bitymi-quality"): (31.618, 0.949, 0.068, 16_550, 66.0),
}
# format: change of PSNR, bytes per texel, share of the trained renderer's milliseconds
FORMATS = {"fp16": (0.001, 6, 0.24), "uint8": (-0.004, 4, 0.22), "bc7": (-0.031, 1, 0.23)}


def evaluation(scene: str, method: str, checkpoint: str, **results: float) -> dict:
    """ns-eval's JSON object, with the standard deviations and rates that ns-eval adds."""
    results = {"lpips": math.nan, "num_rays_per_sec": 81_234.5, "fps": 0.63, **results}
    spread = {f"{key}_std": abs(value) * 0.04 for key, value in results.items()}
    return {
        "experiment_name": scene,
        "method_name": method,
        "checkpoint": checkpoint,
        "results": results | spread,
    }


def view(path: Path, index: int, noise: float, phase: float) -> None:
    """A photograph beside its rendering, as the method's `img` is written."""
    y, x = np.mgrid[0:90, 0:160] / 90.0
    photo = np.stack([x / 1.8, 0.5 + 0.5 * np.sin(9 * x + index + phase), 1 - y], -1)
    rendered = photo + noise * np.random.default_rng(index).normal(size=photo.shape)
    both = np.concatenate([photo, rendered], 1).clip(0, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((both * 255).astype(np.uint8)).save(path)


def write_results(root: Path) -> Path:
    """Write a results folder and return it."""
    for (scene, method), (psnr, ssim, flip, surfels, ms) in RUNS.items():
        run = root / "outputs" / scene / method / "2025-03-01_101500"
        run.mkdir(parents=True)
        (run / "config.yml").write_text("!!python/object:nobody.reads.this {}\n")
        lines = []
        for step in range(0, 3001, 100):
            t = step / 3000
            line = {
                "step": step,
                "seconds": 0.4 + 310 * t**1.1,
                "cpu_seconds": 0.7 + 590 * t**1.1,
                "surfels": int(4000 + (surfels - 4000) * min(1.0, 2 * t) + 300 * math.sin(9 * t)),
                "fragments": int(2.1e6 - 6e5 * t),
            }
            if step % 300 == 0:
                line["psnr"] = psnr - 9 * math.exp(-4.5 * t)
            lines.append(json.dumps(line))
        (run / "curve.jsonl").write_text("\n".join(lines) + "\n")
        shared = {"ssim": ssim, "flip": flip, "surfels": surfels, "fragments_per_pixel": 14.2}
        evals = root / "evals" / scene
        evals.mkdir(parents=True, exist_ok=True)
        trained = evaluation(
            scene,
            method,
            str(run / "nerfstudio_models/step-000002999.ckpt"),
            psnr=psnr,
            render_ms=ms,
            atlas_bytes=0,
            **shared,
        )
        (evals / f"{method}.json").write_text(json.dumps(trained, indent=2))
        for name, (delta, texel, share) in FORMATS.items():
            baked = evaluation(
                scene,
                f"{method}-bundle",
                f"/data/exports/{scene}/{method}-{name}/nerfstudio_models/step-000002999.ckpt",
                psnr=psnr + delta,
                render_ms=ms * share,
                atlas_bytes=surfels * 190 * texel,
                **shared,
            )
            (evals / f"{method}-{name}.json").write_text(json.dumps(baked, indent=2))
        if method == "bitymi":
            phase = 0.5 * list(RUNS).index((scene, method))  # other photographs in every scene
            for index in range(7):
                view(root / "renders" / scene / "trained" / f"eval_img_{index:04d}.png", index, 0.04, phase)
                view(root / "renders" / scene / "bc7" / f"eval_img_{index:04d}.png", index, 0.05, phase)
    (root / "outputs" / "transforms.json").write_text('{"frames": []}')
    return root


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder with four runs, sixteen evaluations and rendered views."""
    return write_results(tmp_path / "results")


@pytest.fixture
def eval_json(tmp_path: Path):
    """Writes one evaluation; returns its path."""

    def write(name: str = "eval.json", scene: str = "fox", method: str = "bitymi", checkpoint: str = "", **results):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(evaluation(scene, method, checkpoint, **results)))
        return path

    return write
