"""Size of a view relative to the photographs, and its sampling."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bitymi_ns.ops.baked import draw
from bitymi_ns.scene import Camera
from bitymi_ns.scene.sampling import (
    LARGEST,
    MOST_PIXELS,
    ONE_SAMPLE,
    SAMPLE,
    Sampling,
    averaged,
    part_of,
    sampling_of,
    size_of,
)
from tests.cuda.baked_scenes import FAR, front, layered, textured, to_average

POINTS = torch.tensor([[0.0, 0, 0, 15.0], [0.5, 0.1, 0, 15.0], [-0.4, 0.2, 0, 15.0]])


def test_size_is_that_of_the_points_in_the_picture() -> None:
    camera = front()  # focal lengths 60 and 55, distance 4
    size = math.sqrt(60 * 55) / 4 / 15
    assert size_of(POINTS, camera) == pytest.approx(size)
    assert size_of(POINTS, camera.scaled(2.0)) == pytest.approx(2 * size)
    assert size_of(POINTS, front(distance=8.0)) == pytest.approx(size / 2)
    assert size_of(POINTS, front(distance=-8.0)) == 1.0  # behind the camera
    outside = torch.cat([POINTS, torch.tensor([[100.0, 0, 0, 1e-3]] * 5)])
    assert size_of(outside, camera) == pytest.approx(size)


@given(st.floats(1 / 64, 64), st.integers(1, 1 << 26))
def test_samples_are_close_enough_and_few_enough(size: float, pixels: int) -> None:
    how = sampling_of(size, pixels)
    assert how.samples >= 1 and how.photo_pixel > 0
    assert how.samples == 1 or how.samples**2 * pixels <= MOST_PIXELS
    if pixels < 1000:
        assert how.photo_pixel >= SAMPLE - 1e-9
    if how.samples > 1:
        assert how.photo_pixel < 2 * ONE_SAMPLE
    elif pixels < 1e6:
        assert size >= ONE_SAMPLE


def test_nothing_jumps_while_the_samples_stay() -> None:
    sizes = [2 ** (k / 200) for k in range(-250, 500)]
    found = [sampling_of(size, 1000) for size in sizes]
    for a, b in zip(found, found[1:], strict=False):
        assert a.samples != b.samples or abs(math.log2(b.photo_pixel / a.photo_pixel)) < 0.02
    assert sampling_of(0.01, 1 << 17).samples == 6 and sampling_of(0.01, 1 << 21).samples == 2
    assert sampling_of(1.0, 1000) == sampling_of(0.8, 1000) == sampling_of(1.4, 1000)
    assert sampling_of(2 * LARGEST, 1000).photo_pixel == 2 * LARGEST
    assert sampling_of(0.5, 1000).photo_pixel == 1.0  # at the photographs' size, then averaged


def test_the_part_of_a_view_with_the_scene_is_bounded() -> None:
    """web/test/view.test.ts has the same numbers."""
    camera = Camera(front(distance=8.0).viewmat, torch.tensor([[60.0, 0, 60], [0, 50, 40], [0, 0, 1]]), 120, 80)

    def part(*rows: tuple[float, float, float, float]) -> tuple[int, int, int, int]:
        x, y, z, scale = torch.tensor(rows).unbind(1)
        logs = torch.stack([scale.log(), scale * 0 - 9], 1)
        return part_of({"means": torch.stack([x, y, z], 1), "log_scales": logs}, [camera], 0.01)

    assert part((1, 0, 0, 0.1), (-1, 1, 0, 0.1), (0, 0, -99, 50)) == (46, 35, 74, 52)
    assert part((1, 0, 0, 3)) == part((1, 0, 0, math.nan)) == part((1, 0, 0, 1e38)) == (0, 0, 120, 80)
    assert part((0, 0, -99, 1)) == (57, 37, 63, 43)
    assert part((100, 0, 0, 0.1)) == (119, 35, 120, 45) and part((-100, 0, 0, 0.1))[0::2] == (0, 1)


def test_far_views_draw_the_part_with_the_scene_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, far = textured(200, 3), front(240, 176, distance=48.0)
    scene.photographed = torch.cat([scene.surfels["means"], torch.full((200, 1), math.sqrt(60 * 55) / 4)], 1)
    how = scene.sampling([far])
    left, top, right, bottom = how.part
    assert how.samples == 7 and (right - left) * (bottom - top) < 0.03 * 240 * 176
    background = torch.tensor([0.2, 0.4, 0.6])
    found = scene.render(far, background, maps=True)
    monkeypatch.setattr("bitymi_ns.scene.baked.part_of", lambda *_: (0, 0, 240, 176))
    whole = scene.render(far, background, maps=True)
    for name in ("rgb", "alpha", "beta", "depth", "normal"):
        torch.testing.assert_close(getattr(found, name), getattr(whole, name), atol=1e-3, rtol=0)
    assert torch.equal(found.rgb[0, 0], background) and int(found.overdraw.sum()) == pytest.approx(
        int(whole.overdraw.sum()), rel=1e-3
    )


def test_images_are_means_and_counts_sums() -> None:
    images = {"rgb": torch.rand(2, 6, 9, 3), "overdraw": torch.randint(0, 9, (2, 6, 9, 1), dtype=torch.int32)}
    small = averaged(images, 3)
    torch.testing.assert_close(small["rgb"][1, 1, 2], images["rgb"][1, 3:6, 6:9].mean((0, 1)))
    assert int(small["overdraw"][0, 0, 1]) == int(images["overdraw"][0, :3, 3:6].sum())


def test_a_view_is_drawn_for_its_size() -> None:
    scene, camera = textured(60, 0), front(120, 88)
    plain = scene.render(camera, maps=True)
    scene.photographed = torch.cat([scene.surfels["means"], torch.full((60, 1), math.sqrt(60 * 55) / 4)], 1)
    same = scene.render(camera, maps=True)
    assert all(torch.equal(getattr(same, name), getattr(plain, name)) for name in ("rgb", "alpha", "depth", "overdraw"))
    small = camera.scaled(0.25)
    how = scene.sampling([small])
    assert how.samples == 3 and how.photo_pixel == pytest.approx(0.75, rel=0.25)
    wanted = averaged(draw(scene, [small.scaled(3)], None, ("rgb", "overdraw"), how.photo_pixel), 3)
    got = scene.render(small, maps=True)
    torch.testing.assert_close(got.rgb, wanted["rgb"][0])
    assert torch.equal(got.overdraw, wanted["overdraw"][0]) and got.depth.shape == (22, 30, 1)


def test_small_views_are_close_to_averages_of_large_ones() -> None:
    scene, camera = textured(200, 3), front(240, 176)
    full = draw(scene, [camera], None, ("rgb",))
    scene.photographed = torch.cat([scene.surfels["means"], torch.full((200, 1), math.sqrt(60 * 55) / 4)], 1)
    for share in (0.5, 0.25, 0.125):
        small = Camera(camera.viewmat, camera.K, camera.width, camera.height).scaled(share)
        truth = averaged(full, round(1 / share))["rgb"][0]
        direct = draw(scene, [small], None, ("rgb",))["rgb"][0]
        error, before = (float((image - truth).square().mean()) for image in (scene.render(small).rgb, direct))
        assert error < 0.35 * before, share


@pytest.mark.parametrize("alpha, share, least", FAR)
def test_far_views_are_averages_where_layers_share_edges(alpha: bool, share: float, least: float) -> None:
    scene, camera = layered(alpha)
    assert scene.sampling([camera]) == Sampling()
    assert to_average(scene, camera, share) > least
