"""Any arguments of public operations give the right answer or a clear error, never a crash or silent error.

Examples depend on the test only (the same on every machine); BITYMI_FUZZ=n runs n times as many.
"""

import os
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.measure.stability.scenes import SV_KEYS, random_scene
from bitymi_ns.ops.field import FieldGeometry
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.scene import Camera
from bitymi_ns.scene.baked import BakedScene

pytestmark = pytest.mark.slow

MORE = int(os.environ.get("BITYMI_FUZZ", "1"))
REFUSED = (ValueError, TypeError, RuntimeError, IndexError)
EXTREME = (0.0, -0.0, 1e-38, 1e-30, 1e-12, 1.0, -1.0, 1 / 255, 30.0, -87.0, 88.0, 1e4, -1e6, 1e10, 1e19, -3e38)
BROKEN = (float("nan"), float("inf"), -float("inf"))
SIZES = {"means": (3,), "quats": (4,), "log_scales": (2,), "opacity_logits": (), "beta_raw": ()}


def fuzz(examples: int):
    unchecked = list(HealthCheck)
    return settings(max_examples=examples * MORE, deadline=None, derandomize=True, suppress_health_check=unchecked)


@st.composite
def surfels(draw: st.DrawFn, broken: bool) -> dict[str, Tensor]:
    """Draw random surfels with some extreme numbers."""
    n = draw(st.integers(0, 20))
    case = random_scene(max(n, 1), draw(st.integers(0, 1000)), 16, 16)
    params = {key: value[:n].float() for key, value in case.params.items()}
    values = EXTREME + (BROKEN if broken else ())
    for _ in range(draw(st.integers(0, 12)) if n else 0):
        key = draw(st.sampled_from(GEOMETRY + ("sv_sites", "sv_log_tau")))
        flat = params[key].view(-1)
        flat[draw(st.integers(0, flat.numel() - 1))] = draw(st.sampled_from(values))
    return params


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Draw cameras of any size up to 40 pixels, odd focal lengths, principal points outside, any pose."""
    width, height = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    case = random_scene(1, draw(st.integers(0, 1000)), 16, 16)
    viewmat = case.viewmat.float()
    viewmat[:3, 3] *= draw(st.sampled_from((0.0, 1.0, 1e3, 1e7)))
    f = draw(st.sampled_from((1e-3, 1.0, 20.0, 1e5)))
    K = torch.tensor([[f, 0, draw(st.floats(-1e4, 1e4, width=32))], [0, 1.3 * f, height / 2], [0, 0, 1]])
    return Camera(viewmat, K, width, height)


@fuzz(120)
@given(
    params=surfels(broken=True),
    camera=cameras(),
    near=st.sampled_from((1e-6, 0.2, 5.0)),
)
def test_rendering_any_numbers(params: dict[str, Tensor], camera: Camera, near: float) -> None:
    """Images and gradients are finite for any surfels with finite colours."""
    finite = {key: bool(value.isfinite().all()) for key, value in params.items()}
    leaves = {key: value.clone().requires_grad_() for key, value in params.items()}
    n = len(leaves["means"])
    projection = ops.project(*(leaves[key] for key in GEOMETRY), camera, near)
    rows = torch.ones(n, dtype=torch.bool)
    for key in GEOMETRY:
        rows &= params[key].view(n, max(1, params[key][:1].numel())).isfinite().all(-1) if n else rows
    assert projection.not_finite == int((~rows).sum())
    assert not (projection.visible & ~rows).any()
    fragments = ops.trace(projection)
    assert ((fragments.pixel >= 0) & (fragments.pixel < camera.width * camera.height)).all()
    assert ((fragments.surfel >= 0) & (fragments.surfel < n)).all()
    assert fragments.uv.abs().max() <= 3.0001 if len(fragments) else True
    base = ops.view_color("sv", leaves, leaves["means"], camera.exact_center, projection.visible)
    image = ops.blended_image(fragments, projection, base, maps=True)
    alpha = image[:, 3]
    assert alpha.isfinite().all() and (alpha >= 0).all() and (alpha <= 1.0001).all()
    if finite["sv_sites"] and finite["sv_log_tau"]:
        assert image[:, :5].isfinite().all()
        (image[:, :5].sum()).backward()
        for key, leaf in leaves.items():
            assert leaf.grad is None or leaf.grad.isfinite().all(), key


@fuzz(60)
@given(data=st.data())
def test_shapes_and_dtypes_that_do_not_fit_are_refused(data: st.DataObject) -> None:
    """With one argument of the pipeline spoiled, an error is raised, or the result unchanged if it was valid."""
    case = random_scene(7, 1, 16, 12)
    params = {key: value.float() for key, value in case.params.items()}
    camera = Camera(case.viewmat.float(), case.K.float(), 16, 12)
    projection = ops.project(*(params[key] for key in GEOMETRY), camera)
    fragments = ops.trace(projection)
    base = ops.view_color("sv", params, params["means"], camera.exact_center)
    colors = torch.rand(len(fragments), 3)
    table, w1, w2, w3 = (torch.rand(s) for s in ((2, 64, 4), (8, 16), (16, 16), (16, 3)))
    geometry = FieldGeometry(8, True, (0.0, 0.0, 0.0), 1.0)
    image = torch.rand(20, 15, 3)

    def spoil(tensor: Tensor) -> Tensor:
        kinds = (
            tensor.half,
            tensor.long,
            lambda: tensor[:-1],
            lambda: tensor[..., :-1] if tensor.dim() > 1 else torch.cat([tensor, tensor]),
            lambda: tensor[:0],
            lambda: tensor.flatten()[0],
            lambda: tensor[None],
            lambda: tensor.to(torch.complex64),
        )
        return data.draw(st.sampled_from(kinds))()

    calls = {
        "project": ([params[key] for key in GEOMETRY], lambda *a: ops.project(*a, camera).radii),
        "view_color": (
            [*(params[key] for key in SV_KEYS), params["means"], camera.exact_center],
            lambda a, b, c, m, o: ops.view_color("sv", dict(zip(SV_KEYS, (a, b, c), strict=True)), m, o),
        ),
        "blend": ([base, colors], lambda b, r: ops.blended_image(fragments, projection, b, residual=r)),
        "residual of a field": (
            [projection.frames, table, w1, w2, w3],
            lambda f, *w: ops.fragment_residual(fragments, f, geometry, w),
        ),
        "field": ([params["means"], table, w1, w2, w3], lambda x, *w: ops.field(x, geometry, *w)),
        "ssim": ([image, image * 0.5], ops.ssim),
        "masked_counts": ([torch.ones(16 * 12, dtype=torch.bool)], fragments.masked_counts),
    }
    values, function = calls[data.draw(st.sampled_from(sorted(calls)))]
    number = data.draw(st.integers(0, len(values) - 1))
    values[number] = spoil(values[number])
    try:
        out = function(*values)
    except REFUSED as error:
        assert str(error)
        return
    assert all(t.isfinite().all() for t in (out if isinstance(out, tuple) else (out,)))


def test_fragments_of_one_scene_are_not_taken_for_those_of_another() -> None:
    few, many = (random_scene(n, 1, 16, 12) for n in (3, 9))
    camera = Camera(many.viewmat.float(), many.K.float(), 16, 12)
    projections = [ops.project(*(case.params[key].float() for key in GEOMETRY), camera) for case in (few, many)]
    fragments = ops.trace(projections[1])
    with pytest.raises(ValueError, match="those of 9 surfels, not of 3"):
        ops.blended_image(fragments, projections[0], torch.rand(9, 3))
    with pytest.raises(ValueError, match="base must have shape"):
        ops.blended_image(fragments, projections[1], torch.rand(3, 3))
    for radii in (projections[1].radii.double(), projections[1].radii[:-1]):
        with pytest.raises(REFUSED):
            ops.trace(replace(projections[1], radii=radii))


@fuzz(25)
@given(seed=st.integers(0, 1000), step=st.sampled_from((2, 3)), double=st.booleans())
def test_strided_views_give_what_their_copies_give(seed: int, step: int, double: bool) -> None:
    case = random_scene(9, seed, 20, 14)
    dtype = torch.float64 if double else torch.float32
    camera = Camera(case.viewmat.to(dtype), case.K.to(dtype), 20, 14)

    def strided(tensor: Tensor) -> Tensor:
        wide = torch.full((*tensor.shape, step), float("nan"), dtype=dtype)
        wide[..., 0] = tensor
        return wide[..., 0]

    results = []
    for make in (strided, lambda tensor: tensor.to(dtype)):
        leaves = {key: make(value).requires_grad_() for key, value in case.params.items()}
        transposed = leaves["means"].detach().T.contiguous().T.requires_grad_()
        projection = ops.project(transposed, *(leaves[key] for key in GEOMETRY[1:]), camera)
        fragments = ops.trace(projection)
        base = ops.view_color("sv", leaves, transposed, camera.exact_center, projection.visible)
        image = ops.blended_image(fragments, projection, base)
        image.square().sum().backward()
        results.append([image.detach(), transposed.grad, *(leaves[key].grad for key in GEOMETRY[1:])])
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


@fuzz(40)
@given(
    seed=st.integers(0, 1000),
    count=st.integers(0, 40),
    levels=st.integers(1, 4),
    log2=st.integers(4, 8),
    resolution=st.sampled_from((2, 7, 256)),
    contract=st.booleans(),
    half=st.sampled_from((1e-6, 1.0, 1e6)),
    value=st.sampled_from(EXTREME + BROKEN),
)
def test_the_field_anywhere(
    seed: int, count: int, levels: int, log2: int, resolution: int, contract: bool, half: float, value: float
) -> None:
    g = torch.Generator().manual_seed(seed)
    shapes = ((levels, 1 << log2, 4), (levels * 4, 16), (16, 16), (16, 3))
    weights = [(torch.rand(shape, generator=g) - 0.5).requires_grad_() for shape in shapes]
    x = torch.randn(count, 3, generator=g)
    if count:
        x[count // 2, seed % 3] = value
    x.requires_grad_()
    rho = ops.field(x, FieldGeometry(resolution, contract, (0.0, 0.1, 0.0), half), *weights)
    rho.sum().backward()
    rows = x.detach().isfinite().all(-1)
    assert rho[rows].isfinite().all() and x.grad[rows].isfinite().all()
    if rows.all():
        assert all(w.grad.isfinite().all() for w in weights)


@fuzz(40)
@given(
    kind=st.sampled_from(sorted(ops.VIEW_COLORS)),
    seed=st.integers(0, 1000),
    terms=st.integers(0, 33),
    value=st.sampled_from(EXTREME),
)
def test_view_colors_of_any_size(kind: str, seed: int, terms: int, value: float) -> None:
    n, g = 5, torch.Generator().manual_seed(seed)
    shapes = {
        "sv": [(n, terms, 3), (n, terms), (n, terms, 3)],
        "sh": [(n, 3), (n, terms, 3)],
        "sb": [(n, 3), (n, terms, 6)],
        "sg": [(n, 3), (n, terms, 7)],
    }[kind]
    names = ops.VIEW_COLORS[kind].names
    params = {name: torch.randn(s, generator=g) for name, s in zip(names, shapes, strict=True)}
    if kind == "sv" and terms:
        params["sv_sites"][0, 0, 0] = params["sv_log_tau"][1, 0] = value
    if kind == "sg" and terms:
        params["sg_lobes"][0, 0, 3] = value
    params = {name: p.requires_grad_() for name, p in params.items()}
    means = torch.randn(n, 3, generator=g).requires_grad_()
    try:
        color = ops.view_color(kind, params, means, torch.zeros(3))
    except ValueError as error:
        assert str(error)
        assert terms in (0, 33) or kind == "sh"
        return
    color.sum().backward()
    assert color.isfinite().all() and means.grad.isfinite().all()
    assert all(p.grad.isfinite().all() for p in params.values())


@fuzz(40)
@given(data=st.data())
def test_the_baked_renderer_with_any_tiles(data: st.DataObject) -> None:
    """Tiles anywhere inside the pages, of any size, with any texels."""
    params = data.draw(surfels(broken=True))
    n = len(params["means"])
    width, height, layers = data.draw(st.integers(1, 24)), data.draw(st.integers(1, 24)), data.draw(st.integers(1, 2))
    tiles = torch.zeros(n, 5, dtype=torch.int32)
    for i in range(n):
        r_u, r_v = data.draw(st.integers(0, width)), data.draw(st.integers(1, height))
        if r_u:
            place = (data.draw(st.integers(0, width - r_u)), data.draw(st.integers(0, height - r_v)))
            tiles[i] = torch.tensor([*place, data.draw(st.integers(0, layers - 1)), r_u, r_v])
    if data.draw(st.booleans()):
        atlas = torch.randint(0, 256, (layers, height, width, 4), dtype=torch.uint8)
    else:
        atlas = torch.randn(layers, height, width, 4)
    scene = BakedScene(params, "sv", tiles, atlas, weight_bound=data.draw(st.sampled_from((0.0, 0.02, 1.0))))
    camera = data.draw(cameras())
    output = scene.render(camera, torch.rand(3), maps=data.draw(st.booleans()))
    assert output.rgb.shape == (camera.height, camera.width, 3)
    assert (output.alpha >= 0).all() and (output.alpha <= 1.0001).all()
