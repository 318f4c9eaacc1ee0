"""Views, points and modes of torch of a caller's own program are checked before they are learned from."""

import re
from typing import Any

import pytest
import torch

import bitymi_ns
from bitymi_ns.train.view_checks import check_counted, checked_views
from bitymi_ns.train.views import View

H, W = 36, 48
K = torch.tensor([[40.0, 0, W / 2], [0, 40, H / 2], [0, 0, 1]])


def view(viewmat: torch.Tensor | None = None, intrinsics: torch.Tensor = K, **changes: Any) -> View:
    camera = bitymi_ns.Camera(torch.eye(4) if viewmat is None else viewmat, intrinsics, W, H)
    return View(**{"camera": camera, "image": torch.full((H, W, 3), 0.5), "mask": None, **changes})


SKEWED = K + torch.tensor([[0.0, 3, 0], [0, 0, 0], [0, 0, 0]])
POINTS = torch.tensor([[0.0, 0, 3], [0.2, 0.1, 3], [-0.2, 0.1, 4]])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (view(image=torch.full((H, W, 3), 127.0)), "views[1].image has to be from 0 to 1, not from 127 to 127"),
        (view(image=torch.ones(H, W, 3).short()), "views[1].image has to be uint8 or float, not torch.int16"),
        (view(image=torch.full((H, W, 3), torch.nan)), "views[1].image has to be finite, and is not"),
        (view(image=torch.ones(W, H, 3)), "views[1].image has to be [36, 48, 3], as its camera is, not [48, 36, 3]"),
        (view(mask=torch.ones(H, W)), "views[1].mask has to be bool, or integers of which 0 excludes"),
        (view(mask=torch.ones(H, dtype=torch.bool)), "views[1].mask has to be [36, 48]"),
        (view(torch.full((4, 4), torch.nan)), "views[1].camera.viewmat has to be finite"),
        (view(intrinsics=-K), "views[1].camera.K needs positive focal lengths and no skew"),
        (view(intrinsics=SKEWED), "views[1].camera.K needs positive focal lengths and no skew"),
    ],
)  # fmt: skip
def test_a_wrong_view_is_named(wrong: View, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        bitymi_ns.train_scene([view(), wrong], POINTS, POINTS.clamp(0, 1), steps=1)


def test_masks_of_bytes_are_those_of_bools() -> None:
    mask = torch.zeros(H, W, dtype=torch.bool)
    mask[:5] = True
    for given in (mask, mask.byte(), mask.byte() * 255, mask.long()):
        (checked,) = checked_views([view(mask=given)])
        assert checked.mask is not None and torch.equal(checked.mask, mask)
    for none in ([], [view(mask=~mask & mask)]):
        with pytest.raises(ValueError, match="there is nothing to learn from"):
            check_counted(none)


@pytest.mark.parametrize(
    ("points", "colors", "message"),
    [
        (POINTS, POINTS * 255, "colors has to be from 0 to 1"),
        (POINTS.double() / 0, POINTS, "points has to be finite"),
        (POINTS[:, :2], POINTS, r"points have to be \[M, 3\]"),
    ],
)
def test_points_are_checked(points: torch.Tensor, colors: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        bitymi_ns.train_scene([view()], points, colors, steps=1)


def test_a_scene_is_learned_whatever_mode_torch_is_in() -> None:
    def learn() -> torch.Tensor:
        scene, _ = bitymi_ns.train_scene([view()], POINTS, POINTS.clamp(0, 1), steps=3, method="bitymi-notexture")
        return scene.surfels["means"].detach()

    want = learn()
    with torch.no_grad():
        assert torch.equal(learn(), want)
    torch.set_default_dtype(torch.float64)
    try:
        assert torch.equal(learn(), want)
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.inference_mode(), pytest.raises(ValueError, match="inference_mode"):
        learn()
