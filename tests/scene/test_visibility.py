import pytest
import torch

from bitymi_ns.ops import TexelAlpha, TexelTiles, project, trace
from bitymi_ns.scene.visibility import visibility


def test_what_stands_in_front_is_counted(surfels, camera):
    """Three discs in a row on the camera's axis, and one beside the image."""
    params = surfels(4)
    params["means"] = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [90.0, 0.0, 0.0]])
    params["quats"] = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(4, 4).clone()
    params["log_scales"] = torch.tensor([4.0, 4.0, -2.0, -2.0])[:, None].expand(4, 2).clone()  # two fill the view
    params["opacity_logits"] = torch.tensor([0.0, 1.0, 3.0, 3.0])
    params["beta_raw"] = torch.full((4,), -9.0)  # hard discs: the opacity everywhere
    first, second = torch.sigmoid(torch.tensor([0.0, 1.0])).tolist()
    found = visibility(params, [camera(6.0)], 0.2).transmittance
    expected = [1.0, 1 - first, (1 - first) * (1 - second), 0.0]
    assert found.tolist() == pytest.approx(expected, abs=2e-3)
    behind = camera(6.0)
    behind.viewmat[:] = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    behind.viewmat[2, 3] = 6.0
    seen = visibility(params, [camera(6.0), behind], 0.2).seen
    assert seen.tolist() == [[True, True, True, False]] * 2
    both = visibility(params, [camera(6.0), behind], 0.2).transmittance
    assert both.tolist() == pytest.approx([1 - second, 1.0, 1.0, 0.0], abs=2e-3) or both[2] == pytest.approx(1.0)
    assert visibility(params, [camera(6.0)], 0.2).in_front[3] == 1.0  # unseen
    assert visibility(params, [], 0.2).transmittance.tolist() == [0.0] * 4


def two_hard_discs(surfels, second: list[float]) -> dict[str, torch.Tensor]:
    """Make one at the origin and another one, facing the camera."""
    params = surfels(2)
    params["means"] = torch.tensor([[0.0, 0.0, 0.0], second])
    params["quats"] = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, 4).clone()
    params["log_scales"], params["beta_raw"] = torch.full((2, 2), -1.5), torch.full((2,), -9.0)
    params["opacity_logits"] = torch.tensor([0.0, 3.0])
    return params


def test_pixels_of_the_view_that_shows_most(surfels, camera):
    params = two_hard_discs(surfels, [90.0, 0.0, 0.0])
    near, far = (float(visibility(params, [camera(d)], 0.2).pixels[0]) for d in (4.0, 8.0))
    assert near == pytest.approx(4 * far, rel=0.2) and far > 5
    both = visibility(params, [camera(8.0), camera(4.0)], 0.2, weight_bound=0.4).pixels
    assert both.tolist() == pytest.approx([near, 0])
    assert visibility(params, [camera(4.0)], 0.2, weight_bound=0.6).pixels.tolist() == [0, 0]


def test_a_pixel_is_shared_among_its_layers_by_weight(surfels, camera):
    params = two_hard_discs(surfels, [0.0, 0.0, 0.5])
    view = camera(6.0)
    drawn = project(*(params[n] for n in ("means", "quats", "log_scales", "opacity_logits", "beta_raw")), view, 0.2)
    fragments = trace(drawn)
    expected = [float(fragments.weight[fragments.surfel == i].sum()) for i in range(2)]
    assert visibility(params, [view], 0.2).pixels.tolist() == pytest.approx(expected, rel=1e-5)
    assert min(expected) > 5


def test_what_is_cut_away_hides_nothing(surfels, camera):
    params = two_hard_discs(surfels, [0.0, 0.0, 0.5])
    tiles = TexelTiles.of_sizes(torch.ones(2, 2, dtype=torch.int32), torch.full((2,), 3.0))
    alpha = TexelAlpha(tiles, torch.tensor([0.0, 1.0]), 0.0)
    found = visibility(params, [camera(6.0)], 0.2, alpha=alpha)
    assert found.seen.tolist() == [[False, True]] and found.transmittance.tolist() == [0.0, 1.0]
    assert found.pixels[1] > visibility(params, [camera(6.0)], 0.2).pixels[1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_projected_points_come_back(camera, dtype):
    view = camera(6.0)
    points = torch.rand(200, 3, dtype=dtype, generator=torch.Generator().manual_seed(0)) * 10 - 5
    x, y, z, inside = view.project(points)
    assert x.dtype == dtype and bool((z > 0).all()) and 0 < int(inside.sum()) < 200
    assert inside.tolist() == ((x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)).tolist()
    torch.testing.assert_close(view.unproject(x, y, z), points, rtol=1e-5, atol=1e-5)
    homogeneous = view.viewmat.double() @ torch.cat([points.double(), torch.ones(200, 1).double()], 1).T
    pixels = view.K.double() @ homogeneous[:3]
    torch.testing.assert_close(torch.stack([x, y]).double(), pixels[:2] / pixels[2], rtol=1e-4, atol=1e-3)
    near = float(z.median())
    assert view.project(points, near)[3].tolist() == (inside & (z > near)).tolist()
