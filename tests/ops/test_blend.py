"""Shading and blending in one pass: against separate operations, finite differences and the golden render."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops import backend
from bitymi_ns.ops.parameters import GEOMETRY
from tests.ops.golden import (
    SceneCase,
    camera_of,
    composite_colors,
    load_golden,
    random_scene,
    reference_colors,
    values_of,
)
from tests.ops.test_texel import textures

BOUND = 0.03


class View:
    """A view of a random scene with all parameters as leaves."""

    def __init__(
        self,
        case: SceneCase,
        dtype: torch.dtype,
        textured: bool,
        learns: bool = True,
        device: torch.device | str = "cpu",
        bound: float = BOUND,
    ) -> None:
        self.camera, self.bound = camera_of(case, dtype), bound
        self.base, texels, tiles = textures(len(case.params["means"]), dtype, device)
        self.leaves = [*values_of(case, dtype, device, grad=True), self.base.requires_grad_()]
        self.given: dict[str, Tensor | ops.TexelTiles] = {}
        if textured:
            self.given = {"texels": texels.requires_grad_(learns), "tiles": tiles}
            if learns:
                self.leaves.append(texels)

    def fragments(self) -> tuple[ops.Fragments, ops.Projection]:
        projection = ops.project(*self.leaves[: len(GEOMETRY)], self.camera)
        return ops.trace(projection), projection

    def image(self, maps: bool = False, moves: bool = True, descent: ops.TexelDescent | None = None) -> Tensor:
        fragments, projection = self.fragments()
        options = {"bound": self.bound, "move_surfels": moves, "descent": descent} if self.given else {}
        return ops.blended_image(fragments, projection, self.base, **self.given, **options, maps=maps)

    def one_by_one(self, maps: bool = False, moves: bool = True) -> Tensor:
        fragments, projection = self.fragments()
        if self.given:
            listed = fragments if moves else replace(fragments, uv=fragments.uv.detach())
            colors = reference_colors(listed, self.base, **self.given, bound=self.bound)
        else:
            colors = (self.base + 0.5).relu()[fragments.surfel.long()]
        return composite_colors(fragments, projection, colors, maps)

    def gradients(self, image: Tensor) -> list[Tensor]:
        towards = torch.linspace(-1, 1, image.numel(), dtype=torch.float64).view_as(image).to(image)
        return list(torch.autograd.grad(image, self.leaves, towards, allow_unused=True, materialize_grads=True))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
@pytest.mark.parametrize("maps", [False, True], ids=["image", "maps"])
@pytest.mark.parametrize("bound, moves", [(None, True), (BOUND, True), (BOUND, False), (0.0, True), (2.0, True)])
def test_it_is_shading_and_compositing(bound: float | None, moves: bool, maps: bool, dtype: torch.dtype) -> None:
    view = View(random_scene(60, 3, width=70, height=40), dtype, bound is not None, bound=bound or 0.0)
    got, want = view.image(maps, moves), view.one_by_one(maps, moves)
    assert got.shape == (70 * 40, 9 if maps else 5)
    tolerance = 1e-11 if dtype == torch.float64 else 2e-4
    torch.testing.assert_close(got, want, rtol=0.01 * tolerance, atol=0.01 * tolerance)
    for mine, theirs in zip(view.gradients(got), view.gradients(want), strict=True):
        assert theirs.abs().max() > 1e-3 or bound == 2.0  # nothing has a residual
        torch.testing.assert_close(mine, theirs, rtol=tolerance, atol=tolerance * float(theirs.abs().max()))


def test_a_descent_moves_the_texels_by_their_gradient() -> None:
    case = random_scene(60, 3, width=70, height=40)
    learning, moving = View(case, torch.float64, True), View(case, torch.float64, True, learns=False)
    *surfels, dtexels = learning.gradients(learning.image())
    texels = moving.given["texels"]
    before, share = texels.clone(), torch.linspace(0.1, 2.0, len(texels), dtype=torch.float64)
    moved = moving.gradients(moving.image(descent=ops.TexelDescent(share, 0.3)))
    assert all(torch.equal(a, b) for a, b in zip(moved, surfels, strict=True))  # from the texels before the step
    torch.testing.assert_close(texels, before - 0.3 * share[:, None] * dtexels, rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match="ask for no gradient"):
        learning.image(descent=ops.TexelDescent(share, 0.3))


@pytest.mark.parametrize("textured", [False, True], ids=["surfels", "texels"])
def test_gradients_by_finite_differences(textured: bool) -> None:
    view = View(random_scene(6, 5, width=12, height=9, scale=0.4), torch.float64, textured)
    with torch.no_grad():
        fragments, projection = view.fragments()
    leaves = [fragments.weight, fragments.depth, view.base]
    leaves += [view.given["texels"]] if textured else []
    leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]

    def image(weight: Tensor, depth: Tensor, base: Tensor, *texels: Tensor) -> Tensor:
        given = {"texels": texels[0], "tiles": view.given["tiles"]} if texels else {}
        listed = replace(fragments, weight=weight, depth=depth)
        return ops.blended_image(listed, projection, base, **given, maps=True)

    assert torch.autograd.gradcheck(image, leaves)


def check_golden(draw: Callable[..., Tensor], device: torch.device | str = "cpu") -> None:
    """Check a function's picture of the textured scene, and the gradients of its texels, against the golden file."""
    golden = load_golden("textured")
    sizes = torch.tensor([[tile.shape[1], tile.shape[0]] for tile in golden.tiles], device=device)
    tiles = ops.TexelTiles.of_sizes(sizes, torch.full((len(sizes),), 3.0, dtype=torch.float64, device=device))
    texels = torch.cat([tile.reshape(-1, 3) for tile in golden.tiles]).to(device).requires_grad_()
    params, camera = {name: value.to(device) for name, value in golden.params.items()}, camera_of(golden)
    base = ops.view_color("sv", params, params["means"], camera.center.to(device))
    image = draw(ops.project(*(params[key] for key in GEOMETRY), camera), base, texels, tiles).cpu()
    rgb = image[:, :3].view_as(golden.outputs["rgb"])
    alpha = image[:, 3:4].view(*rgb.shape[:2], 1)
    torch.testing.assert_close(rgb + (1 - alpha) * golden.background, golden.outputs["rgb"], rtol=1e-11, atol=1e-12)
    (rgb * golden.loss_weights["rgb"]).sum().backward()
    want = torch.cat([grad.reshape(-1, 3) for grad in golden.tile_grads])
    torch.testing.assert_close(texels.grad.cpu(), want, rtol=1e-9, atol=1e-12)


def test_the_golden_image_and_the_gradients_of_its_texels() -> None:
    check_golden(lambda projection, *given: ops.blended_image(ops.trace(projection), projection, *given))


@pytest.mark.parametrize("textured", [False, True], ids=["surfels", "texels"])
def test_threads_do_not_change_the_sums(textured: bool) -> None:
    view = View(random_scene(300, 3, width=150, height=90), torch.float32, textured)
    with torch.no_grad():
        fragments, projection = view.fragments()
    results = []
    for threads in (1, 2, 3, 7):
        backend.module(torch.device("cpu")).set_num_threads(threads)
        leaves = [view.base, projection.geom.requires_grad_(), fragments.weight.requires_grad_()]
        leaves += [fragments.uv.requires_grad_(), view.given["texels"]] if textured else []
        image = ops.blended_image(fragments, projection, view.base, **view.given, maps=True)
        results.append([image, *torch.autograd.grad(image.square().sum(), leaves)])
    backend.module(torch.device("cpu")).set_num_threads(0)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(other, results[0], strict=True))


@pytest.mark.parametrize("textured", [False, True], ids=["surfels", "texels"])
def test_a_view_that_shows_nothing(textured: bool) -> None:
    case = random_scene(60, 3, width=70, height=40)
    case.params["opacity_logits"].fill_(-20)
    view = View(case, torch.float32, textured)
    image = view.image(maps=True)
    assert not image.any() and not any(gradient.any() for gradient in view.gradients(image))


def test_what_does_not_fit_is_refused() -> None:
    view = View(random_scene(60, 3, width=70, height=40), torch.float32, True)
    fragments, projection = view.fragments()
    with pytest.raises(ValueError, match="the tiles hold"):
        ops.blended_image(fragments, projection, view.base, view.given["texels"][1:], view.given["tiles"])
    with pytest.raises(ValueError, match="base must have shape"):
        ops.blended_image(fragments, projection, view.base[1:])
    rho = torch.zeros(len(fragments), 3)
    with pytest.raises(ValueError, match="residual must have shape"):
        ops.blended_image(fragments, projection, view.base, residual=rho[1:])
    with pytest.raises(ValueError, match="of texels or of fragments"):
        ops.blended_image(fragments, projection, view.base, **view.given, residual=rho)
    with pytest.raises(ValueError, match="fragments are those of 61 surfels, not of 60"):
        ops.blended_image(replace(fragments, surfels=61), projection, view.base, **view.given)
