"""View colours keep the terms that lambda allows, and stated errors are those of the pictures."""

from dataclasses import replace

import pytest
import torch

from bitymi_ns.bake.view_color_rate import color_choices, shown_weights
from bitymi_ns.ops.view_color import check_lean
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.scene.baked import BakedScene
from tests.bake.test_tune import BACKGROUND, photographs, waving
from tests.ops.test_view_color import lean_parameters

COUNT = 60


@pytest.fixture(scope="module")
def cameras(scene) -> list:
    return [view.camera for view in photographs(waving(scene(COUNT)))]


@pytest.fixture
def colored(scene):
    """The scene with stored view colours of a kind."""

    def make(kind: str) -> BakedScene:
        plain = waving(scene(COUNT)).unquantised()
        names = {name for entry in VIEW_COLORS.values() for name in entry.names}
        kept = {name: value for name, value in plain.surfels.items() if name not in names}
        kept = {name: value for name, value in kept.items() if not name.startswith("view_")}
        return replace(plain, surfels=kept | lean_parameters(kind, COUNT, torch.float32), view_color=kind)

    return make


def with_colors(scene: BakedScene, colors: dict[str, torch.Tensor]) -> BakedScene:
    return replace(scene, surfels={**scene.surfels, **colors})


@pytest.mark.parametrize("kind", sorted(VIEW_COLORS))
def test_the_price_decides_from_all_terms_to_none(colored, cameras, kind: str) -> None:
    scene = colored(kind)
    choices = color_choices(scene, cameras)
    counts = []
    for price in (0.0, 1e-4, 1e-2, 1e6):
        colors = choices.at(price)
        check_lean(kind, colors, COUNT)
        counts.append(len(colors["view_terms"]))
        assert with_colors(scene, colors).render(cameras[0], BACKGROUND).rgb.isfinite().all()
    assert counts == sorted(counts, reverse=True) and counts[-1] == 0
    assert counts[0] <= len(scene.surfels["view_terms"])


def test_weights_are_those_of_the_fragments(colored, cameras) -> None:
    """Changing a surfel's colour by e changes the pictures by about its weights times e^2."""
    scene = colored("sv")
    weights = shown_weights(scene, cameras)
    assert weights.shape == (len(cameras), COUNT)
    row = int(weights.sum(0).argmax())
    span = torch.zeros_like(scene.surfels["view_span"])
    flat = {"view_base": scene.surfels["view_base"].abs() + 0.1, "view_span": span, "view_terms": torch.zeros(0, 6)}
    other = {**flat, "view_base": flat["view_base"].clone()}
    other["view_base"][row] += 0.1
    a, b = with_colors(scene, flat), with_colors(scene, other)
    for view, camera in enumerate(cameras):
        change = (b.render(camera, BACKGROUND).rgb - a.render(camera, BACKGROUND).rgb).square().sum()
        assert float(change) == pytest.approx(3 * 0.01 * float(weights[view, row]), rel=0.05, abs=1e-4)


def test_views_that_pass_close_by_count_though_they_look_elsewhere(colored, cameras) -> None:
    """Such a view adds the possible error of the colour from there, without showing anything."""
    scene = colored("sv")
    weights = shown_weights(scene, cameras)
    row = int(weights.sum(0).argmax())
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))  # facing away
    viewmat = torch.eye(4)
    viewmat[:3, :3] = turned @ cameras[0].viewmat[:3, :3]
    toward = torch.nn.functional.normalize(cameras[0].center - scene.surfels["means"][row], dim=0)
    center = scene.surfels["means"][row] + 0.05 * toward.roll(1)
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    blind = replace(cameras[0], viewmat=viewmat)
    assert float(shown_weights(scene, [blind])[0, row]) == 0.0
    before, after = (color_choices(scene, views).error[:, 0] for views in (cameras, [*cameras, blind]))
    assert float(after[row]) > 1.5 * float(before[row])
