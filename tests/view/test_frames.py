"""Frames of every kind of bundle, in a browser and through wgpu, against the CPU renderer (table: docs/viewer.md).

Both draw in software without a GPU. The bundles are random surfels with tiles and a weight bound.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns.bundle import read_bundle
from bitymi_ns.bundle.single import write_single
from bitymi_ns.ops import webgpu
from bitymi_ns.view import single_site, write_static
from tests.required import skip_without
from tests.view.browser import drive, pixels, plain_server
from tests.view.conftest import HEIGHT, WIDTH, view, write
from tests.view.test_browser import MEAN

pytestmark = pytest.mark.slow

LARGEST = 12 / 255
ALL, COMPACT = {"format": "uint8", "tolerance": 0.0}, {"compact": True}
CASES = {
    "sv all": ALL,
    "sv compact": COMPACT,
    "sh compact": {"kind": "sh", **COMPACT},
    "sb all": {"kind": "sb", **ALL},
    "sg compact": {"kind": "sg", **COMPACT},
}
"""Every kind, with all terms or reduced; tests/ops/webgpu has both for each."""
CASES |= {"sv alpha": {"alpha": True}, "sv alpha compact": {"alpha": True, "seen": True, **COMPACT}}
ELSEWHERE = ("sv compact",)  # in a browser: test_browser.py
CASES |= {"near 3, colour": {"near": 3.0, "background": (0.2, 0.5, 0.9), **COMPACT}}


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("frames")
    given = {name: {"format": "uint8", **options} for name, options in CASES.items()}
    return {
        name: write(folder / re.sub(r"\W+", "-", name), count=400, larger=0.7, **options)  # type: ignore[arg-type]
        for name, options in given.items()
    }


def wanted(bundle: Path, background: tuple[float, ...] | None = None) -> np.ndarray:
    """Render a frame on the CPU, over the bundle's background or another one."""
    opened = read_bundle(bundle)
    color = torch.tensor(background or opened.info.render.background)
    return opened.scene.render(view(), color).rgb.clamp(0, 1).numpy()


def check(name: str, got: np.ndarray, want: np.ndarray) -> None:
    off = np.abs(got - want)
    covered = np.abs(want - want[0, 0]).max(-1) > 1 / 255
    print(f"{name}: mean {255 * off.mean():.3f}, largest {255 * off.max():.1f} of 255; {covered.mean():.0%} covered")
    assert got.shape == want.shape and covered.mean() > 0.15, name
    assert off.mean() < MEAN and off.max() < LARGEST, name


def test_cases_differ(bundles: dict[str, Path]) -> None:
    """The near plane removes surfels, and a background shows."""
    near = bundles["near 3, colour"]
    over_black = wanted(near, (0.0, 0.0, 0.0))
    assert np.abs(wanted(bundles["sv compact"]) - over_black).mean() > 0.02
    assert np.abs(wanted(near) - over_black).mean() > 0.1


def test_in_a_browser(bundles: dict[str, Path], tmp_path: Path) -> None:
    site = tmp_path / "site"
    write_static(single_site(bundles["sv compact"]), site)
    steps: list[list[object]] = []
    drawn = {name: bundle for name, bundle in bundles.items() if name not in ELSEWHERE}
    for bundle in drawn.values():
        write_single(bundle, site / f"{bundle.name}.bitymi")
        steps += [["goto", bundle.name], ["settle"], ["save", "#screenshot", tmp_path / f"{bundle.name}.png"]]
    with plain_server(site, True) as (address, _):
        asked = [["goto", f"{address}?file={step[1]}.bitymi"] if step[0] == "goto" else step for step in steps]
        found = drive(asked, (WIDTH, HEIGHT), patience=200)
    assert not found.problems
    for name, bundle in drawn.items():
        check(name, pixels(tmp_path / f"{bundle.name}.png"), wanted(bundle))


def test_through_wgpu(bundles: dict[str, Path]) -> None:
    try:
        webgpu.device.device()
    except webgpu.WebGpuUnavailable as error:
        skip_without("webgpu", str(error))
    for name, bundle in bundles.items():
        opened = read_bundle(bundle)
        scene = replace(opened.scene, through_webgpu=True)
        got = scene.render(view(), torch.tensor(opened.info.render.background)).rgb.clamp(0, 1).numpy()
        check(name, got, wanted(bundle))
