"""The atlas as a texture: page layout, coarser levels, sharing between threads."""

import threading
import time
from dataclasses import replace

import pytest
import torch

from bitymi_ns.ops import baked_cuda
from bitymi_ns.ops.baked import draw
from bitymi_ns.ops.baked_cuda import Sheet
from bitymi_ns.ops.baked_scene import DrawCache, tile_levels
from tests.cuda.baked_scenes import front, textured


@pytest.mark.parametrize("photo_pixel", [1.0, 0.5, 0.25])
def test_where_pages_lie_in_the_texture_does_not_show(
    photo_pixel: float, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pages in a column, a row, a grid with a gap, and with sides off any grid."""
    scene = textured(30, 5)
    assert scene.atlas is not None
    atlas = torch.cat([scene.atlas, scene.atlas.flip(1)[:1]])
    tiles = scene.tiles.clone()
    tiles[:, 2] = torch.arange(30) % 3
    wider = torch.zeros(3, atlas.shape[1] + 3, atlas.shape[2] + 1, 4, dtype=torch.uint8)
    wider[:, :-3, :-1] = atlas
    images = []
    for down, pages in ((3, atlas), (1, atlas), (2, atlas), (3, wider), (2, wider)):
        made = Sheet.of(3, *pages.shape[1:3])
        assert made.down == 3 and made.width % 4 == 0 and made.height % 4 == 0
        monkeypatch.setattr(Sheet, "of", lambda *size, made=made, down=down: made._replace(down=down))
        placed = replace(scene, atlas=pages, tiles=tiles).to(device)
        images.append(draw(placed, [front()], None, ("rgb",), photo_pixel)["rgb"])
        monkeypatch.undo()
    for image in images[1:]:
        off = (image - images[0]).abs()  # where a coordinate lies between two of the texture unit's fractions
        assert off.max() < 1 / 256 and (off > 0).double().mean() < 0.01


@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32], ids=["uint8", "half"])
def test_levels_are_made_of_the_texture(
    dtype: torch.dtype, alpha: bool, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """BC7 blocks included: smaller views need no decoding."""
    generator = torch.Generator().manual_seed(0)
    pages = torch.randint(256, (3, 8, 12, 4), generator=generator, dtype=torch.uint8)
    pages[..., 3] *= torch.rand(3, 8, 12, generator=generator) < 0.5
    pages[0, :4, :4, 3] = 0
    if dtype != torch.uint8:
        pages = pages / 255
    atlas, made = baked_cuda.Atlas.of(pages, False, device), []
    texture = baked_cuda.AtlasTexture

    class Noted(texture):
        def __init__(self, texels: torch.Tensor, blocks: bool, device: torch.device) -> None:
            made.append(texels)
            super().__init__(texels, blocks, device)

    monkeypatch.setattr(baked_cuda, "AtlasTexture", Noted)
    assert list(atlas.levels(alpha)) == ["half", "quarter"]
    whole = atlas.sheet.joined(pages if dtype == torch.uint8 else pages.half().float(), 1)
    levels = tile_levels(whole[None], torch.zeros(1, 5, dtype=torch.int32), alpha)
    for got, (_, want, _) in zip(made, levels, strict=True):
        torch.testing.assert_close(got, want[0], rtol=0, atol=0 if dtype == torch.uint8 else 1e-3)


def test_threads_that_draw_a_scene_share_one_atlas() -> None:
    cache, made, inside = DrawCache(), [], threading.Event()

    def make() -> object:
        inside.set()
        time.sleep(0.05)  # the other thread comes meanwhile
        made.append(object())
        return made[-1]

    texels, got = torch.zeros(3), []
    threads = [threading.Thread(target=lambda: got.append(cache.atlas(make, texels))) for _ in range(2)]
    threads[0].start()
    inside.wait()
    threads[1].start()
    for thread in threads:
        thread.join()
    assert len(made) == 1 and got[0] is got[1]
