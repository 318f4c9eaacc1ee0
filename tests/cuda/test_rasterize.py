"""Pictures without fragment lists: values and gradients against lists, in any thread order."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import bitymi_ns
from bitymi_ns import ops
from bitymi_ns.measure.stability.scenes import extreme_scenes
from bitymi_ns.ops import Unlisted
from bitymi_ns.ops.parameters import GEOMETRY
from tests.cuda.conftest import HERE, in_orders, only_short_lists
from tests.ops.golden import SceneCase, camera_of, random_scene
from tests.ops.test_blend import check_golden
from tests.ops.test_kernels import relative
from tests.ops.test_texel import SIZES
from tests.scene.test_texel_field import make
from tests.test_api import camera_of as api_camera
from tests.test_api import surfels

BOUND = 0.03


class Learned:
    """Surfels with view colours and optional colour and alpha texels, as leaves of a graph.

    Args:
        case: geometry and camera.
        texture: none, colors or alphas.
        extreme: alphas of 0, of 2, of 1 and far below it, and extents that end within the support.
        moved: the backward pass moves the texels.
    """

    def __init__(
        self,
        case: SceneCase,
        dtype: torch.dtype,
        device: torch.device,
        texture: str = "alphas",
        extreme: bool = False,
        moved: bool = False,
    ) -> None:
        n, g = len(case.params["means"]), torch.Generator().manual_seed(len(case.params["means"]))
        self.camera = camera_of(case, dtype)
        self.leaves = {name: case.params[name].to(device, dtype).clone().requires_grad_() for name in GEOMETRY}
        self.base = (torch.rand(n, 3, generator=g, dtype=torch.float64) * 1.4 - 0.9).to(device, dtype)
        self.leaves["base"] = self.base.requires_grad_()
        self.texture: dict = {}
        self.alpha: ops.TexelAlpha | None = None
        if texture == "none":
            return
        size = torch.tensor(SIZES, dtype=torch.int32).repeat(n // len(SIZES) + 1, 1)[:n].to(device)
        extent = 1 + 2 * torch.rand(n, generator=g, dtype=torch.float64)
        extent[::2] *= 0.1 if extreme else 1.0
        tiles = ops.TexelTiles.of_sizes(size, extent.to(device, dtype))
        texels = (torch.rand(tiles.count, 3, generator=g, dtype=torch.float64) * 1.2 - 0.6).to(device, dtype)
        self.texture = {"texels": texels, "tiles": tiles, "bound": BOUND}
        if moved:
            share = torch.linspace(0.1, 2.0, len(texels), dtype=dtype, device=device)
            self.texture["descent"] = ops.TexelDescent(share, 0.3)
        else:
            self.leaves["texels"] = texels.requires_grad_()
        if texture == "alphas":
            values = 2 * torch.rand(tiles.count, generator=g, dtype=torch.float64)
            if extreme:
                few = torch.tensor([0.0, 2.0, 1.0, 1e-3, 1e-30], dtype=torch.float64)
                values = few[torch.randint(len(few), (tiles.count,), generator=g)]
            self.leaves["alphas"] = values.to(device, dtype).requires_grad_()
            self.alpha = ops.TexelAlpha(tiles, self.leaves["alphas"], BOUND)

    def draw(self, listed: bool, moves: bool = True, maps: bool = False) -> dict[str, Tensor]:
        """Compute the picture, all gradients of a sum over it, and the texels afterwards."""
        projection = ops.project(*(self.leaves[name] for name in GEOMETRY), self.camera)
        projection.alpha = self.alpha
        how = {**self.texture, "move_surfels": moves, "maps": maps}
        if listed:
            image = ops.blended_image(ops.trace(projection), projection, self.base, **how)
        else:
            image, _ = ops.rasterize_image(projection, self.base, **how)
        towards = torch.linspace(-1, 1, image.numel(), dtype=torch.float64).view_as(image).to(image)
        gradients = torch.autograd.grad(image, list(self.leaves.values()), towards, allow_unused=True)
        found = {"image": image.detach(), "centres": projection.mean2d_grad, "absolute": projection.mean2d_absgrad}
        found |= dict(zip(self.leaves, gradients, strict=True))
        if "descent" in self.texture:
            found["moved"] = self.texture["texels"]
        return {name: value.detach().cpu().double() for name, value in found.items()}


def compare(got: dict[str, Tensor], want: dict[str, Tensor], tolerance: float) -> None:
    assert got.keys() == want.keys()
    for name, value in want.items():
        assert value.isfinite().all() and relative(got[name], value) < tolerance, name


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
@pytest.mark.parametrize("texture, moves", [("none", True), ("colors", True), ("colors", False), ("alphas", True)])
@pytest.mark.parametrize("maps", [False, True], ids=["image", "maps"])
def test_pictures_and_gradients_are_those_of_the_cpu(
    texture: str, moves: bool, maps: bool, dtype: torch.dtype, device: torch.device, cpu
) -> None:
    """Tiles with more fragments than shared memory holds and more than 32 surfels; the image ends within one."""
    case = random_scene(150, 3, width=70, height=40)
    got = Learned(case, dtype, device, texture).draw(False, moves, maps)
    with cpu():
        want = Learned(case, torch.float64, HERE, texture).draw(True, moves, maps)
    compare(got, want, 1e-9 if dtype == torch.float64 else 1e-3)


def test_the_golden_picture_and_gradients(device: torch.device) -> None:
    check_golden(lambda *given: ops.rasterize_image(*given)[0], device)


@pytest.mark.slow
@pytest.mark.parametrize("moved", [False, True], ids=["gradients", "descent"])
@pytest.mark.parametrize("scene", extreme_scenes(), ids=lambda case: case.name)
def test_extreme_scenes(scene: SceneCase, moved: bool, device: torch.device, cpu) -> None:
    """Maps are compared with lists on the same device: rounding decides which side of a disc seen edge-on is shown."""
    got = Learned(scene, torch.float64, device, extreme=True, moved=moved).draw(False)
    with cpu():
        want = Learned(scene, torch.float64, HERE, extreme=True, moved=moved).draw(True)
    compare(got, want, 1e-9)
    drawn, listed = (
        Learned(scene, torch.float64, device, extreme=True).draw(by_list, maps=True) for by_list in (False, True)
    )
    compare(drawn, listed, 1e-9)


@pytest.mark.parametrize("texture", ["none", "alphas"])
@pytest.mark.parametrize("size", [(1, 1), (3, 50), (40, 2)], ids=str)
@pytest.mark.parametrize("surfels", ["none", "one behind the camera", "40 and one that is not finite"])
def test_nothing_to_see_and_pictures_smaller_than_a_tile(
    surfels: str, size: tuple[int, int], texture: str, device: torch.device, cpu
) -> None:
    case = random_scene(41, 3, *size)
    if surfels == "none":
        case.params = {name: value[:0] for name, value in case.params.items()}
    elif surfels == "one behind the camera":
        case.params = {name: value[:1] for name, value in case.params.items()}
        case.params["means"] = -case.viewmat[:3, :3].T @ (case.viewmat[:3, 3] + torch.tensor([0.0, 0.0, 5.0]).double())
        case.params["means"] = case.params["means"][None]
    else:
        case.params["means"][7, 1] = float("nan")
    got = Learned(case, torch.float64, device, texture).draw(False, maps=True)
    with cpu():
        want = Learned(case, torch.float64, HERE, texture).draw(True, maps=True)
    compare(got, want, 1e-9)
    assert got["image"].any() == surfels.startswith("40")


@pytest.mark.parametrize("opacity", [12.0, -5.0, -20.0], ids=["hides all behind", "faint", "shows nothing"])
def test_surfels_of_one_opacity(opacity: float, device: torch.device) -> None:
    """Tiles with opaque layers that hide others, or 1,000 nearly invisible ones."""
    case = random_scene(300, 8, width=20, height=20)
    case.params["opacity_logits"].fill_(opacity)
    got, want = (Learned(case, torch.float64, device).draw(listed, maps=True) for listed in (False, True))
    compare(got, want, 1e-9)
    assert got["image"].any() == (opacity > -20)


def test_only_sums_of_texels_depend_on_the_order_of_threads(device: torch.device) -> None:
    case = random_scene(60, 3, width=70, height=40)
    first, *others = in_orders(device, lambda: Learned(case, torch.float32, device).draw(False, maps=True))
    for other in others:
        for name in first.keys() - {"texels", "alphas"}:
            assert torch.equal(other[name], first[name]), name


def test_its_fragments_are_those_of_the_list(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    learned = Learned(random_scene(60, 3, width=70, height=40), torch.float64, device)
    projection = ops.project(*(learned.leaves[name] for name in GEOMETRY), learned.camera)
    projection = replace(projection, alpha=learned.alpha)
    with torch.no_grad():
        _, unlisted = ops.rasterize_image(projection, learned.base, **learned.texture)
        fragments = ops.trace(projection)
    mask = torch.arange(70 * 40, device=device) % 3 > 0
    assert isinstance(unlisted, Unlisted) and len(unlisted) == len(fragments) > 1000
    assert torch.equal(unlisted.masked_counts(mask), fragments.masked_counts(mask))
    assert torch.equal(unlisted.overdraw(), fragments.overdraw())
    assert [torch.equal(part.weight, fragments.weight) for part in unlisted.lists()] == [True]

    overdraw = fragments.overdraw()
    fit = max(int(rows.sum()) for rows in overdraw.split(16))  # fragments of a row of tiles
    only_short_lists(monkeypatch, fit, fit)
    assert len(list(unlisted.lists())) == 3 and torch.equal(unlisted.overdraw(), overdraw)


def test_it_draws_on_cards_alone_and_not_where_sums_are_exact(device: torch.device, cpu, exactly) -> None:
    assert not ops.can_rasterize(device)
    torch.use_deterministic_algorithms(False)
    learned = Learned(random_scene(6, 3, width=20, height=10), torch.float32, HERE, "none")
    assert ops.can_rasterize(device)
    with cpu(), pytest.raises(RuntimeError, match="there is no kernel bin_count_f32 for tensors on 'cpu'"):
        assert not ops.can_rasterize(HERE)
        learned.draw(False)


def test_which_pictures_of_a_scene_need_no_list(device: torch.device) -> None:
    scene, camera, _ = make(12, alpha=True, width=24, height=18)
    scene, camera = scene.to(device), camera.to(device)
    unlisted = [scene.render(camera), scene.render(camera, field_mode="frozen"), scene.render(camera, maps=True)]
    lists = [scene.render(camera, overdraw_half=0.005)]
    assert all(isinstance(output.fragments, Unlisted) for output in unlisted)
    assert all(isinstance(output.fragments, ops.Fragments) for output in lists)
    for output in (*unlisted, *lists):
        assert len(output.fragments) == len(lists[0].fragments)
        torch.testing.assert_close(output.rgb, lists[0].rgb, rtol=1e-9, atol=1e-12)
    scene.field = None
    assert isinstance(scene.render(camera).fragments, Unlisted)


def test_the_public_function_draws_maps_as_the_cpu_does(device: torch.device, cpu) -> None:
    def draw(where: torch.device) -> tuple[object, list[Tensor]]:
        values = {name: value.detach().to(where).requires_grad_() for name, value in surfels().items()}
        drawn = bitymi_ns.rasterize(**values, camera=api_camera().to(where), maps=True)
        assert drawn.depth is not None and drawn.normal is not None
        total = drawn.rgb.square().sum() + drawn.depth.square().sum() + drawn.normal[..., 0].sum()
        return drawn.fragments, [
            *torch.autograd.grad(total, list(values.values())),
            drawn.rgb,
            drawn.depth,
            drawn.normal,
        ]

    fragments, got = draw(device)
    assert isinstance(fragments, Unlisted)
    with cpu():
        _, want = draw(HERE)
    for value, expected in zip(got, want, strict=True):
        assert relative(value.cpu(), expected) < 1e-9


def test_alphas_in_other_tiles_are_refused(device: torch.device) -> None:
    learned = Learned(random_scene(6, 3, width=20, height=10), torch.float32, device)
    del learned.texture["tiles"]
    with pytest.raises(ValueError, match="in other tiles than their colours"):
        learned.draw(False)


def test_a_gradient_that_is_not_finite_is_not_hidden(device: torch.device) -> None:
    learned = Learned(random_scene(60, 3, width=70, height=40), torch.float32, device, "colors")
    projection = ops.project(*(learned.leaves[name] for name in GEOMETRY), learned.camera)
    image, _ = ops.rasterize_image(projection, learned.base, **learned.texture)
    towards = torch.ones_like(image)
    towards[int(image[:, 3].argmax()), 0] = float("nan")
    for gradient in torch.autograd.grad(image, [learned.base, learned.leaves["texels"]], towards):
        assert gradient.isnan().any()
