"""Fragment lists of the CPU kernels, by blocks of 4 x 4 pixels."""

import pytest
import torch

from bitymi_ns import ops
from bitymi_ns.ops import trace_cpu
from bitymi_ns.ops.backend import function, module
from bitymi_ns.ops.constants import TILE
from bitymi_ns.ops.fragment_list import empty_ids
from bitymi_ns.ops.parameters import GEOMETRY
from tests.ops.golden import camera_of, random_scene


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("width", "height", "surfels", "seed"), [(64, 48, 80, 1), (83, 37, 200, 2), (5, 3, 9, 3)])
def test_blocks_have_the_surfels_and_pixels_of_the_fragments(
    width: int, height: int, surfels: int, seed: int, dtype: torch.dtype
) -> None:
    case = random_scene(surfels, seed, width=width, height=height)
    camera = camera_of(case, dtype)
    case.params["log_scales"][::3, 0] -= 3  # long and thin
    projection = ops.project(*(case.params[key].to(dtype) for key in GEOMETRY), camera)
    fragments = ops.trace(projection)
    listed = fragments.layout.arrays
    across = -(-width // TILE)
    surfel, pixel, blocks_before = [], [], set()
    for tile, (first, last) in enumerate(zip(listed["block_start"][:-1], listed["block_start"][1:], strict=True)):
        assert len(surfel) == listed["tile_start"][tile]
        blocks_before.clear()
        for code, owner in listed["blocks"][first:last].tolist():
            lanes, block = code & 0xFFFF, code >> 16
            assert lanes and 0 <= block < 16 and (owner, block) not in blocks_before
            blocks_before.add((owner, block))
            for lane in range(16):
                if not lanes >> lane & 1:
                    continue
                x = tile % across * TILE + block % 4 * 4 + lane % 4
                y = tile // across * TILE + block // 4 * 4 + lane // 4
                assert x < width and y < height
                surfel.append(owner)
                pixel.append(y * width + x)
        owners = [owner for _, owner in listed["blocks"][first:last].tolist()]
        runs = [owner for k, owner in enumerate(owners) if k == 0 or owners[k - 1] != owner]
        assert len(runs) == len(set(runs))
    assert len(surfel) == listed["tile_start"][-1] == len(fragments) > 0
    assert surfel == fragments.surfel.tolist() and pixel == fragments.pixel.tolist()


def test_places_are_listed_when_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps without a field need none, which saves 8 bytes per fragment."""
    made = []
    monkeypatch.setattr(trace_cpu, "empty_ids", lambda *given: made.append(given) or empty_ids(*given))
    case = random_scene(80, 1, width=64, height=48)
    surfels = [case.params[key].clone().requires_grad_() for key in GEOMETRY]
    projection = ops.project(*surfels, camera_of(case, torch.float64))
    fragments = ops.trace(projection)
    ops.blended_image(fragments, projection, torch.full((80, 3), 0.3).double(), maps=True).sum().backward()
    counts = fragments.masked_counts(torch.ones(64 * 48, dtype=torch.bool))
    assert not made
    assert torch.equal(counts, torch.bincount(fragments.surfel, minlength=80))
    assert fragments.surfel is fragments.surfel and len(fragments.pixel) == len(fragments) and len(made) == 1
    listed = {"surfel": fragments.surfel, "pixel": fragments.pixel[1:]}
    with pytest.raises(ValueError, match="pixel has"):
        function("list_ids", torch.device("cpu"))(layout=fragments.layout.handle, width=64, height=48, **listed)
    with pytest.raises(ValueError, match="not that of such a list"):
        function("list_ids", torch.device("cpu"))(
            layout=fragments.layout.handle, width=65, height=48, **fragments.layout.ids()
        )


def test_a_layout_that_does_not_fit_is_refused() -> None:
    make = module(torch.device("cpu")).TileBlocks
    starts, blocks = torch.tensor([0, 3, 4]), torch.tensor([[0b111, 0], [1, 1]], dtype=torch.int32)
    block_starts = torch.tensor([0, 1, 2])
    make(tile_start=starts, block_start=block_starts, blocks=blocks)
    with pytest.raises(ValueError, match="begin with 0"):
        make(tile_start=starts + 1, block_start=block_starts, blocks=blocks)
    with pytest.raises(ValueError, match="do not belong"):
        make(tile_start=starts, block_start=block_starts, blocks=blocks[:1])
    with pytest.raises(ValueError, match="block_start has 2 elements"):
        make(tile_start=starts, block_start=block_starts[:2], blocks=blocks)
