"""A training view by one function on CUDA, against the CPU's renders and losses."""

import math
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from bitymi_ns import ops
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.ops.texel import TexelDescent
from bitymi_ns.ops.training_view import ComparedView, PhotographTarget, training_view
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.scene import Camera, Scene, SceneConfig
from bitymi_ns.scene.field import TexelField
from bitymi_ns.train.config import TexelConfig, TrainConfig
from bitymi_ns.train.divergence import LossWatch
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.step import view_losses, with_dropout
from bitymi_ns.train.views import View
from tests.ops.golden import SceneCase, random_scene
from tests.train.part_of_a_run import advanced

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 37, 21
CORRECTIONS = {
    "none": None,
    "gains": [1.2, 0.8, 1.1],
    "affine": [[1.1, 0.1, 0.0, 0.02], [0.0, 0.9, -0.1, 0.0], [0.05, 0.0, 1.0, -0.03]],
}


def scene_of(case: SceneCase, kind: str, texture: str) -> Scene:
    """Build a float64 scene with view colours of a kind and tiles of random texels."""
    g = torch.Generator().manual_seed(4)
    n = len(case.params["means"])
    config = SceneConfig(view_color=kind, weight_bound=0.02, near=0.2)
    colors = VIEW_COLORS[kind].first_values(torch.rand(n, 3, generator=g) - 0.5, config, g)
    colors = {name: value + 0.3 * torch.randn(value.shape, generator=g) for name, value in colors.items()}
    params = {name: value.double() for name, value in ({name: case.params[name] for name in GEOMETRY} | colors).items()}
    field = None
    if texture != "none":
        size = torch.randint(1, 6, (n, 2), generator=g)
        count = int(size.prod(1).sum())
        texels, share = 0.2 * torch.randn(count, 3, generator=g), torch.rand(count, generator=g).double()
        alphas = 0.5 + torch.rand(count, generator=g).double() if texture == "alpha" else None
        field = TexelField(size, 1.0 + torch.rand(n, generator=g).double(), texels.double(), share, alphas)
    return Scene(config, params, field)


def compared(
    device: torch.device,
    kind: str = "sv",
    texture: str = "none",
    correction: str = "none",
    shown: float = 1.0,
    weights: tuple[float, float] = (2.0, 3.0),
    background: str = "black",
    dropout: float = 0.0,
) -> dict[str, Tensor]:
    """Compute the losses of a view, their gradients, texels after it and the statistics of the projection."""
    case = random_scene(30, 5, WIDTH, HEIGHT)
    scene = scene_of(case, kind, texture).to(device)
    descent = TexelDescent(scene.field.share, 0.7) if texture == "moved" else None
    g = torch.Generator().manual_seed(7)
    photo = torch.rand(HEIGHT, WIDTH, 3, generator=g).double().to(device)
    mask = (torch.rand(HEIGHT, WIDTH, generator=g) < shown).to(device) if shown < 1.0 else None
    if mask is not None:
        photo[~mask] = math.nan
    values = CORRECTIONS[correction]
    gains = None if values is None else torch.tensor(values, dtype=torch.float64, device=device).requires_grad_()
    pose = case.viewmat.double().to(device).requires_grad_()
    camera = Camera(case.viewmat.double(), case.K.double(), WIDTH, HEIGHT).to(device).posed(pose)
    config = TrainConfig(background=background, freeze_after=0, freeze_every=2, freeze_min_updates=1)
    schedule = Schedule(config, 100)
    step = 1 if texture == "frozen" else 2
    how = {"descent": descent, "dropout": dropout}
    with mock.patch("bitymi_ns.train.step.with_dropout", _dropout_of_the_cpu):  # random numbers depend on the device
        terms, output = view_losses(scene, View(camera, photo, mask, gains), schedule, step, LossWatch(), **how)
    weighted = zip(weights, (terms["photometric"], terms["falloff"]), strict=True)
    sum(weight * term for weight, term in weighted if weight).backward()
    assert isinstance(output, ComparedView) == ops.can_rasterize(device)
    found = {f"gradient of {name}": p.grad for name, p in scene.named_parameters() if p.grad is not None}
    found |= dict(terms) | {"gradient of the pose": pose.grad}
    if gains is not None:
        found["gradient of the correction"] = gains.grad
    if scene.field is not None:
        found["texels"] = scene.field.texels
    found |= {name: getattr(output.projection, name) for name in ("mean2d_grad", "mean2d_absgrad", "visible", "broken")}
    return {name: value.detach().cpu().double() for name, value in found.items()}


def _dropout_of_the_cpu(logits: Tensor, *how: Any) -> Tensor:
    return with_dropout(logits.cpu(), *how).to(logits.device)


CASES = [
    *({"kind": kind} for kind in VIEW_COLORS),
    *({"texture": texture} for texture in ("texels", "moved", "alpha", "frozen")),
    *({"correction": correction, "background": "white"} for correction in ("gains", "affine")),
    {"correction": "affine", "shown": 0.7, "texture": "moved", "background": "random"},
    {"shown": 0.7, "texture": "alpha", "correction": "gains", "dropout": 0.3},
    {"shown": 0.0, "texture": "texels"},
    *({"weights": weights, "texture": "alpha"} for weights in ((1.0, 0.0), (0.0, 1.0))),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(f"{value}" for value in case.values()))
def test_losses_and_gradients_equal_those_of_the_cpu(case: dict[str, Any], both) -> None:
    got, want = both(lambda where: compared(where, **case))
    assert got.keys() == want.keys() and ("gradient of field.texels" in want) == (
        case.get("texture") in ("texels", "alpha")
    )
    for name, value in want.items():
        assert (got[name] - value).abs().max() <= 1e-9 * value.abs().max(), name


def test_single_precision_is_near(device: torch.device, cpu, monkeypatch: pytest.MonkeyPatch) -> None:
    def single() -> Tensor:
        scene = scene_of(random_scene(30, 5, WIDTH, HEIGHT), "sv", "texels").float().to(device)
        case = random_scene(30, 5, WIDTH, HEIGHT)
        camera = Camera(case.viewmat.float(), case.K.float(), WIDTH, HEIGHT).to(device)
        photo = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(7)).to(device)
        terms, _ = view_losses(scene, View(camera, photo), Schedule(TrainConfig(), 100), 0, LossWatch())
        sum(terms.values()).backward()
        return torch.cat([p.grad.flatten().cpu() for p in scene.parameters()])

    got = single()
    monkeypatch.setattr(Scene, "compare", lambda *_: None)
    assert (got - single()).abs().max() < 1e-5 * got.abs().max()


def test_a_view_without_surfels_or_texels_in_it(device: torch.device) -> None:
    case = random_scene(5, 5, WIDTH, HEIGHT)
    scene = scene_of(case, "sv", "texels").to(device)
    with torch.no_grad():
        scene.surfels["means"] -= 1e6 * case.viewmat[2, :3].double().to(device)  # behind the camera
    camera = Camera(case.viewmat.double(), case.K.double(), WIDTH, HEIGHT).to(device)
    photo = torch.rand(HEIGHT, WIDTH, 3).double().to(device)
    terms, output = view_losses(scene, View(camera, photo), Schedule(TrainConfig(), 100), 0, LossWatch())
    sum(terms.values()).backward()
    assert terms["photometric"] > 0 and all(p.grad.isfinite().all() for p in scene.parameters())
    assert not output.projection.mean2d_absgrad.any()


def test_wrong_arguments_are_named(device: torch.device) -> None:
    case = random_scene(5, 5, WIDTH, HEIGHT)
    scene = scene_of(case, "sv", "alpha").to(device)
    camera = Camera(case.viewmat.double(), case.K.double(), WIDTH, HEIGHT).to(device)
    photo = torch.rand(HEIGHT, WIDTH, 3).double().to(device)

    def call(target: Tensor = photo, correction: Tensor | None = None, **options: Any) -> None:
        photograph = PhotographTarget(target, None, None, 0.2, 0.5, 4.0)
        training_view("sv", scene.surfels, camera, photograph, correction, **options)

    with pytest.raises(ValueError, match="the photograph"):
        call(photo[1:])
    with pytest.raises(ValueError, match="3 or 12 numbers"):
        call(correction=photo.new_ones(4))
    texture, alpha = scene.field.texture(0.0, True), scene.field.opacity(0.0, True)
    others = replace(alpha.tiles, first=alpha.tiles.first.clone())
    with pytest.raises(ValueError, match="other tiles"):
        call(alpha=replace(alpha, tiles=others), **texture)
    with pytest.raises(ValueError, match="view_colour|view colour"):
        training_view("none", scene.surfels, camera, PhotographTarget(photo, None, None, 0.2, 0.5, 4.0))


class Operations(TorchDispatchMode):
    """Counter of torch's operations and of those that make the host wait."""

    def __init__(self) -> None:
        super().__init__()
        self.count = self.waits = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += 1
        self.waits += func.overloadpacket in (torch.ops.aten._local_scalar_dense, torch.ops.aten.nonzero)
        return func(*args, **(kwargs or {}))


def run(device: torch.device, **options: Any) -> Trainer:
    """Start a run whose texels begin after ten steps."""
    case = random_scene(20, 5, WIDTH, HEIGHT, scale=0.5)
    scene = Scene(SceneConfig(texture="texels", near=0.2), {k: v.float() for k, v in case.params.items()}, None)
    camera = Camera(case.viewmat.float(), case.K.float(), WIDTH, HEIGHT)
    photo = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(7))
    texels = TexelConfig(start=10, pixels_per_texel=0.5)
    config = TrainConfig(texels=texels, resolution_schedule=0, background="black", **options)
    return Trainer(scene.to(device), [View(camera, photo)] * 8, config, 30_000)


def test_a_run_goes_on_by_lists_and_back(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters, Adam's state, statistics and exposures mean the same to both ways."""
    straight, changing = run(device, exposure="gain"), run(device, exposure="gain")
    for step in range(16):
        _, output, _ = straight.advance()
        assert isinstance(output, ComparedView)
        with monkeypatch.context() as patch:
            if step % 8 < 4:
                patch.setattr(Scene, "compare", lambda *_: None)
            _, output, _ = changing.advance()
            assert isinstance(output, ComparedView) == (step % 8 >= 4)
        assert changing.loss == pytest.approx(straight.loss, rel=1e-4)
    exposures = (trainer.training.exposure.table for trainer in (changing, straight))
    torch.testing.assert_close(*exposures, rtol=1e-3, atol=1e-5)
    found, want = (trainer.training.strategy.statistics for trainer in (changing, straight))
    torch.testing.assert_close(found, want, rtol=0.02, atol=1e-4)


@pytest.mark.parametrize("exposure", ["off", "gain", "affine"])
def test_a_step_makes_few_operations_and_waits_for_the_pairs_alone(exposure: str, device: torch.device) -> None:
    """On a card the host takes 10 to 20 us for each; allocations and views are counted, too."""
    trainer = run(device, exposure=exposure)
    advanced(trainer, 13)  # creates optimisers' states and tiles
    assert isinstance(trainer.scene.field, TexelField)
    with Operations() as counted:
        advanced(trainer, 5)
    assert counted.count <= 5 * 90
    if device.type == "cuda":
        assert counted.waits == 0  # that for the pairs is the compiled module's; losses arrive later
    else:
        assert counted.waits <= 5 * 2  # losses and surfels that are not finite are read in every step
