from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bitymi_ns import ops
from bitymi_ns.train.config import LossConfig, TrainConfig
from bitymi_ns.train.losses import beta_only_map, error_weight, falloff, objective, overdraw, photometric, psnr
from bitymi_ns.train.trainer import fit


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(20, 24, 3, generator=generator), torch.rand(20, 24, 3, generator=generator)


def test_photometric_is_the_weighted_sum(pair):
    rgb, target = pair
    expected = 0.8 * (rgb - target).abs().mean() + 0.2 * (1 - ops.ssim(rgb, target))
    torch.testing.assert_close(photometric(rgb, target, 0.2), expected)
    assert photometric(rgb, rgb, 0.2) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (10, 10)])
def test_images_without_an_ssim_window_are_judged_by_l1(size):
    rgb, target = torch.full((*size, 3), 0.25), torch.full((*size, 3), 0.5)
    assert photometric(rgb, target, 0.2) == pytest.approx(0.25)


@pytest.mark.parametrize("shape", [(20, 24), (20, 24, 1)])
def test_excluded_pixels_have_no_say(pair, shape):
    rgb, target = pair
    mask = torch.ones(20, 24, dtype=torch.bool)
    mask[3:9, 5:20] = False
    poisoned = target.clone()
    poisoned[~mask] = math.nan
    a = rgb.clone().requires_grad_()
    loss = photometric(a, poisoned, 0.2, mask.reshape(shape))
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(a.grad).all()
    assert (a.grad[~mask] == 0).all() and (a.grad[mask] != 0).any()
    other = rgb.clone()
    other[~mask] = 0.7
    assert photometric(other, target, 0.2, mask) == pytest.approx(loss.item())
    l1 = (rgb - target).abs()[mask].mean()
    assert photometric(rgb, target, 0.0, mask) == pytest.approx(l1.item())


def test_nothing_counts():
    mask = torch.zeros(16, 16, dtype=torch.bool)
    rgb = torch.rand(16, 16, 3, requires_grad=True)
    target = torch.zeros(16, 16, 3)
    omega = error_weight(rgb, target, 25.0, mask=mask)
    loss = photometric(rgb, target, 0.2, mask) + falloff(omega, torch.ones(16, 16, 1), mask)
    loss.backward()
    assert loss == 0 and (rgb.grad == 0).all()


def test_error_weight_follows_the_paper(pair):
    rgb, target = pair
    l1 = (rgb - target).abs().sum(-1, keepdim=True)
    torch.testing.assert_close(error_weight(rgb, target, 25.0), torch.exp(-25 * l1))
    mse = ((rgb - target) ** 2).mean(-1, keepdim=True)
    torch.testing.assert_close(error_weight(rgb, target, 25.0, "mse"), torch.exp(-25 * mse))
    with pytest.raises(ValueError, match="falloff_error"):
        error_weight(rgb, target, 25.0, "l2")


def test_falloff_gives_no_gradient_to_the_colours(pair):
    rgb, target = pair
    a, beta = rgb.clone().requires_grad_(), torch.rand(20, 24, 1).requires_grad_()
    falloff(error_weight(a, target, 25.0), beta).backward()
    assert a.grad is None
    torch.testing.assert_close(beta.grad, error_weight(rgb, target, 25.0) / (20 * 24))


def test_beta_only_moves_beta_alone(make_scene, views):
    scene = make_scene(texture=False)
    output = scene.render(views[0].camera)
    beta = beta_only_map(output, scene.surfels["beta_raw"])
    torch.testing.assert_close(beta, output.beta)
    falloff(error_weight(output.rgb, views[0].image, 25.0), beta).backward()
    moved = [name for name, p in scene.surfels.items() if p.grad is not None and (p.grad != 0).any()]
    assert moved == ["beta_raw"]
    output = scene.render(views[0].camera)
    falloff(error_weight(output.rgb, views[0].image, 25.0), output.beta).backward()
    assert (scene.surfels["opacity_logits"].grad != 0).any()


def test_objective_has_the_terms_that_are_on(make_scene, views):
    scene = make_scene(texture=False)
    output, target = scene.render(views[0].camera), views[0].image
    beta_raw = scene.surfels["beta_raw"]
    terms = objective(output, target, beta_raw, LossConfig())
    assert set(terms) == {"photometric", "falloff"}
    omega = error_weight(output.rgb, target, 25.0)
    torch.testing.assert_close(terms["falloff"], 0.005 * falloff(omega, output.beta))
    same = objective(output, target, beta_raw, LossConfig(falloff_gradient="beta_only"))
    torch.testing.assert_close(same["falloff"], terms["falloff"])
    assert set(objective(output, target, beta_raw, LossConfig(falloff_weight=0.0))) == {"photometric"}
    both = objective(output, target, beta_raw, LossConfig(falloff_weight=0.0, overdraw_weight=0.002))
    assert set(both) == {"photometric", "overdraw"}
    torch.testing.assert_close(both["overdraw"], 0.002 * overdraw(omega, output.fragments, 0.005))


def test_psnr_of_a_known_error() -> None:
    a = torch.full((8, 8, 3), 0.5)
    assert psnr(a + 0.1, a) == pytest.approx(20.0, abs=1e-4)
    assert psnr(a, a) == 100.0
    mask = torch.zeros(8, 8, 1, dtype=torch.bool)
    mask[:2] = True
    b = a.clone()
    b[2:] = 0.0  # where it does not count
    assert psnr(b, a, mask) == 100.0
    assert psnr(b, a, ~mask) < 10 and psnr(b, a, torch.zeros_like(mask)) == 100.0


def test_overdraw_counts_the_fragments_of_pixels_that_are_right(make_scene, views):
    scene = make_scene(texture=False, every=1)
    output, target = scene.render(views[0].camera), views[0].image
    fragments = output.fragments
    count = fragments.overdraw().float()
    everywhere = torch.ones_like(count)
    # a half of 0 in the limit: the mean overdraw
    torch.testing.assert_close(overdraw(everywhere, fragments, 1e-9), count.mean(), rtol=1e-3, atol=0)
    right = (torch.rand(count.shape, generator=torch.Generator().manual_seed(0)) < 0.5).float()
    torch.testing.assert_close(overdraw(right, fragments, 1e-9), (right * count).mean(), rtol=1e-3, atol=0)
    mask = right.bool().squeeze(-1)
    omega = error_weight(output.rgb, target, 25.0, mask=mask)
    expected = torch.zeros(count.numel(), dtype=torch.float64)
    w = fragments.weight.detach().double()
    expected.index_add_(0, fragments.pixel.long(), w / (w + 0.005))
    expected = (omega.double().flatten() * expected).sum() / mask.sum()
    torch.testing.assert_close(overdraw(omega, fragments, 0.005, mask).double(), expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize("half", [1e-9, 0.005, 10.0])
def test_overdraw_gradient(make_scene, views, half):
    fragments = make_scene(texture=False).render(views[0].camera).fragments
    n = 50
    w = torch.linspace(1e-4, 1, n, dtype=torch.float64, requires_grad=True)
    part = replace(fragments, weight=w, pixel=torch.arange(n, dtype=torch.int32) % 12)
    omega = torch.rand(3, 4, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.autograd.gradcheck(lambda w: overdraw(omega, replace(part, weight=w), half), w)


def test_overdraw_of_extreme_weights_is_finite(make_scene, views):
    fragments = make_scene(texture=False).render(views[0].camera).fragments
    w = torch.tensor([0.0, 1e-45, 1e-38, 1e-30, 1e-8, 1.0], requires_grad=True)
    part = replace(fragments, weight=w, pixel=torch.zeros(6, dtype=torch.int32))
    loss = overdraw(torch.ones(1, 1, 1), part, 1e-9)
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(w.grad).all() and (w.grad >= 0).all()
    empty = replace(fragments, weight=w[:0], pixel=part.pixel[:0])
    assert overdraw(torch.ones(1, 1, 1), empty, 0.005) == 0
    with pytest.raises(ValueError, match="overdraw_half must be above 0"):
        overdraw(torch.ones(1, 1, 1), part, 0.0)


def test_the_overdraw_loss_leaves_fewer_fragments(make_scene, views):
    counts = []
    for weight in (0.0, 0.2):
        scene = make_scene(texture=False, every=1)
        config = TrainConfig(loss=LossConfig(overdraw_weight=weight))
        log = fit(scene, views, views, config, 40)
        counts.append(log.entries[-1].fragments)
    assert counts[1] < 0.9 * counts[0]
