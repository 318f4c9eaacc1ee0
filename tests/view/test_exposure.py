"""The page shows a photograph's exposure at its camera, and the mean elsewhere."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns.bundle import read_bundle
from bitymi_ns.scene import Camera
from bitymi_ns.train.views import shown
from tests.bundle.damage import amend
from tests.view.browser import pixels
from tests.view.conftest import HEIGHT, WIDTH, write
from tests.view.steps import Seen, Steps
from tests.view.test_browser import MEAN

pytestmark = pytest.mark.slow

GAINS = [0.4, 1.0, 1.8]
AFFINE = [*[0.7, 0.2, 0.0, 0.05], *[0.0, 0.8, 0.1, 0.0], *[0.1, 0.0, 0.6, 0.1]]
BACKGROUND = (0.2, 0.5, 0.3)


def exposed(folder: Path) -> Path:
    """Write a bundle with a camera of gains, one of an affine correction, and one of none."""
    bundle = write(folder, "uint8", compact=True, larger=1.0, background=BACKGROUND)
    rows = json.loads((bundle / "cameras.json").read_text())["cameras"]
    rows = [{**rows[0], "correction": GAINS}, {**rows[1], "correction": AFFINE}, {**rows[1], "name": "plain"}]
    rows[2]["viewmat"] = [x + 0.25 * (i == 3) for i, x in enumerate(rows[1]["viewmat"])]
    data = json.dumps({"cameras": rows}).encode()
    (bundle / "cameras.json").write_bytes(data)
    amend(bundle)
    return bundle


def at(seen: Seen, camera: Camera) -> Camera:
    """Move a camera to a view of the page."""
    axes = np.stack([seen.right, seen.down, seen.forward])
    viewmat = np.eye(4)
    viewmat[:3] = np.column_stack([axes, -axes @ seen.position])
    return replace(camera, viewmat=torch.from_numpy(viewmat).to(camera.viewmat))


def test_a_photograph_s_exposure_is_shown_at_its_camera(tmp_path: Path) -> None:
    bundle, page, names = exposed(tmp_path / "b"), Steps(), []
    pressed = "document.getElementById('exposure').ariaPressed"

    def shot(name: str) -> None:
        names.append(name)
        page.do(["settle"], ["save", "#screenshot", tmp_path / f"{name}.png"])

    switch = page.ask(f"document.getElementById('exposure').hidden + ',' + {pressed}")
    shot("0")
    page.do(["key", "i"])
    off = page.ask(pressed)
    shot("0 off")
    page.do(["press", "#next"])
    shot("1 off")
    page.do(["press", "#exposure"])
    shot("1")
    page.do(["press", "#next"])
    shot("2")
    page.do(["press", "#home"], ["key", "ArrowRight", 200])
    shot("0 moved")
    moved = page.view()
    page.do(["press", "#home"], ["press", "#share"])
    link = page.ask("location.hash")
    page.run(bundle, drawn=True, quarter=False, viewport=(WIDTH, HEIGHT))

    assert page[switch] == "false,true" and page[off] == "false"
    made, background = read_bundle(bundle), torch.tensor(BACKGROUND)
    for name in names:
        picture = pixels(tmp_path / f"{name}.png")
        row = made.cameras[int(name[0])]
        drawn = made.render(row.camera if "moved" not in name else at(page.seen(moved), row.camera))
        mean = drawn.rgb.clamp(0, 1).numpy()
        own = shown(drawn.rgb, row.exposure, drawn.alpha, background).clamp(0, 1).numpy()
        wanted, other = (own, mean) if name == name[0] else (mean, own)
        off = np.abs(picture - wanted).mean()
        assert off < MEAN, name
        assert row.exposure is None or off < 0.2 * np.abs(picture - other).mean(), name

    again = Steps()
    again.do(["save", "#screenshot", tmp_path / "link.png"])
    again.run(bundle, page[link], drawn=True, quarter=False, viewport=(WIDTH, HEIGHT))
    assert (tmp_path / "link.png").read_bytes() == (tmp_path / "0.png").read_bytes()


def test_a_bundle_without_corrections_has_no_switch(bundle: Path) -> None:
    page = Steps()
    page.do(["key", "i"])
    state = page.ask(
        "[document.getElementById('exposure').hidden, document.getElementById('exposure').ariaPressed].join()"
    )
    page.run(bundle)
    assert page[state] == "true,true"
