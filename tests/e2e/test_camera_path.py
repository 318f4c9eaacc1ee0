"""A camera path recorded in the browser, rendered by `ns-render camera-path` on the same bundle."""

import json
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.scripts import render
from PIL import Image

from tests.view.browser import drive, served

PSNR = 30.0


@pytest.mark.slow
def test_frames_of_a_path_are_the_pages_pictures(bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from bitymi_ns.view import site_of

    file, shots = tmp_path / "camera_path.json", [tmp_path / f"{k}.png" for k in range(2)]
    with served(site_of(bundle)) as address:
        found = drive(
            [
                ["goto", address],
                ["settle"],
                ["press", "#add-keyframe"],
                ["save", "#screenshot", shots[0]],
                ["press", "#next"],
                ["wheel", (60, 40), 200],
                ["settle"],
                ["press", "#add-keyframe"],
                ["save", "#screenshot", shots[1]],
                ["save", "#save-path", file],
            ],
            viewport=(160, 120),
        )
    assert not found.problems
    path = json.loads(file.read_text())
    path["camera_path"] = [path["camera_path"][k] for k in (0, -1)]
    file.write_text(json.dumps(path))
    monkeypatch.setattr(render.install_checks, "check_ffmpeg_installed", lambda: None)
    options = dict(output_path=tmp_path / "frames.mp4", output_format="images", image_format="png")
    render.RenderCameraPath(load_config=bundle / "config.yml", camera_path_filename=file, **options).main()

    pictures = [np.asarray(Image.open(shot).convert("RGB"), np.float64) / 255 for shot in shots]
    frames = [np.asarray(Image.open(tmp_path / f"frames/{k:05d}.png"), np.float64) / 255 for k in range(2)]
    psnr = [-10 * np.log10(np.mean((a - b) ** 2)) for a, b in zip(pictures, frames, strict=True)]
    across = -10 * np.log10(np.mean((pictures[0] - pictures[1]) ** 2))
    print(f"frames against the page: {psnr[0]:.1f} and {psnr[1]:.1f} dB; the two pictures: {across:.1f} dB")
    assert min(psnr) > PSNR > across + 5
