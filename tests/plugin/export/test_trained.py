"""A trained run beside its bundle."""

from types import SimpleNamespace

import pytest
import torch

from bitymi_ns.plugin.export.trained import held_out_psnr
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.losses import fitted_psnr, psnr
from bitymi_ns.train.views import View
from tests.stand_in_card import CARD, noted_reads


def test_held_out_views_are_compared_on_the_device_of_the_model() -> None:
    neural, baked, photo = torch.rand(3, 20, 30, 3, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(20, 30, 1, dtype=torch.bool)
    mask[5:] = True
    view = View(Camera(torch.eye(4), torch.eye(3), 30, 20), photo, mask)
    drawn_on = []

    def render(image: torch.Tensor, camera: Camera) -> SimpleNamespace:
        drawn_on.append(camera.K.device)
        return SimpleNamespace(rgb=image.to(CARD), alpha=None)

    moved = SimpleNamespace(render=lambda camera, background: render(baked, camera))
    scene = SimpleNamespace(to=lambda device: moved if device == CARD else None)
    with noted_reads() as reads:
        model = SimpleNamespace(device=CARD, background=torch.zeros(3).to(CARD), resume_state={})
        model.render = lambda camera, background, maps: render(neural, camera)
        capture = SimpleNamespace(corrected_eval_views=lambda state: [view])
        (row,) = held_out_psnr(model, capture, scene, 5)  # type: ignore[arg-type]
        assert drawn_on == [CARD, CARD] and max(reads) == 56
    want = [psnr(baked, neural, mask), psnr(neural, photo, mask), psnr(baked, photo, mask)]
    want += [fitted_psnr(neural, photo, mask), fitted_psnr(baked, photo, mask)]
    assert row == pytest.approx(want, abs=1e-5)
