import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bitymi_ns.codec.packing import pack
from bitymi_ns.codec.pages import covered_blocks

sides = st.sampled_from([4, 8, 16, 32, 64])
sizes = hnp.arrays(np.int32, st.tuples(st.integers(0, 120), st.just(2)), elements=sides)


def painted(packing):
    count = np.zeros((packing.layers, packing.height, packing.width), dtype=int)
    for x, y, layer, r_u, r_v in packing.tiles:
        count[layer, y : y + r_v, x : x + r_u] += 1
    return count


@settings(deadline=None, max_examples=60)
@given(sizes, st.sampled_from([64, 128, 4096]), st.sampled_from([64, 128, 8192]))
def test_tiles_lie_inside_pages_on_the_grid_without_overlap(resolution, page_width, max_rows):
    packing = pack(resolution, page_width, max_rows)
    x, y, layer, r_u, r_v = packing.tiles.T
    assert packing.tiles.dtype == np.int32
    np.testing.assert_array_equal(packing.tiles[:, 3:], resolution)
    assert ((x >= 0) & (x + r_u <= packing.width) & (y >= 0) & (y + r_v <= packing.height)).all()
    assert ((layer >= 0) & (layer < packing.layers)).all()
    assert (packing.tiles[:, :2] % 4 == 0).all()
    assert packing.width <= page_width and packing.height <= max_rows
    assert packing.height % 64 == 0 or (packing.layers == 1 and packing.height < 64 and packing.height % 4 == 0)
    count = painted(packing)
    assert count.max(initial=0) <= 1
    assert packing.occupancy == pytest.approx(count.mean())
    np.testing.assert_array_equal(covered_blocks(packing.tiles, packing.width, packing.height, packing.layers),
                                  count[:, ::4, ::4] > 0)  # fmt: skip
    again = pack(resolution.copy(), page_width, max_rows)
    np.testing.assert_array_equal(packing.tiles, again.tiles)


@settings(deadline=None, max_examples=30)
@given(sizes)
def test_the_shelves_are_those_of_first_fit_decreasing(resolution):
    packing = pack(resolution, 64, 8192)
    order = sorted(range(len(resolution)), key=lambda i: (-resolution[i, 1], -resolution[i, 0], i))
    shelves: list[list[int]] = []  # y, used
    rows = 0
    for i in order:
        r_u, r_v = (int(r) for r in resolution[i])
        shelf = next((shelf for shelf in shelves if shelf[1] + r_u <= packing.width), None)
        if shelf is None:
            shelf = [rows, 0]
            shelves.append(shelf)
            rows += r_v
        assert packing.tiles[i, :2].tolist() == [shelf[1], shelf[0]]
        shelf[1] += r_u


def test_surfels_without_a_tile_take_no_room():
    packing = pack([[0, 0], [8, 4], [0, 0]])
    assert packing.tiles.tolist() == [[0, 0, 0, 0, 0], [0, 0, 0, 8, 4], [0, 0, 0, 0, 0]]
    assert (packing.width, packing.height, packing.occupancy) == (8, 4, 1.0)
    assert pack(np.zeros((0, 2), dtype=int)).tiles.shape == (0, 5)
    assert [pack([[64, 64]] * count).width for count in (1, 16, 10_000)] == [64, 256, 4096]  # narrow pages
    packing = pack([[64, 64]] * 65, page_width=64, max_rows=1024)  # share the rows evenly
    assert (packing.layers, packing.height) == (5, 832) and painted(packing).max() == 1


def test_half_a_million_tiles_take_less_than_seconds():
    resolution = 2 ** np.random.default_rng(0).integers(2, 7, (500_000, 2))
    start = time.perf_counter()
    packing = pack(resolution)
    assert time.perf_counter() - start < 5
    assert packing.occupancy > 0.95


def test_limits_and_other_sizes_are_refused_with_a_way_out():
    for size in ([3, 4], [4, 48], [2, 2], [0, 4], [-4, 4]):
        with pytest.raises(ValueError, match="tile 0"):
            pack([size])
    with pytest.raises(ValueError, match="lower r_max"):
        pack([[64, 64]] * 9, page_width=64, max_rows=64, max_layers=8)
    with pytest.raises(ValueError, match="page width"):
        pack([[64, 64]], page_width=32)
    with pytest.raises(ValueError, match="power of two"):
        pack([[4, 4]], page_width=100)
    with pytest.raises(ValueError, match="multiple of 64"):
        pack([[4, 4]], max_rows=100)
    with pytest.raises(ValueError, match="do not divide"):
        pack([[4, 128]], max_rows=192)
