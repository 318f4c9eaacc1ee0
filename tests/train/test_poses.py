"""Pose refinement during training."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bitymi_ns.api import train_scene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import DensifyConfig, PoseConfig, TexelConfig, TrainConfig
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.init import surfels_from_points
from bitymi_ns.train.poses import Poses, aligned, gauge, moved, pose_step, view_psnr
from bitymi_ns.train.processes import ALONE
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.views import View
from tests.train.conftest import look_at_origin
from tests.train.part_of_a_run import advanced, resume, state_of

QUIET = DensifyConfig(start=30_000, reset_interval=30_000, final_prune_steps=(), prune_error=0.0)


def options(kind: str, **more) -> TrainConfig:
    texels = TexelConfig(start=18_000)
    return TrainConfig(densify=QUIET, refine_poses=kind, resolution_schedule=0, texels=texels, **more)


def motion(seed: int, size: float) -> Tensor:
    return size * torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def off(view: View, by: Tensor) -> View:
    return view._replace(camera=view.camera.posed(moved(view.camera.viewmat.double(), by)))


@pytest.fixture(scope="module")
def wrong(views) -> list[View]:
    """The photographs with poses that are a pixel off."""
    return [off(view, motion(i, 0.012)) for i, view in enumerate(views)]


@pytest.fixture(scope="module")
def ring(truth) -> tuple[list[View], list[View]]:
    """Photographs from a ring of cameras, and the same with poses half a pixel off, without a global motion."""
    angles = [2 * math.pi * i / 24 for i in range(24)]
    cameras = [
        look_at_origin([3 * math.cos(a), 3 * math.sin(a), 0.8 + 1.1 * math.sin(3 * i)]) for i, a in enumerate(angles)
    ]
    with torch.no_grad():
        right = [View(camera, truth.render(camera).rgb.clamp(0, 1)) for camera in cameras]
    unit = torch.tensor([1.0] * 3 + [1.0 / 3.0] * 3, dtype=torch.float64)
    errors = (torch.stack([motion(i, 0.012) for i in range(24)]) * unit).flatten()
    basis = gauge(torch.stack([camera.exact_center for camera in cameras]), 3.0)
    errors = (errors - basis @ (basis.T @ errors)).view(24, 6) / unit
    return right, [off(view, error) for view, error in zip(right, errors, strict=True)]


def scene_of(ball, views: list[View]) -> Scene:
    centers = torch.stack([view.camera.center for view in views])
    surfels, _ = surfels_from_points(*(t[::2] for t in ball), centers, TrainConfig(), SceneConfig(texture="texels"))
    return Scene(SceneConfig(texture="texels"), surfels, None)


def apart(some: list[Camera], others: list[Camera], points: Tensor) -> float:
    """Compute the median pixel distance of points between two sets of cameras."""
    pairs = [(torch.stack(camera.project(points)[:2]) for camera in pair) for pair in zip(some, others, strict=True)]
    return float(torch.stack([(a - b).norm(dim=0) for a, b in pairs]).median())


def test_a_motion_turns_about_the_centre_and_shifts_it(cameras):
    viewmat, by = cameras[1].viewmat.double(), motion(0, 0.3)
    there = cameras[1].posed(moved(viewmat, by))
    torch.testing.assert_close(there.center, (cameras[1].exact_center + by[3:]).float())
    rotation = there.viewmat[:3, :3].double()
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-6, rtol=0)
    torch.testing.assert_close(moved(viewmat, torch.zeros(6).double()), viewmat, atol=1e-6, rtol=0)
    assert there.width == cameras[1].width and torch.equal(there.K, cameras[1].K)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", [0.003, 0.02])
def test_a_view_is_aligned_with_a_scene_to_a_tenth_of_a_pixel(truth, views, ball, seed, size):
    view = views[seed]
    camera = aligned(truth, off(view, motion(seed, size)), None, 0.2)
    assert apart([camera], [view.camera], ball[0]) < 0.1
    assert view_psnr(truth, view._replace(camera=camera), None) > 40.0
    assert all(parameter.grad is None for parameter in truth.parameters())


def test_a_view_of_nothing_stays_where_it_is(truth, views):
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).double() @ views[0].camera.viewmat.double()
    view = views[0]._replace(camera=views[0].camera.posed(away))
    assert torch.equal(aligned(truth, view, None, 0.2).viewmat, view.camera.viewmat)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_gradient_that_is_not_finite_moves_nothing(truth, views, bad):
    output = truth.render(views[0].camera)
    output.rgb.sum().backward()
    truth.zero_grad(set_to_none=True)
    gradient = torch.tensor([0, 1, 0, bad, 0, 0], dtype=torch.float64)
    assert pose_step(gradient, output.projection, 0.5).tolist() == [0.0] * 6
    huge = pose_step(torch.full((6,), 1e30, dtype=torch.float64), output.projection, 0.5)
    assert apart([off(views[0], huge).camera], [views[0].camera], truth.surfels["means"].detach()) < 1.0


@pytest.mark.parametrize(("count", "free"), [(1, 6), (2, 7), (6, 7)])
def test_what_moves_all_cameras_is_a_basis(cameras, count, free):
    centers = torch.stack([camera.exact_center for camera in cameras[:count]])
    basis = gauge(centers, 3.0)
    assert basis.shape[1] <= free
    torch.testing.assert_close(basis.T @ basis, torch.eye(basis.shape[1], dtype=torch.float64))


def test_training_finds_the_poses_and_leaves_the_world_where_it_is(ring, ball):
    right, wrong = ring
    found = {}
    for kind in ("off", "on"):
        trainer = advanced(Trainer(scene_of(ball, right), wrong, options(kind), 320), 320)
        poses = trainer.training.poses
        there = [poses.of(i, view.camera) for i, view in enumerate(wrong)]
        views = [view._replace(camera=camera) for view, camera in zip(wrong, there, strict=True)]
        cameras = [view.camera for view in right]
        found[kind] = evaluate(trainer.scene, views, options(kind)).psnr, apart(there, cameras, ball[0])
    assert found["on"][0] > found["off"][0] + 3.0
    assert found["on"][1] < 0.5 * found["off"][1]
    unit = torch.tensor([1.0] * 3 + [1.0 / trainer.training.schedule.extent] * 3, dtype=torch.float64)
    assert (poses._gauge.T @ (poses.motions * unit).flatten()).abs().max() < 1e-9


def test_cameras_are_carried_along_with_their_neighbours(ring):
    right, wrong = ring
    poses = Poses(Schedule(options("on"), 60), [view.camera for view in right])
    # smooth drift of a path around the object
    x, y, z = torch.stack([view.camera.exact_center for view in right]).unbind(1)
    poses.motions = 0.01 * torch.stack([0.3 * x, 0.2 * y, 0.1 * z, y, -x, 0.5 * x], 1)
    between = look_at_origin([3 * math.cos(0.1), 3 * math.sin(0.1), 0.9])
    found = poses.carried(between)
    nearest = poses.of(0, right[0].camera)
    assert (found.center - between.center).norm() > 0.01
    shift = nearest.center - right[0].camera.center
    torch.testing.assert_close(found.center - between.center, shift, atol=0.01, rtol=0)
    same = poses.carried(right[5].camera)
    torch.testing.assert_close(same.viewmat, poses.of(5, right[5].camera).viewmat, atol=1e-4, rtol=0)
    still = Poses(Schedule(options("off"), 60), [view.camera for view in right])
    assert still.carried(between) is between


def test_poses_stay_before_and_after_their_part(make_scene, wrong):
    config = options("on", poses=PoseConfig(start=6000, stop=15_000))
    trainer = Trainer(make_scene(texture=False), wrong, config, 40)
    seen = []
    while trainer.step < 40:
        trainer.advance()
        seen.append(trainer.training.poses.motions)
    assert not seen[7].any() and seen[8].any()
    assert not torch.equal(seen[18], seen[19]) and all(torch.equal(seen[19], later) for later in seen[20:])


def test_a_run_that_refines_no_further_keeps_the_poses(make_scene, wrong):
    state = state_of(advanced(Trainer(make_scene(texture=False), wrong, options("on"), 60), 30))
    assert state["training"]["poses"]["motions"].any()
    fixed = Trainer(make_scene(texture=False), wrong, options("off"), 60)
    resume(fixed, state)
    fixed.advance()
    assert torch.equal(fixed.training.poses.motions, state["training"]["poses"]["motions"])


def test_poses_of_other_photographs_are_left(cameras):
    schedule = Schedule(options("on"), 60)
    state = Poses(schedule, cameras[:3]).state_dict()
    poses = Poses(schedule, cameras)
    poses.load_state_dict(state)
    assert len(poses.motions) == len(cameras)
    poses.load_state_dict(None)
    assert len(poses.motions) == len(cameras)


def test_a_step_of_several_views_moves_each(truth, views, wrong):
    schedule = Schedule(replace(options("on"), poses=PoseConfig(start=0)), 60)
    poses, outputs = Poses(schedule, [view.camera for view in wrong]), []
    for i in (1, 4):
        output = truth.render(poses.learning(i, wrong[i].camera, 0))
        (output.rgb - views[i].image).abs().mean().backward()
        outputs.append(output.projection)
    truth.zero_grad(set_to_none=True)
    poses.step(outputs, 0.5, ALONE)
    sizes = poses.motions.norm(dim=1)
    assert set(sizes.topk(2).indices.tolist()) == {1, 4}


def test_train_scene_returns_the_cameras_and_judges_twice(views, wrong, ball):
    scene, log = train_scene(wrong[1:], *ball, steps=60, eval_views=wrong[:1], refine_poses="on")
    last = log.entries[-1]
    assert last.refined_psnr > last.psnr and not math.isnan(last.carried_psnr)
    assert [torch.equal(a.viewmat, b.camera.viewmat) for a, b in zip(log.cameras, wrong[1:], strict=True)] == [
        False
    ] * 5
    _, log = train_scene(wrong[1:], *ball, steps=20, eval_views=wrong[:1])
    assert math.isnan(log.entries[-1].refined_psnr)
    assert all(a is b.camera for a, b in zip(log.cameras, wrong[1:], strict=True))
