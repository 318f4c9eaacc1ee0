"""Resolution of the photographs in bundle.json."""

import base64
import json

import pytest
import torch

from bitymi_ns.bundle import BundleError, read_bundle
from bitymi_ns.bundle.manifest import describe, points_text
from tests.bundle.made import make

POINTS = torch.tensor([[0.0, 1.0, -2.5, 30.0], [1e-3, 7.0, 0.25, 1e6]])


def test_points_come_back(surfels, tmp_path) -> None:
    make(surfels, tmp_path / "b", photographed=POINTS)
    assert torch.equal(read_bundle(tmp_path / "b").scene.photographed, POINTS)
    make(surfels, tmp_path / "none")
    assert read_bundle(tmp_path / "none").scene.photographed is None


@pytest.mark.parametrize(
    "text",
    [
        "no base64!",
        base64.b64encode(b"12345").decode(),
        points_text(torch.tensor([[0.0, 0.0, 0.0, 0.0]])),
        points_text(torch.tensor([[0.0, 0.0, 0.0, float("nan")]])),
        points_text(torch.tensor([[float("inf"), 0.0, 0.0, 1.0]])),
        points_text(torch.ones(5000, 4)),
    ],
    ids=["text", "length", "rate", "nan", "infinite", "many"],
)
def test_wrong_points_are_refused(text: str, surfels, tmp_path) -> None:
    make(surfels, tmp_path / "b", photographed=POINTS)
    info = json.loads((tmp_path / "b" / "bundle.json").read_text())
    del info["digest"]
    info["render"]["photographed"] = text
    with pytest.raises(BundleError, match="photographed"):
        describe(info)
