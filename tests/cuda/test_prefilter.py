"""The prefilter in the CUDA kernels: the list and its gradients are those of the CPU kernels."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.scene import Camera
from tests.ops.golden import SURFEL_KEYS, random_scene


@pytest.mark.parametrize("scale", [0.5, 0.01])
def test_fragments_and_gradients_are_those_of_the_cpu(scale: float, device: torch.device, cpu) -> None:
    case = random_scene(30, 4, 40, 24, scale=scale)

    def run(where: torch.device) -> list[Tensor]:
        leaves = [case.params[key].to(where).clone().requires_grad_() for key in SURFEL_KEYS]
        camera = Camera(case.viewmat, case.K, case.width, case.height)
        projection = ops.project(*leaves, camera, prefilter=True)
        fragments = ops.trace(projection)
        order = torch.argsort(fragments.pixel.long() * 64 + fragments.surfel.long())
        image = torch.stack([fragments.weight, *fragments.uv, fragments.depth])[:, order]
        (image * torch.cos(torch.arange(image.numel(), device=where).double() * 1.3).view_as(image)).sum().backward()
        return [fragments.pixel[order], image.detach(), *(leaf.grad for leaf in leaves)]

    got = [t.cpu() for t in run(device)]
    with cpu():
        want = run(torch.device("cpu"))
    assert len(want[0]) > 20
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)
