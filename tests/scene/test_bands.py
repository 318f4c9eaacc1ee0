"""Views with more fragments than allowed are drawn in bands: same image and gradients, less memory."""

from unittest.mock import Mock

import pytest
import torch

from bitymi_ns import ops
from bitymi_ns.ops import trace_cpu
from bitymi_ns.scene import scene as scene_module
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.views import View
from tests.scene import bands

CPU = torch.device("cpu")


@pytest.mark.parametrize("share", [0.9, 0.4, 0.16])
def test_values_and_gradients_do_not_change(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, want = bands.step(CPU, 0)
    assert isinstance(whole, ops.Fragments)
    lengths, trace = [], ops.trace

    def counted(*args, **kwargs):
        fragments = trace(*args, **kwargs)
        lengths.append(len(fragments))
        return fragments

    monkeypatch.setattr(scene_module, "trace", counted)
    most = int(share * len(whole))
    parts, got = bands.step(CPU, most)
    heights = [fragments.height for fragments in parts.lists()]
    assert isinstance(parts, ops.Unlisted) and len(parts) == len(whole)
    assert sum(heights) == bands.HEIGHT and not any(height % 16 for height in heights[:-1])
    # each band once forward and once backward
    assert max(lengths) <= most and len(lengths) == 2 * len(heights)
    bands.assert_same(got, want)


@pytest.mark.parametrize("alpha", [False, True])
def test_bands_read_texels_that_no_other_band_has_moved(alpha: bool) -> None:
    whole, want = bands.texel_step(CPU, 0, alpha)
    parts, got = bands.texel_step(CPU, int(0.3 * len(whole)), alpha)
    assert isinstance(parts, ops.Unlisted) and len(list(parts.lists())) > 2 and want["texels"].abs().max() > 0.1
    bands.assert_same(got, want)


def test_a_row_of_tiles_with_too_many_is_an_error_with_the_number() -> None:
    scene, camera = bands.make(CPU, 50)
    with pytest.raises(ops.TooManyFragments, match=r"the view has [\d,]+ fragments, \d+ per pixel.*room for 50"):
        scene.render(camera)


@pytest.mark.parametrize("most", [0, 1500, 10**6])
def test_lists_that_fit_are_the_whole_view(most: int) -> None:
    scene, camera = bands.make(CPU, 0)
    whole = scene.render(camera)
    found = list(ops.fitting_lists(whole.projection, most))
    assert (len(found) > 1) == (most == 1500) and all(most == 0 or len(f) <= most for f in found)
    assert sum(len(f) for f in found) == len(whole.fragments)
    counts = sum(torch.bincount(f.surfel, minlength=len(scene)) for f in found)
    assert torch.equal(counts, torch.bincount(whole.fragments.surfel, minlength=len(scene)))
    with pytest.raises(ops.TooManyFragments):
        list(ops.fitting_lists(whole.projection, 50))
    with torch.no_grad():
        without = bands.make(CPU, most)[0].render(camera)
    assert isinstance(without.fragments, ops.Unlisted) == (most == 1500)
    torch.testing.assert_close(without.rgb, whole.rgb.detach(), rtol=1e-12, atol=1e-12)


REFUSED = "[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory"  # torch's words
allocate = trace_cpu.empty_list


def scarce(like: torch.Tensor, count: int) -> dict[str, torch.Tensor]:
    if count > 1500:
        raise RuntimeError(REFUSED)
    return allocate(like, count)


@pytest.mark.parametrize("limit", [("MOST", 1500), ("empty_list", scarce)])
def test_a_list_that_memory_does_not_hold_is_drawn_in_bands(limit: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, want = bands.step(CPU, 0)
    monkeypatch.setattr(trace_cpu, *limit)
    parts, got = bands.step(CPU, 0)
    assert isinstance(whole, ops.Fragments) and isinstance(parts, ops.Unlisted)
    bands.assert_same(got, want)
    found = list(ops.fitting_lists(parts.projection))
    assert len(found) > 1 and all(len(f) <= 1500 for f in found)
    scene, camera = bands.make(CPU, 0)
    monkeypatch.setattr(scene_module, "blended_image", Mock(side_effect=RuntimeError(REFUSED)))
    with pytest.raises(MemoryError, match="the picture does not fit into memory: .*can't allocate memory"):
        scene.render(camera)


def test_training_goes_on() -> None:
    scene, camera = bands.make(CPU, 3000)
    scene = scene.float()
    camera = type(camera)(camera.viewmat.float(), camera.K.float(), camera.width, camera.height)
    photo = torch.rand(bands.HEIGHT, bands.WIDTH, 3, generator=torch.Generator().manual_seed(2))
    densify = DensifyConfig(min_surfels=10, min_interval=5, growth=0.0)
    trainer = Trainer(scene, [View(camera, photo)], TrainConfig(densify=densify, resolution_schedule=0), 40)
    losses, densified, banded = [], 0, 0
    for _ in range(40):
        terms, output, report = trainer.advance()
        losses.append(float(terms["photometric"]))
        densified += "pruned" in report
        banded += isinstance(output.fragments, ops.Unlisted)
    assert densified and banded > 10 and losses[-1] < losses[0]
