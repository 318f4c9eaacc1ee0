"""The public functions and the examples."""

import copy
import importlib.util
import io
import json
import pickle
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import bitymi_ns
from bitymi_ns import sample
from bitymi_ns.bake import BakeOptions
from bitymi_ns.bake.early_stopping import EarlyStopping
from bitymi_ns.bundle import BundleError
from bitymi_ns.bundle.manifest import dump
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.ops import trace_cpu
from bitymi_ns.ops.backend import emulated_cuda
from bitymi_ns.ops.reference.project import Projection
from bitymi_ns.ops.reference.project import project as reference_project
from bitymi_ns.ops.reference.render import render as reference_render
from bitymi_ns.scene.scene_renderer import SceneRenderer
from tests.cuda.conftest import why_not_emulated

ROOT = Path(__file__).resolve().parents[1]
EMULATED = pytest.mark.skipif(why_not_emulated() is not None, reason=str(why_not_emulated()))


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample.generate(tmp_path_factory.mktemp("api") / "room", views=9, width=48, height=36, points=200)


def surfels(count: int = 12) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    values = {
        "means": torch.rand(count, 3, generator=g, dtype=torch.float64) * 2 - 1,
        "quats": torch.randn(count, 4, generator=g, dtype=torch.float64),
        "scales": 0.1 + 0.3 * torch.rand(count, 2, generator=g, dtype=torch.float64),
        "opacities": 0.2 + 0.7 * torch.rand(count, generator=g, dtype=torch.float64),
        "betas": 0.5 + 3.0 * torch.rand(count, generator=g, dtype=torch.float64),
        "colors": torch.rand(count, 3, generator=g, dtype=torch.float64),
    }
    values["means"][:, 2] += 4.0
    return {name: value.requires_grad_() for name, value in values.items()}


def camera_of(width: int = 24, height: int = 18) -> bitymi_ns.Camera:
    K = torch.tensor([[20.0, 0, width / 2], [0, 21.0, height / 2], [0, 0, 1]])
    return bitymi_ns.Camera(torch.eye(4), K, width, height)


@pytest.mark.parametrize("most", [trace_cpu.MOST, 600])
def test_rasterize_agrees_with_the_float64_reference(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in bands, where memory holds few fragments."""
    monkeypatch.setattr(trace_cpu, "MOST", most)
    values, camera, background = surfels(), camera_of(), torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    drawn = bitymi_ns.rasterize(**values, camera=camera, background=background, maps=True)
    twin = surfels()
    raw = (twin["means"], twin["quats"], twin["scales"].log(), twin["opacities"].logit(), (twin["betas"] / 4).logit())
    exact = bitymi_ns.Camera(camera.viewmat.double(), camera.K.double(), camera.width, camera.height)
    expected = reference_render(raw, twin["colors"] - 0.5, exact, background, near=0.02)
    torch.testing.assert_close(drawn.rgb, expected.rgb, atol=1e-9, rtol=0)
    torch.testing.assert_close(drawn.alpha[..., 0], expected.alpha, atol=1e-9, rtol=0)
    torch.testing.assert_close(drawn.depth[..., 0], expected.depth, atol=1e-8, rtol=0)
    weights = torch.rand(drawn.rgb.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    (drawn.rgb * weights).sum().backward()
    (expected.rgb * weights).sum().backward()
    for name, value in values.items():
        torch.testing.assert_close(value.grad, twin[name].grad, atol=1e-7, rtol=1e-7, msg=name)
    with pytest.raises(ValueError, match="quats must have shape"):
        bitymi_ns.rasterize(**(values | {"quats": values["quats"][:, :3]}), camera=camera)


@pytest.mark.parametrize("cuda", [False, pytest.param(True, marks=EMULATED)])
@pytest.mark.parametrize(("dtype", "error"), [(torch.float64, 1e-9), (torch.float32, 1e-5)])
def test_the_ends_of_the_ranges_have_values_and_gradients_of_the_float64_reference(
    dtype: torch.dtype, error: float, cuda: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    values, camera = {name: value.detach().to(dtype) for name, value in surfels().items()}, camera_of()
    values["opacities"][:4] = torch.tensor([1.0, 1.0, 1.0, 0.0])
    values["betas"][[0, 2, 3, 4, 5, 6, 7]] = torch.tensor([4.0, 0.0, 0.0, 0.0, 4.0, 4.0, 4.0], dtype=dtype)
    twin = {name: value.double().requires_grad_() for name, value in values.items()}
    values = {name: value.requires_grad_() for name, value in values.items()}
    weights = torch.rand(18, 24, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    with emulated_cuda() if cuda else nullcontext():
        drawn = bitymi_ns.rasterize(**values, camera=camera).rgb
        (drawn * weights.to(dtype)).sum().backward()

    def projected(*raw: torch.Tensor, **view: Any) -> Projection:  # a logit has no gradient at the ends
        means, quats, scales, opacities, betas = raw
        found = reference_project(means, quats, scales.log(), *torch.zeros_like(betas).expand(2, -1), **view)
        return replace(found, opacity=opacities, beta=betas)

    monkeypatch.setitem(reference_render.__globals__, "project", projected)
    exact = bitymi_ns.Camera(camera.viewmat.double(), camera.K.double(), camera.width, camera.height)
    *geometry, colors = twin.values()
    expected = reference_render(geometry, colors - 0.5, exact, near=0.02).rgb
    (expected * weights).sum().backward()
    torch.testing.assert_close(drawn.double(), expected, atol=error, rtol=0)
    for name, value in values.items():
        torch.testing.assert_close(value.grad.double(), twin[name].grad, atol=10 * error, rtol=error, msg=name)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("opacities", 2.0, r"opacities have to be from 0 to 1: opacities\[0\] is 2"),
        ("opacities", -0.1, "opacities have to be"),
        ("opacities", float("nan"), "opacities have to be .* is nan"),
        ("betas", 4.5, r"betas have to be from 0 to 4: betas\[0\] is 4.5"),
        ("scales", -1.0, r"scales have to be above 0 and finite: scales\[0, 0\] is -1"),
        ("scales", 0.0, "scales have to be above 0"),
        ("scales", float("inf"), "scales have to be above 0 and finite"),
    ],
)
def test_what_is_out_of_range_is_refused(name: str, value: float, message: str) -> None:
    values = surfels()
    with pytest.raises(ValueError, match=message):
        bitymi_ns.rasterize(**values | {name: torch.full_like(values[name], value)}, camera=camera_of())


def test_what_cannot_be_trained_or_baked_is_refused(tmp_path: Path) -> None:
    view = bitymi_ns.View(camera_of(), torch.zeros(18, 24, 3))
    none = torch.zeros(0, 3)
    for views, points, colors, message in (
        ([], none, none, "no views"),
        ([view], torch.zeros(4, 2), none, r"points have to be \[M, 3\]"),
        ([view], torch.zeros(4, 3), torch.zeros(3, 3), r"colors have to be \[M, 3\], as many as points"),
    ):
        with pytest.raises(ValueError, match=message):
            bitymi_ns.train_scene(views, points, colors)
    with pytest.raises(ValueError, match="nothing to learn from: no views"):
        bitymi_ns.bake_scene(None, [], tmp_path / "bundle")
    stopping = EarlyStopping(0, 10, 3, 20.0, "first")
    assert stopping.due(0) and stopping.best == "first"


def test_a_view_moves_with_all_its_maps() -> None:
    maps = {name: torch.zeros(18, 24, 3) for name in bitymi_ns.View._fields if name not in ("camera", "counted")}
    moved = bitymi_ns.View(camera_of(), **maps, counted=7).to("meta")
    assert moved.counted == 7 and all(getattr(moved, name).device.type == "meta" for name in maps)


def test_a_capture_is_loaded_in_its_own_frame(room: Path, tmp_path: Path) -> None:
    views, points, colors = bitymi_ns.load_capture(room)
    assert len(views) == 9 and points.shape == colors.shape == (200, 3) and 0 <= colors.min() < colors.max() <= 1
    meta = json.loads((room / "transforms.json").read_text())
    for view, frame in zip(views, meta["frames"], strict=True):
        pose = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(view.camera.viewmat, np.linalg.inv(pose), atol=1e-6)
        assert np.array_equal(view.image, Image.open(room / frame["file_path"])) and view.mask is None
    parts = {name: bitymi_ns.load_capture(room, name, points="random") for name in ("train", "val", "test")}
    assert [len(part[0]) for part in parts.values()] == [7, 2, 2] and len(parts["val"][1]) == 0
    assert torch.equal(parts["test"][0][1].image, views[8].image)
    wide = tmp_path / "wide"
    shutil.copytree(room, wide)
    fisheye = {"camera_model": "OPENCV_FISHEYE", "fl_x": 12.0, "fl_y": 12.0}
    (wide / "transforms.json").write_text(json.dumps(meta | fisheye))
    faces, *_ = bitymi_ns.load_capture(wide, "val", points="random")
    assert len(faces) == 10 and any(face.mask is not None and not face.mask.all() for face in faces)
    with pytest.raises(ValueError, match="nowhere does not exist"):
        bitymi_ns.load_capture(tmp_path / "nowhere")
    for option, value in (("downscale_factor", -1), ("downscale_factor", float("nan")), ("points", "nope")):
        with pytest.raises(CaptureError, match=f"{option} is {value}, but has to be"):
            bitymi_ns.load_capture(room, **{option: value})


def test_a_scene_is_trained_baked_read_and_rendered_from_arrays(room: Path, tmp_path: Path) -> None:
    psnr = example("train_from_arrays").main(room, tmp_path / "bundle", steps=60)
    assert psnr > 8.0
    paths = example("render_bundle").main(tmp_path / "bundle", tmp_path / "pictures", most=2)
    assert [Image.open(path).size for path in paths] == [(48, 36)] * 2
    bundle = bitymi_ns.read_bundle(tmp_path / "bundle")
    drawn = bundle.render(camera_of()).rgb
    assert drawn.shape == (18, 24, 3)
    with torch.inference_mode():  # its tensors have no version counter
        read = bitymi_ns.read_bundle(tmp_path / "bundle")
        assert torch.equal(read.render(camera_of()).rgb, drawn)
    assert torch.equal(read.render(camera_of()).rgb, drawn)
    held = io.BytesIO()
    torch.save(bundle, held)
    held.seek(0)
    loaded = torch.load(held, weights_only=False)
    for other in (copy.deepcopy(bundle), pickle.loads(pickle.dumps(bundle)), loaded):
        assert torch.equal(other.render(camera_of()).rgb, drawn)
    assert torch.equal(copy.deepcopy(SceneRenderer(bundle.scene)).render(camera_of()).rgb, drawn)


def test_bundles_of_every_format_with_their_cameras(room: Path, tmp_path: Path) -> None:
    views = bitymi_ns.load_capture(room, points="random")[0]
    points = torch.rand(5600, 3) * 2 - 1
    scene, _ = bitymi_ns.train_scene(views, points, torch.rand(5600, 3), steps=1, method="bitymi-notexture")
    assert len(scene) <= 5000 * 1.1  # like ns-train, with its added background points
    scene, _ = bitymi_ns.train_scene(views, points[:100], torch.rand(100, 3), steps=6)
    for options, atlas in (
        (None, "texels.bin"),
        (BakeOptions(format="bc7"), "atlas.ktx2"),
        (BakeOptions(format="fp16"), "atlas.ktx2"),
        (BakeOptions(tolerance=0.0), "atlas.ktx2"),
    ):
        baked = bitymi_ns.bake_scene(scene, views, tmp_path / "bundle", options=options, overwrite=True)
        assert baked.info.atlas.file == atlas and "cameras.json" in baked.info.files
        assert options is None or options.format in (None, baked.info.atlas.format)
        assert len(baked.cameras) == len(views) and not any(row.held_out for row in baked.cameras)
        assert all(torch.equal(row.camera.K, v.camera.K) for row, v in zip(baked.cameras, views, strict=True))
    bitymi_ns.bake_scene(scene, views, tmp_path / "small", target_mb=0.05)
    assert sum(path.stat().st_size for path in (tmp_path / "small").iterdir()) <= 50_000
    for most, options, message in (
        (0.05, BakeOptions(format="bc7"), "target_mb is for compact bundles, and this one's format is bc7"),
        (0.01, None, "a bundle of 0.01 MB leaves no bytes for the scene"),
    ):
        with pytest.raises(ValueError, match=message):
            bitymi_ns.bake_scene(scene, views, tmp_path / "smaller", options=options, target_mb=most)
    with pytest.raises(ValueError, match="a bundle takes from 0.01 to 100,000 MB, not nan"):
        bitymi_ns.bake_scene(scene, views, tmp_path / "smaller", target_mb=float("nan"))
    before = (tmp_path / "bundle" / "bundle.json").read_bytes()
    nan = views[0]._replace(image=torch.full(views[0].image.shape, torch.nan))
    with pytest.raises(ValueError, match=r"views\[0\].image has to be finite"):
        bitymi_ns.bake_scene(scene, [nan, *views[1:]], tmp_path / "bundle", overwrite=True)
    assert (tmp_path / "bundle" / "bundle.json").read_bytes() == before
    for options, message in (
        (BakeOptions(format="webp"), "no format 'webp': choose among compact, bc7, uint8, fp16"),
        (BakeOptions(format="compact", tolerance=0.0), "compact bundle needs a tolerance"),
    ):
        with pytest.raises(ValueError, match=message):
            bitymi_ns.bake_scene(scene, views, tmp_path / "bundle", options=options, overwrite=True)
    with pytest.raises(ValueError, match="no preset 'nerf' in .*, which has bitymi, bitymi-fast"):
        bitymi_ns.train_scene(views, points, points.clamp(0, 1), method="nerf")


def test_a_bundle_of_an_earlier_version_is_replaced(room: Path, tmp_path: Path) -> None:
    """Its cameras.json was not listed."""
    views = bitymi_ns.load_capture(room, points="random")[0]
    scene, _ = bitymi_ns.train_scene(views, torch.rand(50, 3), torch.rand(50, 3), steps=2, method="bitymi-notexture")
    info = bitymi_ns.bake_scene(scene, views, tmp_path / "bundle").info
    del info.files["cameras.json"]
    (tmp_path / "bundle" / "bundle.json").write_bytes(dump(info))
    assert bitymi_ns.read_bundle(tmp_path / "bundle").cameras == []
    with pytest.raises(BundleError, match="is there already"):
        bitymi_ns.bake_scene(scene, views, tmp_path / "bundle")
    assert bitymi_ns.bake_scene(scene, views, tmp_path / "bundle", overwrite=True).cameras
    (tmp_path / "bundle" / "letter.txt").write_text("dear")
    with pytest.raises(BundleError, match="also holds letter.txt"):
        bitymi_ns.bake_scene(scene, views, tmp_path / "bundle", overwrite=True)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["bitymi-field", "bitymi-notexture"])
def test_a_field_and_a_scene_without_texture_are_baked_too(room: Path, tmp_path: Path, method: str) -> None:
    views = bitymi_ns.load_capture(room, points="random")[0]
    steps = []
    points = torch.rand(100, 3) * 2 - 1
    how = dict(steps=6, method=method, eval_views=views[:1], callback=lambda *s: steps.append(s))
    scene, log = bitymi_ns.train_scene(views, points, torch.rand(100, 3), **how)
    assert [step for step, _ in steps] == list(range(1, 7)) and np.isfinite(log.entries[-1].psnr)
    assert len(bitymi_ns.bake_scene(scene, views, tmp_path / method)) <= len(scene)


def test_a_picture_is_fitted_through_rasterize(tmp_path: Path) -> None:
    ramp = np.linspace(0, 255, 32 * 32 * 3).reshape(32, 32, 3).astype(np.uint8)
    Image.fromarray(ramp).save(tmp_path / "ramp.png")
    error = example("fit_image").main(tmp_path / "ramp.png", tmp_path / "fitted.png", surfels=100, steps=40, size=32)
    assert error < 0.02 and Image.open(tmp_path / "fitted.png").size == (32, 32)


def test_examples_are_short() -> None:
    for path in (ROOT / "examples").glob("*.py"):
        assert len(path.read_text("utf8").splitlines()) <= 60, path
