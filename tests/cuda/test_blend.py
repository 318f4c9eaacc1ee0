"""Shading and blending in one pass on CUDA, against the CPU, in any thread order."""

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.measure.stability.scenes import extreme_scenes
from tests.cuda.conftest import in_orders
from tests.ops.golden import SceneCase, random_scene
from tests.ops.test_blend import View
from tests.ops.test_kernels import relative

pytestmark = pytest.mark.slow


def run(
    case: SceneCase, device: torch.device, dtype: torch.dtype, textured: bool, maps: bool = True, moves: bool = True
) -> list[Tensor]:
    """Compute a picture and all gradients, on the CPU in double."""
    view = View(case, dtype, textured, device=device)
    image = view.image(maps, moves)
    return [t.detach().cpu().double() for t in (image, *view.gradients(image))]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
@pytest.mark.parametrize("maps", [False, True], ids=["image", "maps"])
@pytest.mark.parametrize("textured, moves", [(False, True), (True, True), (True, False)])
def test_pictures_and_gradients_are_those_of_the_cpu(
    textured: bool, moves: bool, maps: bool, dtype: torch.dtype, cpu, both
) -> None:
    """Tiles with more fragments than shared memory holds and more than 32 surfels; the image ends within one."""
    case = random_scene(150, 3, width=70, height=40)
    got, want = both(lambda where: run(case, where, dtype, textured, maps, moves))
    with cpu():
        fragments, _ = View(case, dtype, textured).fragments()
    assert fragments.layout.arrays["tile_start"].diff().max() > 2048
    for mine, cpus in zip(got, want, strict=True):
        assert relative(mine, cpus) < (1e-10 if dtype == torch.float64 else 3e-4)


@pytest.mark.parametrize("scene", extreme_scenes(), ids=lambda case: case.name)
def test_extreme_scenes(scene: SceneCase, device: torch.device) -> None:
    """Compare with shading and compositing in sequence; on the CPU the normal of an edge-on surfel may have the other
    sign."""
    view = View(scene, torch.float64, True, device=device)
    image, wanted = view.image(maps=True), view.one_by_one(maps=True)
    assert relative(image, wanted) < 1e-13
    for mine, theirs in zip(view.gradients(image), view.gradients(wanted), strict=True):
        assert theirs.isfinite().all() and relative(mine, theirs) < 1e-11


@pytest.mark.parametrize("textured", [False, True], ids=["surfels", "texels"])
def test_a_view_that_shows_nothing(textured: bool, device: torch.device) -> None:
    case = random_scene(60, 3, width=70, height=40)
    case.params["opacity_logits"].fill_(-20)
    image, *gradients = run(case, device, torch.float32, textured)
    assert not image.any() and not any(gradient.any() for gradient in gradients)


def moved(case: SceneCase, device: torch.device, dtype: torch.dtype) -> list[Tensor]:
    """Compute texels after a descent and all gradients, on the CPU."""
    view = View(case, dtype, True, learns=False, device=device)
    share = torch.linspace(0.1, 2.0, len(view.given["texels"]), dtype=dtype, device=device)
    gradients = view.gradients(view.image(descent=ops.TexelDescent(share, 0.3)))
    return [t.detach().cpu() for t in (view.given["texels"], *gradients)]


def test_a_descent_moves_the_texels_as_on_the_cpu(both) -> None:
    case = random_scene(60, 3, width=70, height=40)
    got, want = both(lambda where: moved(case, where, torch.float64))
    before = View(case, torch.float64, True).given["texels"]
    assert not torch.equal(want[0], before)
    assert all(relative(mine, cpus) < 1e-10 for mine, cpus in zip(got, want, strict=True))


def test_only_sums_of_texels_depend_on_the_order_of_threads(device: torch.device, exactly) -> None:
    """And not even they with deterministic algorithms."""
    case = random_scene(60, 3, width=70, height=40)
    exact = in_orders(device, lambda: [*run(case, device, torch.float32, True), *moved(case, device, torch.float32)])
    torch.use_deterministic_algorithms(False)
    for runs in (exact, in_orders(device, lambda: run(case, device, torch.float32, True)[:-1])):
        assert all(torch.equal(a, b) for other in runs[1:] for a, b in zip(runs[0], other, strict=True))


@pytest.mark.parametrize("exact", [False, True])
def test_a_gradient_that_is_not_finite_is_not_hidden(exact: bool, device: torch.device) -> None:
    view = View(random_scene(60, 3, width=70, height=40), torch.float32, True, device=device)
    image = view.image()
    towards = torch.ones_like(image)
    towards[int(image[:, 3].argmax()), 0] = float("nan")
    torch.use_deterministic_algorithms(exact)
    try:
        *_, base, texels = torch.autograd.grad(image, view.leaves, towards)
    finally:
        torch.use_deterministic_algorithms(False)
    assert base.isnan().any() and texels.isnan().any()


def test_nothing_of_the_size_of_the_list_is_kept_for_the_colours(device: torch.device) -> None:
    view = View(random_scene(60, 3, width=70, height=40), torch.float32, True, device=device)
    fragments, projection = view.fragments()
    kept = set()

    def note(t: Tensor) -> Tensor:
        kept.add(tuple(t.shape))
        return t

    with torch.autograd.graph.saved_tensors_hooks(note, lambda t: t):
        image = ops.blended_image(fragments, projection, view.base, **view.given, bound=0.03)
    assert (2, len(fragments)) in kept and (len(fragments), 3) not in kept and image.requires_grad
