"""Building scenes without nerfstudio."""

import pytest
import torch

from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.init import build_scene, default_table_size, field_domain

CENTERS = torch.tensor([[3.0, 0.0, 1.0], [-1.0, 0.0, 1.0]])


@pytest.fixture
def cloud() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return 2 * torch.rand(50, 3, generator=generator) - 1, torch.rand(50, 3, generator=generator)


def build(cloud, bounded=False, pixels=0, declared=None, **options):
    config = SceneConfig(**{"log2_table_size": 8, **options})
    return build_scene(*cloud, CENTERS, config, TrainConfig(), bounded, pixels, declared=declared)


def test_an_open_scene_is_contracted_about_its_cameras(cloud) -> None:
    scene, report = build(cloud)
    geometry = scene.field.geometry
    assert len(scene) == report.given == 50
    assert geometry.contract and geometry.mid == (1.0, 0.0, 1.0) and geometry.half == pytest.approx(2.2)
    assert build(cloud, texture="none")[0].field is None
    assert field_domain(torch.ones(1, 3), CENTERS[:0], contract=True) == ((1.0, 1.0, 1.0), 1e-3)  # never empty


def test_a_bounded_scene_has_a_box_around_its_points(cloud) -> None:
    geometry = build(cloud, bounded=True)[0].field.geometry
    low, high = cloud[0].amin(0), cloud[0].amax(0)
    assert not geometry.contract
    assert geometry.half == pytest.approx(0.55 * float((high - low).max()))
    assert geometry.mid == pytest.approx(((low + high) / 2).tolist())


def test_a_declared_box_is_the_domain_if_it_is_small(cloud) -> None:
    box = torch.tensor([[-2.0, -2.0, -3.0], [2.0, 2.0, 1.0]])
    geometry = build(cloud, declared=box)[0].field.geometry
    assert not geometry.contract and geometry.mid == (0.0, 0.0, -1.0) and geometry.half == pytest.approx(2.2)
    assert build(cloud, declared=2.19 * box)[0].field.geometry.contract is False  # the cameras' ball has radius 2.2
    assert build(cloud, declared=2.21 * box)[0].field.geometry.contract is True
    assert build(cloud, declared=box, contraction="on")[0].field.geometry.contract is True
    assert build(cloud, declared=4 * box, contraction="off")[0].field.geometry.half == pytest.approx(8.8)
    assert build(cloud, bounded=True, contraction="on")[0].field.geometry.contract is True  # the option overrides
    assert build(cloud, bounded=False, contraction="off")[0].field.geometry.contract is False


def test_the_near_plane_follows_the_cameras_unless_it_is_given(cloud) -> None:
    assert build(cloud)[0].near == pytest.approx(0.02 * 2.2)
    assert build(cloud, texture="none")[0].near == pytest.approx(0.02 * 2.2)
    assert build(cloud, near=0.3)[0].near == 0.3


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_the_unit_of_length_does_not_decide_what_is_seen(cloud, unit) -> None:
    points = torch.tensor([[0.0, 0.0, 0.06], [0.0, 0.0, 0.03], [0.0, 0.0, 5.0]]) * unit
    scene, _ = build_scene(points, cloud[1][:3], unit * CENTERS, SceneConfig(texture="none"), TrainConfig(), False, 0)
    camera = Camera(torch.eye(4), torch.tensor([[9.0, 0, 8], [0, 9, 8], [0, 0, 1]]), 16, 16)
    assert scene.render(camera).projection.visible.tolist() == [True, False, True]


def test_the_table_grows_with_the_photographs_between_two_bounds(cloud) -> None:
    assert [default_table_size(pixels) for pixels in (0, 44 * 270 * 480, 10**9)] == [14, 17, 17]
    assert build(cloud, pixels=2**20, log2_table_size=None)[0].field.field_table.shape == (4, 2**15, 4)


@pytest.mark.parametrize(
    ("name", "value"),
    [("sv_sites", 0), ("sv_sites", 33), ("lobes", 0), ("sh_degree", 4), ("levels", 5), ("min_resolution", 0)]
    + [("log2_table_size", 40), ("log2_table_size", 0), ("near", 0.0), ("near", float("inf"))]
    + [("weight_bound", -1.0), ("rim", 0.0)],
)
def test_options_out_of_range_are_named(cloud, name, value) -> None:
    with pytest.raises(ValueError, match=f"{name} must be .*, not {value}"):
        build(cloud, **{name: value})
