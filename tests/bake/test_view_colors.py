"""View colours keep what is needed: the bound holds, little is kept where little is needed, and prices decide."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F

from bitymi_ns.bake import BakeOptions, bake_field, export
from bitymi_ns.bake.directions import BETWEEN, SPHERE, view_directions
from bitymi_ns.bake.verify import check_view_color
from bitymi_ns.bake.view_colors import ColorChoices, centers_of, color_choices, view_color_errors
from bitymi_ns.bundle import check_files, read_bundle
from bitymi_ns.ops import backend
from bitymi_ns.ops.reference import view_color as reference
from bitymi_ns.ops.view_color import REDUCED, check_reduced
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.visibility import visibility
from tests.bake.test_tune import BACKGROUND, photographs, waving

KINDS = list(VIEW_COLORS)
COUNT = 60


def views(n: int, count: int = 9, seed: int = 0, spread: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (seen [V, n], centers [V, 3]) of views on one side; surfel 0 is unseen, surfel 1 seen by one view."""
    g = torch.Generator().manual_seed(seed)
    centers = torch.tensor([0.0, 0.0, -6.0]) + spread * torch.randn(count, 3, generator=g)
    seen = torch.rand(count, n, generator=g) < 0.6
    seen[:, 0], seen[:, 1] = False, torch.arange(count) == 2
    return seen, centers.double()


def whole_and_reduced(kind, params, reduced, d):
    """Evaluate both in directions d [n, 3] float64."""
    whole = getattr(reference, kind)(*(params[name].double() for name in VIEW_COLORS[kind].names), d)
    base, span, terms = (reduced[name] for name in REDUCED)
    return whole, reference.reduced(kind, base.double(), span, terms.double(), d)


def exact_errors(kind, params, reduced, means, seen, centers, opacity):
    largest = torch.zeros(len(means), dtype=torch.float64)
    for view, center in zip(seen, centers, strict=True):
        a, b = whole_and_reduced(kind, params, reduced, F.normalize(means.double() - center, dim=1))
        error = 255 * ((a + 0.5).relu() - (b + 0.5).relu()).abs().amax(1) * opacity
        largest = torch.where(view, torch.maximum(largest, error), largest)
    return largest


@settings(deadline=None, max_examples=25)
@given(st.sampled_from(KINDS), st.integers(0, 1000), st.sampled_from([0.1, 1.0, 4.0, 30.0]), st.floats(0.05, 3.0))
def test_the_bound_holds_in_every_view(surfels, kind, seed, tolerance, spread):
    n = 24
    params = surfels(n, kind, seed)
    means, opacity = params["means"], params["opacity_logits"].sigmoid()
    seen, centers = views(n, seed=seed, spread=spread)
    reduced = color_choices(params, kind, seen, centers, opacity, tolerance).at()
    check_reduced(kind, reduced, n)
    assert float(exact_errors(kind, params, reduced, means, seen, centers, opacity).amax()) <= tolerance + 0.01
    stated = view_color_errors(kind, params, reduced, means, seen, centers, opacity)
    assert float(stated.amax()) <= tolerance + 0.01  # also between the views, and all around an unseen surfel


def test_directions_are_those_of_the_views_and_others_between(surfels):
    n = 12
    means, (seen, centers) = surfels(n)["means"], views(n)
    of_rows = {}
    for chunk in view_directions(means, seen, centers):
        assert torch.allclose(chunk.unit.norm(dim=2), torch.ones(()), atol=1e-5)
        for row, *values in zip(chunk.rows.tolist(), chunk.unit, chunk.valid, strict=True):
            (own, rest), (own_valid, rest_valid) = ((v[: chunk.views], v[chunk.views :]) for v in values)
            of_rows[row] = own[own_valid], rest[rest_valid]
    assert sorted(of_rows) == list(range(n)) and len(of_rows[0][0]) == 0 and len(of_rows[0][1]) == SPHERE
    for row in range(1, n):
        own = F.normalize(means[row].double() - centers[seen[:, row]], dim=1).float()
        seen_from, between = of_rows[row]
        assert torch.allclose(seen_from, own, atol=1e-6) and len(between) == BETWEEN
        middle = F.normalize(own.mean(0), dim=0)
        assert (between @ middle).amin() > 2 * (own @ middle).amin() - 1.01  # not far outside of the views
    assert torch.allclose(of_rows[1][1], of_rows[1][0].expand(BETWEEN, 3), atol=1e-5)  # one view: always the same


def test_a_colour_that_no_view_sees_change_is_one_colour(surfels):
    n = 10
    params = surfels(n, "sv")
    params["sv_rgb"] = params["sv_rgb"][:, :1].expand(-1, 7, -1) + 1e-4 * params["sv_rgb"]
    reduced = color_choices(params, "sv", *views(n), torch.ones(n), 1.0).at()
    assert (reduced["view_span"][:, 1] == 0).all() and reduced["view_terms"].shape == (0, 6)
    torch.testing.assert_close(reduced["view_base"], params["sv_rgb"].mean(1), atol=2e-3, rtol=0)
    for kind, lobes in (("sh", "sh_rest"), ("sg", "sg_lobes")):
        params = surfels(n, kind)
        params[lobes] = params[lobes] * 1e-5
        reduced = color_choices(params, kind, *views(n), torch.ones(n), 1.0).at()
        assert (reduced["view_span"][:, 1] == 0).all()
        a, b = whole_and_reduced(kind, params, reduced, F.normalize(params["means"].double() - views(n)[1][0], dim=1))
        torch.testing.assert_close(a.clamp(min=-0.5), b, atol=4e-3, rtol=0)


def test_sites_that_agree_are_merged(surfels):
    """Six sites in two groups of equal colour: at most two sites remain, for any views."""
    n = 20
    params = surfels(n, "sv")
    group = torch.tensor([0, 0, 0, 1, 1, 1])
    for name in VIEW_COLORS["sv"].names:
        params[name] = params[name][:, group].contiguous()
    reduced = color_choices(params, "sv", *views(n), torch.ones(n), 0.05).at()
    assert (reduced["view_span"][:, 1] <= 1).all()


def test_without_room_all_sites_are_kept_and_nothing_changes(surfels):
    n = 16
    params = surfels(n, "sv")
    params["sv_rgb"] *= 10
    seen, centers = views(n, spread=5.0)
    reduced = color_choices(params, "sv", seen, centers, torch.ones(n), 1e-3).at()
    rest = torch.arange(n) != 1
    assert (reduced["view_span"][rest, 1] == 6).all()
    d = F.normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(1)), dim=1).double()
    want, got = whole_and_reduced("sv", params, reduced, d)
    torch.testing.assert_close(got[rest], want[rest], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bundle_holds_the_reduced_colours_and_verify_measures_them(scene, camera, tmp_path, kind):
    made, cameras = scene(60, None, kind), [camera(3.0), camera(4.0)]
    options = BakeOptions(format="uint8", tolerance=2.0)
    baked = bake_field(made, cameras, options)
    export(baked, tmp_path / "b", statistics={"options": vars(options)})
    bundle, checks = check_files(tmp_path / "b")
    assert all(check.ok for check in checks) and bundle.scene.view_color == kind
    assert bundle.info.version == "6.0" and bundle.info.surfels.terms == len(bundle.scene.surfels["view_terms"])
    for name in REDUCED:
        assert torch.equal(bundle.scene.surfels[name], baked.scene.surfels[name])
    stated = bundle.info.statistics.view_color.model_dump()
    assert stated["error"]["p100"] <= 2.0 and stated["sites"]["after"] < stated["sites"]["before"]
    assert stated["one_color"] == int((bundle.scene.surfels["view_span"][:, 1] == 0).sum())
    check = check_view_color(bundle, made.surfels, cameras)
    assert check.ok and "stated" in check.detail
    full = bake_field(made, cameras, BakeOptions(format="uint8", tolerance=0.0))
    assert full.statistics.view_color is None and set(full.scene.surfels) == set(made.surfels)
    export(full, tmp_path / "full")
    whole = read_bundle(tmp_path / "full")
    assert set(whole.scene.surfels) == set(made.surfels) > set(VIEW_COLORS[kind].names)
    assert whole.info.version == "6.0" and check_view_color(whole, made.surfels, cameras).ok
    saved = stated["bytes"]["before"] - stated["bytes"]["after"]
    sizes = [(tmp_path / name / "surfels.ply").stat().st_size for name in ("full", "b")]
    assert abs(sizes[0] - sizes[1] - saved) < 2500  # the header names fewer columns
    a, b = (each.scene.render(cameras[0]).rgb for each in (whole, bundle))
    assert float((a - b).abs().amax()) < 6 * 2.0 / 255


def test_altered_colours_are_found(scene, camera, tmp_path):
    made, cameras = scene(60), [camera(3.0)]
    export(bake_field(made, cameras, BakeOptions(format="uint8")), tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    bundle.scene.surfels["view_base"][bundle.scene.surfels["opacity_logits"].argmax()] += 0.3
    assert not check_view_color(bundle, made.surfels, cameras).ok
    bundle.scene.surfels["means"][3] += 1.0
    assert "surfel 3 is none" in check_view_color(bundle, made.surfels, cameras).detail


def test_without_views_the_bound_holds_all_around(scene):
    made = scene(40)
    baked = bake_field(made, options=BakeOptions(tolerance=3.0))
    opacity = baked.scene.surfels["opacity_logits"].sigmoid().clamp(max=0.99)
    none = torch.zeros(0, 40, dtype=torch.bool), torch.zeros(0, 3, dtype=torch.float64)
    full = {name: value[baked.rows] for name, value in made.surfels.items()}
    assert float(view_color_errors("sv", full, baked.scene.surfels, full["means"], *none, opacity).amax()) <= 3.01


@pytest.fixture(scope="module")
def cameras(scene) -> list:
    return [view.camera for view in photographs(waving(scene(COUNT)))]


@pytest.fixture
def colored(scene):
    return lambda kind: replace(
        (baked := waving(scene(COUNT)).unquantised()),
        surfels={**baked.surfels, **scene(COUNT, None, kind).surfels, "means": baked.surfels["means"]},
        view_color=kind,
    )


def squares(scene: BakedScene, cameras: list) -> torch.Tensor:
    return visibility(scene.surfels, cameras, scene.near).squares


def choices_of(scene: BakedScene, cameras: list) -> ColorChoices:
    """Choices down from nearly all terms."""
    at = (squares(scene, cameras), centers_of(cameras, scene.surfels["means"]), torch.ones(COUNT))
    return color_choices(scene.surfels, scene.view_color, *at, 1e-3, scene.near)


def with_colors(scene: BakedScene, colors: dict[str, torch.Tensor]) -> BakedScene:
    kept = {name: value for name, value in scene.surfels.items() if name not in VIEW_COLORS[scene.view_color].names}
    return replace(scene, surfels={**kept, **colors})


@pytest.mark.parametrize("kind", KINDS)
def test_the_price_decides_from_all_terms_to_none(colored, cameras, kind: str) -> None:
    scene = colored(kind)
    choices = choices_of(scene, cameras)
    counts = []
    for price in (None, 1e-4, 1e-2, 1e6):
        colors = choices.at(price)
        check_reduced(kind, colors, COUNT)
        counts.append(len(colors["view_terms"]))
        assert with_colors(scene, colors).render(cameras[0], BACKGROUND).rgb.isfinite().all()
    assert counts == sorted(counts, reverse=True) and counts[-1] == 0 and counts[0] > COUNT


def test_weights_are_those_of_the_fragments(colored, cameras) -> None:
    """A surfel whose colour is changed by e changes the pictures by about its weights times e^2."""
    scene = colored("sv")
    weights = squares(scene, cameras).float()
    assert weights.shape == (len(cameras), COUNT)
    row = int(weights.sum(0).argmax())
    span = torch.zeros(COUNT, 2, dtype=torch.int32)
    flat = {"view_base": torch.rand(COUNT, 3) + 0.1, "view_span": span, "view_terms": torch.zeros(0, 6)}
    other = {**flat, "view_base": flat["view_base"].clone()}
    other["view_base"][row] += 0.1
    a, b = with_colors(scene, flat), with_colors(scene, other)
    for view, camera in enumerate(cameras):
        change = (b.render(camera, BACKGROUND).rgb - a.render(camera, BACKGROUND).rgb).square().sum()
        assert float(change) == pytest.approx(3 * 0.01 * float(weights[view, row]), rel=0.05, abs=1e-4)


def test_views_that_pass_close_by_count_though_they_look_elsewhere(colored, cameras) -> None:
    """Count the error of the colour in the direction of a view that shows nothing of the surfel."""
    scene = colored("sv")
    row = int(squares(scene, cameras).float().sum(0).argmax())
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))  # the other way round
    viewmat = torch.eye(4)
    viewmat[:3, :3] = turned @ cameras[0].viewmat[:3, :3]
    toward = F.normalize(cameras[0].center - scene.surfels["means"][row], dim=0)
    center = scene.surfels["means"][row] + 0.05 * toward.roll(2)
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    blind = replace(cameras[0], viewmat=viewmat)
    assert float(squares(scene, [blind])[0, row]) == 0.0
    before, after = (choices_of(scene, views).error[:, 0] for views in (cameras, [*cameras, blind]))
    assert float(after[row]) > 1.5 * float(before[row])


def definition(vectors, rgb, directions, target, weight, steps: int):
    """Levenberg-Marquardt as it is written down: one matrix of all unknowns, from the Jacobian of every direction."""
    damping = vectors.new_full((len(vectors),), 1e-3)

    def residuals(flat):
        v, c = flat[:, : vectors[0].numel()].unflatten(1, (-1, 3)), flat[:, vectors[0].numel() :].unflatten(1, (-1, 3))
        shown = torch.softmax(directions @ F.pad(v, (0, 0, 1, 0)).transpose(1, 2), 2) @ c
        return ((shown - target) * weight.sqrt()[..., None]).flatten(1)

    x = torch.cat([vectors.flatten(1), rgb.flatten(1)], 1)
    for _ in range(steps):
        jacobian = torch.autograd.functional.jacobian(lambda x: residuals(x).sum(0), x).transpose(0, 1)
        normal, right = jacobian.transpose(1, 2) @ jacobian, jacobian.transpose(1, 2) @ residuals(x)[..., None]
        diagonal = normal.diagonal(dim1=1, dim2=2)
        floor = 1e-4 * diagonal.mean(1, keepdim=True) + 1e-8
        tried = x - torch.linalg.solve(normal + torch.diag_embed(damping[:, None] * (diagonal + floor)), right)[..., 0]
        better = residuals(tried).square().sum(1) < residuals(x).square().sum(1)
        x = torch.where(better[:, None], tried, x)
        damping = torch.where(better, 0.3 * damping, 8.0 * damping)
    return x[:, : vectors[0].numel()].view_as(vectors), x[:, vectors[0].numel() :].view_as(rgb)


@pytest.mark.parametrize("sites", [2, 4, 7])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_fit_is_that_of_the_definition(dtype, sites: int) -> None:
    g, n, count = torch.Generator().manual_seed(sites), 37, 20
    vectors = 2 * torch.randn(n, sites - 1, 3, generator=g, dtype=torch.float64)
    rgb, target = torch.rand(n, sites, 3, generator=g).double(), torch.rand(n, count, 3, generator=g).double()
    directions = F.normalize(torch.randn(n, count, 3, generator=g) + torch.tensor([0.0, 0.0, 2.0]), dim=2).double()
    weight = torch.rand(n, count, generator=g).double() ** 2
    found = {"vectors": vectors.to(dtype, copy=True), "colors": rgb.to(dtype, copy=True)}
    samples = torch.cat([directions, target, weight[..., None]], 2).to(dtype)
    counts = {"sites": sites, "directions": count, "rounds": 3}
    backend.kernel("fit_sites", samples)(**found, **counts, samples=samples)
    exact = definition(vectors, rgb, directions, target, weight, 3)
    for got, want in zip(found.values(), exact, strict=True):
        near = torch.isclose(got.double(), want, *((1e-6, 1e-7) if dtype == torch.float64 else (2e-2, 2e-3)))
        assert near.double().mean() > (0.999 if dtype == torch.float64 else 0.97)


def order_by_definition(vectors: torch.Tensor, rgb: torch.Tensor, directions: torch.Tensor, weight: torch.Tensor):
    """Remove site after site, each time that without which the colour changes least: [n, K], the first removed last."""
    n, count = vectors.shape[:2]
    alive, gone = torch.ones(n, count, dtype=torch.bool), []
    for _ in range(count - 1):
        w = torch.softmax((directions @ vectors.transpose(1, 2)).masked_fill(~alive[:, None], -torch.inf), dim=2)
        change = (w / (1 - w))[..., None] * ((w @ rgb)[:, :, None] - rgb[:, None])
        cost = (change.square().sum(3) * weight[..., None]).sum(1)
        gone.insert(0, cost.masked_fill(~alive, torch.inf).argmin(1, keepdim=True))
        alive = alive.scatter(1, gone[0], False)
    return torch.cat([alive.long().argmax(1, keepdim=True), *gone], 1)


@pytest.mark.parametrize("sites", [1, 2, 7])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sites_are_ranked_as_defined(dtype, sites: int) -> None:
    g, n, count = torch.Generator().manual_seed(sites), 37, 20
    vectors, rgb = (torch.randn(n, sites, 3, generator=g, dtype=torch.float64) for _ in range(2))
    directions = F.normalize(torch.randn(n, count, 3, generator=g), dim=2).double()
    weight = torch.rand(n, count, generator=g).double()
    order = torch.empty(n, sites, dtype=torch.int64)
    given = {"vectors": vectors.to(dtype), "colors": rgb.to(dtype), "sites": sites, "directions": count}
    samples = torch.cat([directions, weight[..., None]], 2).to(dtype)
    backend.kernel("rank_sites", samples)(**given, samples=samples, order=order)
    same = (order == order_by_definition(vectors, rgb, directions, weight)).all(1)
    assert same.double().mean() > (0.999 if dtype == torch.float64 else 0.97)


def test_colours_that_are_no_numbers_are_ranked_too() -> None:
    vectors, samples = torch.zeros(3, 4, 3), torch.ones(3, 2, 4)
    rgb, order = torch.full((3, 4, 3), torch.nan), torch.empty(3, 4, dtype=torch.int64)
    given = {"vectors": vectors, "colors": rgb, "samples": samples, "sites": 4, "directions": 2}
    backend.kernel("rank_sites", samples)(**given, order=order)
    assert order.sort(1).values.tolist() == [[0, 1, 2, 3]] * 3
