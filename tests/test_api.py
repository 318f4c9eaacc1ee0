"""The public functions, and the examples that use them."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

import bitymi_ns
from bitymi_ns import sample
from bitymi_ns.ops.reference.render import render as reference_render

ROOT = Path(__file__).resolve().parents[1]


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


def test_rasterize_gives_values_and_gradients_of_the_float64_reference() -> None:
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


def test_a_scene_is_trained_baked_read_and_rendered_from_arrays(room: Path, tmp_path: Path) -> None:
    psnr = example("train_from_arrays").main(room, tmp_path / "bundle", steps=60, points=300)
    assert psnr > 8.0
    paths = example("render_bundle").main(tmp_path / "bundle", tmp_path / "pictures", most=2)
    assert [Image.open(path).size for path in paths] == [(48, 36)] * 2
    bundle = bitymi_ns.read_bundle(tmp_path / "bundle")
    assert bundle.render(camera_of()).rgb.shape == (18, 24, 3)


@pytest.mark.parametrize("method", ["bitymi-field", "bitymi-notexture"])
def test_a_field_and_a_scene_without_texture_are_baked_too(room: Path, tmp_path: Path, method: str) -> None:
    views = example("train_from_arrays").load_views(room)
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
