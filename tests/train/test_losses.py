import math

import pytest
import torch

from bitymi_ns import ops
from bitymi_ns.train.config import LossConfig, TrainConfig
from bitymi_ns.train.fit import fit
from bitymi_ns.train.losses import (
    color_fitted,
    error_weight,
    fitted_psnr,
    mean_psnr,
    mean_where_right,
    objective,
    photometric,
    psnr,
)
from tests.stand_in_card import CARD, noted_reads


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
    values = torch.rand(20, 24, 1)
    mean = mean_where_right(error_weight(rgb, target, 2.0, mask=mask), values, mask)
    torch.testing.assert_close(mean, (error_weight(rgb, target, 2.0) * values)[mask].mean())


def test_nothing_counts():
    mask = torch.zeros(16, 16, dtype=torch.bool)
    rgb = torch.rand(16, 16, 3, requires_grad=True)
    target = torch.zeros(16, 16, 3)
    omega = error_weight(rgb, target, 25.0, mask=mask)
    loss = photometric(rgb, target, 0.2, mask) + mean_where_right(omega, torch.ones(16, 16, 1), mask)
    loss.backward()
    assert loss == 0 and (rgb.grad == 0).all()


def test_error_weight_follows_the_paper(pair):
    rgb, target = pair
    l1 = (rgb - target).abs().sum(-1, keepdim=True)
    torch.testing.assert_close(error_weight(rgb, target, 25.0), torch.exp(-25 * l1))


def test_falloff_gives_no_gradient_to_the_colours(pair):
    rgb, target = pair
    a, beta = rgb.clone().requires_grad_(), torch.rand(20, 24, 1).requires_grad_()
    mean_where_right(error_weight(a, target, 25.0), beta).backward()
    assert a.grad is None
    torch.testing.assert_close(beta.grad, error_weight(rgb, target, 25.0) / (20 * 24))


def test_objective_has_the_terms_that_are_on(make_scene, views):
    scene = make_scene(texture=False)
    output, target = scene.render(views[0].camera), views[0].image
    terms = objective(output, target, LossConfig())
    assert set(terms) == {"photometric", "falloff"}
    omega = error_weight(output.rgb, target, 25.0)
    torch.testing.assert_close(terms["falloff"], 0.005 * mean_where_right(omega, output.beta))
    assert set(objective(output, target, LossConfig(falloff_weight=0.0))) == {"photometric"}
    output = scene.render(views[0].camera, overdraw_half=0.005)
    both = objective(output, target, LossConfig(falloff_weight=0.0, overdraw_weight=0.002))
    assert set(both) == {"photometric", "overdraw"}
    torch.testing.assert_close(both["overdraw"], 0.002 * mean_where_right(omega, output.soft_overdraw))


def test_a_background_changes_the_colours_alone(make_scene, views):
    scene, background = make_scene(), torch.tensor([0.2, 0.7, 0.4])
    over, black = (scene.render(views[0].camera, b) for b in (background, None))
    torch.testing.assert_close(over.rgb, black.rgb + (1 - black.alpha) * background)
    assert torch.equal(over.alpha, black.alpha) and torch.equal(over.beta, black.beta)


def test_psnr_of_a_known_error() -> None:
    a = torch.full((8, 8, 3), 0.5)
    assert psnr(a + 0.1, a) == pytest.approx(20.0, abs=1e-4)
    assert psnr(a, a) == 100.0
    mask = torch.zeros(8, 8, 1, dtype=torch.bool)
    mask[:2] = True
    b = a.clone()
    b[2:] = 0.0  # masked out
    assert psnr(b, a, mask) == 100.0
    assert psnr(b, a, ~mask) < 10
    assert math.isnan(psnr(a, a, torch.zeros(8, 8, dtype=torch.bool)))
    assert mean_psnr([20.0, math.nan, 30.0]) == 25.0
    assert math.isnan(mean_psnr([math.nan])) and math.isnan(mean_psnr([]))


def test_the_overdraw_loss_leaves_fewer_fragments(make_scene, views):
    counts = []
    for weight in (0.0, 1.0):
        scene = make_scene(texture=False, every=1)
        loss = LossConfig(overdraw_weight=weight, overdraw_start=0, overdraw_stop=30_000)
        log = fit(scene, views, views, TrainConfig(loss=loss), 40)
        counts.append(log.entries[-1].fragments)
    assert counts[1] < 0.9 * counts[0]


def test_an_affine_change_of_colours_is_undone() -> None:
    g = torch.Generator().manual_seed(0)
    image = 0.2 + 0.5 * torch.rand(16, 19, 3, generator=g)
    matrix, offset = torch.eye(3) + 0.1 * torch.randn(3, 3, generator=g), torch.tensor([0.05, -0.02, 0.1])
    target = (image @ matrix.T + offset).clamp(0.0, 1.0)
    assert psnr(image, target) < 25
    torch.testing.assert_close(color_fitted(image, target), target, atol=2e-3, rtol=0)
    mask = torch.rand(16, 19, generator=g) < 0.5
    spoilt = torch.where(mask[..., None], target, math.nan)
    torch.testing.assert_close(color_fitted(image, spoilt, mask), target, atol=2e-3, rtol=0)
    assert math.isnan(fitted_psnr(image, image, torch.zeros(16, 19, dtype=torch.bool)))


def test_no_half_is_judged_by_a_fit_of_its_own() -> None:
    g = torch.Generator().manual_seed(0)
    image = 0.2 + 0.5 * torch.rand(16, 20, 3, generator=g)
    left = (torch.arange(20) < 10)[None, :, None]
    target = torch.where(left, 1.3 * image, image)  # like with a brighter left half only
    fitted = color_fitted(image, target)
    torch.testing.assert_close(fitted, torch.where(left, image, 1.3 * image).clamp(max=1.0), atol=2e-3, rtol=0)
    assert fitted_psnr(image, target) < psnr(image, target)
    # the left half is masked out or not finite: the right one is unchanged
    few = ~left[..., 0].expand(16, 20)
    few = few | (torch.arange(320).view(16, 20) == 21)  # one pixel of the left half
    broken = image.clone()
    broken[3, 3, 0] = math.nan
    for given, mask in ((image, few), (broken, None)):
        assert torch.equal(color_fitted(given, target, mask)[:, 10:], image[:, 10:])


@pytest.mark.parametrize("contrast", [0.0, 1e-4, 1e-3])
def test_colours_that_a_half_does_not_show_keep_their_contrast(contrast: float) -> None:
    g = torch.Generator().manual_seed(0)
    image, noise = torch.rand(16, 20, 3, generator=g), 0.004 * torch.randn(16, 20, 3, generator=g)
    image[:, :10] = 0.4 + contrast * (image[:, :10] - 0.5)
    target = image + noise
    assert fitted_psnr(image, target) > psnr(image, target) - 1.0


def test_of_a_picture_on_a_card_only_sums_are_read() -> None:
    image, target = torch.rand(2, 20, 30, 3, generator=torch.Generator().manual_seed(0))
    with noted_reads() as reads:
        found = fitted_psnr(image.to(CARD), target.to(CARD))
    assert reads == [56, 1] and found == pytest.approx(fitted_psnr(image, target), abs=1e-6)
