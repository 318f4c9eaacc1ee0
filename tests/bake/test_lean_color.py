"""Reduced view colours: the error bound holds, and simple colours keep few terms."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F

from bitymi_ns.bake import BakeOptions, bake, export
from bitymi_ns.bake.directions import BETWEEN, SPHERE, view_directions
from bitymi_ns.bake.lean_color import reduce_view_color, view_color_errors
from bitymi_ns.bake.verify import check_view_color
from bitymi_ns.bundle import check_files, read_bundle
from bitymi_ns.ops.reference import view_color as reference
from bitymi_ns.ops.view_color import LEAN, check_lean
from bitymi_ns.ops.view_kinds import VIEW_COLORS

KINDS = list(VIEW_COLORS)


def views(n: int, count: int = 9, seed: int = 0, spread: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (seen [V, n], centers [V, 3]) of views on one side; surfel 0 is unseen, surfel 1 seen by one view."""
    g = torch.Generator().manual_seed(seed)
    centers = torch.tensor([0.0, 0.0, -6.0]) + spread * torch.randn(count, 3, generator=g)
    seen = torch.rand(count, n, generator=g) < 0.6
    seen[:, 0], seen[:, 1] = False, torch.arange(count) == 2
    return seen, centers.double()


def exact_errors(kind, params, lean, means, seen, centers, opacity):
    """Compute the largest weighted error at the views' directions, in float64: [n]."""
    found = torch.zeros(len(means), dtype=torch.float64)
    full = [params[name].double() for name in VIEW_COLORS[kind].names]
    for view, center in zip(seen, centers, strict=True):
        d = F.normalize(means.double() - center, dim=1)
        a = getattr(reference, kind)(*full, d)
        b = reference.lean(kind, lean["view_base"].double(), lean["view_span"], lean["view_terms"].double(), d)
        error = 255 * ((a + 0.5).relu() - (b + 0.5).relu()).abs().amax(1) * opacity
        found = torch.where(view, torch.maximum(found, error), found)
    return found


@settings(deadline=None, max_examples=25)
@given(st.sampled_from(KINDS), st.integers(0, 1000), st.sampled_from([0.1, 1.0, 4.0, 30.0]), st.floats(0.05, 3.0))
def test_the_bound_holds_in_every_view(surfels, kind, seed, tolerance, spread):
    n = 24
    params = surfels(n, kind, seed)
    means, opacity = params["means"], params["opacity_logits"].sigmoid()
    seen, centers = views(n, seed=seed, spread=spread)
    lean = reduce_view_color(params, kind, seen, centers, opacity, tolerance)
    check_lean(kind, lean, n)
    assert float(exact_errors(kind, params, lean, means, seen, centers, opacity).amax()) <= tolerance + 0.01
    stated = view_color_errors(kind, params, lean, means, seen, centers, opacity)
    assert float(stated.amax()) <= tolerance + 0.01  # also between the views, and all around an unseen surfel


def test_directions_are_those_of_the_views_and_others_between(surfels):
    n = 12
    means, (seen, centers) = surfels(n)["means"], views(n)
    found = {}
    for at in view_directions(means, seen, centers):
        assert torch.allclose(at.unit.norm(dim=2), torch.ones(()), atol=1e-5)
        for row, unit, valid in zip(at.rows.tolist(), at.unit, at.valid, strict=True):
            found[row] = (unit[: at.views][valid[: at.views]], unit[at.views :][valid[at.views :]])
    assert sorted(found) == list(range(n)) and len(found[0][0]) == 0 and len(found[0][1]) == SPHERE
    for row in range(1, n):
        own = F.normalize(means[row].double() - centers[seen[:, row]], dim=1).float()
        seen_from, between = found[row]
        assert torch.allclose(seen_from, own, atol=1e-6) and len(between) == BETWEEN
        middle = F.normalize(own.mean(0), dim=0)
        assert (between @ middle).amin() > 2 * (own @ middle).amin() - 1.01  # not far outside of the views
    assert torch.allclose(found[1][1], found[1][0].expand(BETWEEN, 3), atol=1e-5)  # one view: always the same


def test_a_colour_that_no_view_sees_change_is_one_colour(surfels):
    n = 10
    params = surfels(n, "sv")
    params["sv_rgb"] = params["sv_rgb"][:, :1].expand(-1, 7, -1) + 1e-4 * params["sv_rgb"]
    lean = reduce_view_color(params, "sv", *views(n), torch.ones(n), 1.0)
    assert (lean["view_span"][:, 1] == 0).all() and lean["view_terms"].shape == (0, 6)
    torch.testing.assert_close(lean["view_base"], params["sv_rgb"].mean(1), atol=2e-3, rtol=0)
    for kind, lobes in (("sh", "sh_rest"), ("sg", "sg_lobes")):
        params = surfels(n, kind)
        params[lobes] = params[lobes] * 1e-5
        lean = reduce_view_color(params, kind, *views(n), torch.ones(n), 1.0)
        assert (lean["view_span"][:, 1] == 0).all()
        d = F.normalize(params["means"].double() - views(n)[1][0], dim=1)
        a = getattr(reference, kind)(*(params[name].double() for name in VIEW_COLORS[kind].names), d)
        b = reference.lean(kind, lean["view_base"].double(), lean["view_span"], lean["view_terms"].double(), d)
        torch.testing.assert_close(a.clamp(min=-0.5), b, atol=4e-3, rtol=0)


def test_sites_that_agree_are_merged(surfels):
    """Six sites in two groups of equal colour: at most two sites remain, for any views."""
    n = 20
    params = surfels(n, "sv")
    group = torch.tensor([0, 0, 0, 1, 1, 1])
    for name in VIEW_COLORS["sv"].names:
        params[name] = params[name][:, group].contiguous()
    lean = reduce_view_color(params, "sv", *views(n), torch.ones(n), 0.05)
    assert (lean["view_span"][:, 1] <= 1).all()


def test_without_room_all_sites_are_kept_and_nothing_changes(surfels):
    n = 16
    params = surfels(n, "sv")
    params["sv_rgb"] *= 10
    seen, centers = views(n, spread=5.0)
    lean = reduce_view_color(params, "sv", seen, centers, torch.ones(n), 1e-3)
    rest = torch.arange(n) != 1
    assert (lean["view_span"][rest, 1] == 6).all()
    d = F.normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(1)), dim=1).double()
    want = reference.sv(*(params[name].double() for name in VIEW_COLORS["sv"].names), d)
    got = reference.lean("sv", lean["view_base"].double(), lean["view_span"], lean["view_terms"].double(), d)
    torch.testing.assert_close(got[rest], want[rest], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bundle_holds_the_lean_colours_and_verify_measures_them(scene, camera, tmp_path, kind):
    made, cameras = scene(60, None, kind), [camera(3.0), camera(4.0)]
    options = BakeOptions(format="uint8", tolerance=2.0)
    baked = bake(made, cameras, options)
    export(baked, tmp_path / "b", statistics={"options": vars(options)})
    bundle, checks = check_files(tmp_path / "b")
    assert all(check.ok for check in checks) and bundle.scene.view_color == kind
    assert bundle.info.version == "2.3" and bundle.info.surfels.terms == len(bundle.scene.surfels["view_terms"])
    for name in LEAN:
        assert torch.equal(bundle.scene.surfels[name], baked.scene.surfels[name])
    stated = bundle.info.statistics.view_color.model_dump()
    assert stated["error"]["p100"] <= 2.0 and stated["sites"]["after"] < stated["sites"]["before"]
    assert stated["one_color"] == int((bundle.scene.surfels["view_span"][:, 1] == 0).sum())
    check = check_view_color(bundle, made.surfels, cameras)
    assert check.ok and "stated" in check.detail
    full = bake(made, cameras, BakeOptions(format="uint8", tolerance=0.0))
    assert full.statistics.view_color is None and set(full.scene.surfels) == set(made.surfels)
    export(full, tmp_path / "full")
    whole = read_bundle(tmp_path / "full")
    assert whole.info.version == "1.4" and check_view_color(whole, made.surfels, cameras).ok
    saved = stated["bytes"]["before"] - stated["bytes"]["after"]
    sizes = [(tmp_path / name / "surfels.ply").stat().st_size for name in ("full", "b")]
    assert abs(sizes[0] - sizes[1] - saved) < 2500  # the header names fewer columns
    a, b = (each.scene.render(cameras[0]).rgb for each in (whole, bundle))
    assert float((a - b).abs().amax()) < 6 * 2.0 / 255


def test_altered_colours_are_found(scene, camera, tmp_path):
    made, cameras = scene(60), [camera(3.0)]
    export(bake(made, cameras, BakeOptions(format="uint8")), tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    bundle.scene.surfels["view_base"][bundle.scene.surfels["opacity_logits"].argmax()] += 0.3
    assert not check_view_color(bundle, made.surfels, cameras).ok
    bundle.scene.surfels["means"][3] += 1.0
    assert "surfel 3 is none" in check_view_color(bundle, made.surfels, cameras).detail


def test_without_views_the_bound_holds_all_around(scene):
    made = scene(40)
    baked = bake(made, options=BakeOptions(tolerance=3.0))
    opacity = baked.scene.surfels["opacity_logits"].sigmoid().clamp(max=0.99)
    none = torch.zeros(0, 40, dtype=torch.bool), torch.zeros(0, 3, dtype=torch.float64)
    full = {name: value[baked.rows] for name, value in made.surfels.items()}
    assert float(view_color_errors("sv", full, baked.scene.surfels, full["means"], *none, opacity).amax()) <= 3.01
