"""Operations report devices for which they have no kernel."""

import pytest
import torch

from bitymi_ns.ops import baked, trace_cpu, trace_cuda
from bitymi_ns.ops.backend import emulated_cuda, kernel, module
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from tests.cuda.baked_scenes import front
from tests.cuda.conftest import why_not_emulated
from tests.ops.golden import camera_of, random_scene, traced

emulated = pytest.mark.skipif(why_not_emulated() is not None, reason=str(why_not_emulated()))


@emulated
def test_the_tracers_refuse_each_others_tensors() -> None:
    case = random_scene(5, 1, width=24, height=20)
    _, projection = traced(case, [case.params[name] for name in GEOMETRY])
    geom = projection.geom.detach()
    with pytest.raises(RuntimeError, match="there is no kernel bin_count_f64 for tensors on 'cpu': move them"):
        trace_cuda.find_fragments(geom, projection)
    with emulated_cuda():
        with pytest.raises(RuntimeError, match="there is no kernel Trace_f64 for tensors on 'cpu'"):
            trace_cpu.find_fragments(geom, projection)
        with pytest.raises(RuntimeError, match="there is no kernel Trace_f64"):
            trace_cpu.count(projection)
        with pytest.raises(RuntimeError, match="there is no kernel baked_forward_f64 for tensors on 'cpu'"):
            kernel("baked_forward", geom.double())


def test_an_image_that_the_cpu_does_not_draw_is_named() -> None:
    scene = BakedScene({}, "sv", torch.zeros(0, 5, dtype=torch.int32))
    with pytest.raises(ValueError, match="'packed' is drawn on a CUDA device only: draw rgb and alpha"):
        baked.draw(scene, [front()], None, ("packed",))
    with pytest.raises(ValueError, match="no image 'colour'"):
        baked.draw(scene, [front()], None, ("colour",))
    with pytest.raises(ValueError, match="one size"):
        baked.draw(scene, [], None, ("rgb",))


def test_views_are_drawn_together_on_the_cpu_as_well() -> None:
    case = random_scene(20, 3, width=24, height=20)
    scene = BakedScene(case.params, "sv", torch.zeros(20, 5, dtype=torch.int32))
    camera = camera_of(case, torch.float64)
    moved = Camera(camera.viewmat + 0.1 * torch.eye(4, dtype=torch.float64)[:, [3]], camera.K, 24, 20)
    together = baked.draw(scene, [camera, moved], None, ("rgb", "depth", "overdraw"))
    for view, drawn in enumerate((camera, moved)):
        alone = baked.draw(scene, [drawn], None, ("rgb", "depth", "overdraw"))
        for name, image in alone.items():
            assert image.shape[:3] == (1, 20, 24) and torch.equal(together[name][view], image[0]), name


def test_a_device_without_kernels_is_named() -> None:
    with pytest.raises(RuntimeError, match="no kernels for device 'meta'"):
        module(torch.device("meta"))
