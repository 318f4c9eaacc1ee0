"""Operations that one kind of device has no kernel for say so."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from bitymi_ns import ops
from bitymi_ns.ops import baked, baked_cpu
from bitymi_ns.ops.backend import emulated_cuda, module
from bitymi_ns.ops.field_tiles import field_tiles
from tests.cuda.conftest import why_not_emulated
from tests.ops.test_texel import Case

emulated = pytest.mark.skipif(why_not_emulated() is not None, reason=str(why_not_emulated()))
GEOMETRY = ops.FieldGeometry(4, False, (0.0, 0.0, 0.0), 1.0)


@emulated
def test_texel_images_are_drawn_on_the_cpu_only() -> None:
    case = Case()
    fragments = ops.TexelFragments.of(case.fragments)
    arguments = (fragments, case.base, case.texels, case.tiles)
    with emulated_cuda():
        with pytest.raises(RuntimeError, match="TexelFragments.of runs on the CPU only, .* move them to the CPU"):
            ops.TexelFragments.of(case.fragments)
        with pytest.raises(RuntimeError, match="texel_image runs on the CPU only, .* on 'cpu': move them to the CPU"):
            ops.texel_image(*arguments)
        with pytest.raises(RuntimeError, match="add_texel_gradient runs on the CPU only"):
            ops.add_texel_gradient(torch.zeros(1), *arguments, 0.0, None)


def test_tiles_are_evaluated_on_a_cuda_device_only() -> None:
    weights = (torch.zeros(1, 2, 4), torch.zeros(4, 16), torch.zeros(16, 16), torch.zeros(16, 3))
    with pytest.raises(RuntimeError, match="field_tiles runs on a CUDA device only, .* evaluate `field`"):
        field_tiles(torch.zeros(0, 9), torch.zeros(0), torch.zeros(0, 5), (1, 4, 4), GEOMETRY, *weights)


def test_each_baked_renderer_names_the_other() -> None:
    cpu = torch.device("cpu")
    scene = SimpleNamespace(device=cpu)
    for call in (
        lambda: baked.AtlasTexture(torch.zeros(1, 4, 4, 4), False, cpu),
        lambda: baked.Workspace().fit(scene, 1, 8, 8, False),
        lambda: baked.draw(scene, None, None, None, baked.empty_images(("rgb",), 1, 8, 8, cpu), baked.Workspace()),
    ):
        with pytest.raises(RuntimeError, match=r"baked\.\S+ runs on a CUDA device only, .* `baked_cpu.draw`"):
            call()


@emulated
def test_the_cpu_renderer_refuses_a_cuda_device() -> None:
    with emulated_cuda(), pytest.raises(RuntimeError, match=r"gather runs on the CPU only, .* `baked.draw`"):
        baked_cpu.gather(None, torch.zeros(0, 5, dtype=torch.int32))


def test_a_device_without_kernels_is_named() -> None:
    with pytest.raises(RuntimeError, match="no kernels for device 'meta'"):
        module(torch.device("meta"))
