import pytest
import torch

from bitymi_ns.scene.camera import Camera
from bitymi_ns.train import views as views_module
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.views import (
    DownscaledViews,
    View,
    as_float,
    at_size,
    covered_fraction,
    downscale_image,
    downscale_mask,
    eval_background,
    over_background,
    step_background,
    training_order,
)


def test_area_average():
    image = torch.rand(8, 12, 3)
    small = downscale_image(image, 6, 4)
    torch.testing.assert_close(small, image.reshape(4, 2, 6, 2, 3).mean((1, 3)))
    assert downscale_image(image, 12, 8) is image
    image = torch.zeros(2, 2, 4)  # hidden colors do not bleed in
    image[0, 0], image[0, 1] = torch.tensor([1.0, 0.5, 0.0, 1.0]), torch.tensor([0.0, 1.0, 1.0, 0.0])
    torch.testing.assert_close(downscale_image(image, 1, 1)[0, 0], torch.tensor([1.0, 0.5, 0.0, 0.25]))
    mask = torch.ones(4, 4, dtype=torch.bool)
    mask[0, 3] = False  # a reduced pixel counts only if all of it does
    assert downscale_mask(mask, 2, 2)[..., 0].tolist() == [[True, False], [True, True]]
    assert as_float(torch.tensor([0, 255], dtype=torch.uint8)).tolist() == [0, 1]


def test_the_pixels_that_count_are_counted_once_at_each_size(monkeypatch: pytest.MonkeyPatch) -> None:
    mask = torch.rand(8, 12, generator=torch.Generator().manual_seed(0)) < 0.9
    camera = Camera(torch.eye(4), torch.eye(3), 12, 8)
    views = DownscaledViews([View(camera, torch.rand(8, 12, 3), mask), View(camera, torch.rand(8, 12, 3))])
    for factor, count in ((1.0, mask.sum()), (0.5, downscale_mask(mask, 6, 4).sum())):
        assert views.at(0, factor).counted == count and views.at(1, factor).counted is None
        with monkeypatch.context() as patch:
            patch.setattr(torch.Tensor, "sum", None)
            assert views.at(0, factor).counted == count


def test_photographs_keep_their_own_correction_where_the_run_finds_none() -> None:
    camera, own, found = Camera(torch.eye(4), torch.eye(3), 12, 8), torch.full((3,), 0.5), torch.full((3,), 2.0)
    view = View(camera, torch.rand(8, 12, 3), correction=own)
    views = DownscaledViews([view, view], correction=lambda index: found if index else None)
    assert views.at(0, 0.5).correction is own and views.at(1, 0.5).correction is found


def test_background():
    image, color = torch.tensor([[[1.0, 1.0, 1.0, 0.25]]]), torch.tensor([0.2, 0.4, 0.9])
    torch.testing.assert_close(over_background(image, color)[0, 0], 0.25 + 0.75 * color)
    assert over_background(image, None)[0, 0].tolist() == [0.25] * 3


def test_photographs_with_alpha_train_over_another_colour_in_every_step_and_are_judged_over_one():
    camera = Camera(torch.eye(4), torch.eye(3), 2, 2)
    opaque, transparent = View(camera, torch.ones(2, 2, 3)), View(camera, torch.ones(2, 2, 4))
    config = TrainConfig(seed=3)
    assert step_background(config, opaque, 5, "cpu") is None and eval_background(config, "cpu") is None
    drawn = step_background(config, transparent, 5, "cpu")
    assert torch.equal(drawn, step_background(config, transparent, 5, "cpu")) and drawn.unique().numel() == 3
    assert (drawn != step_background(config, transparent, 6, "cpu")).all()
    white = TrainConfig(alpha_color="white")
    assert torch.equal(eval_background(white, "cpu"), torch.ones(3))
    assert torch.equal(step_background(white, opaque, 5, "cpu"), torch.ones(3))
    for view in (opaque, transparent):
        assert step_background(TrainConfig(background="white"), view, 5, "cpu").tolist() == [1, 1, 1]
        assert step_background(TrainConfig(background="black"), view, 5, "cpu") is None
    assert eval_background(TrainConfig(background="black", alpha_color="white"), "cpu") is None


def test_a_picture_of_another_size_is_refused(cameras):
    with pytest.raises(ValueError, match="image is 10 x 9"):
        at_size(View(cameras[0], torch.zeros(9, 10, 3)), cameras[0], "cpu")
    with pytest.raises(ValueError, match="mask is 10 x 9"):
        at_size(View(cameras[0], torch.zeros(48, 48, 3), torch.ones(9, 10) > 0), cameras[0], "cpu")


def test_reduced_views_take_only_so_much_memory(views, monkeypatch: pytest.MonkeyPatch) -> None:
    everything = DownscaledViews(views)
    half = everything.at(1, 0.5)
    assert half.image.shape == (24, 24, 3) and (half.camera.width, half.camera.height) == (24, 24)
    assert everything.at(1, 0.5) is half and everything.at(1, 1.0).image.shape == (48, 48, 3)
    drawn = everything.draw(4, torch.Generator().manual_seed(1), 1.0)
    assert len({id(view.camera) for view in drawn}) == 4
    assert len(everything.draw(10, torch.Generator(), 1.0)) == len(views)
    monkeypatch.setattr(views_module, "DOWNSCALED_BYTES", 2 * everything.at(0, 0.5).nbytes)
    few = DownscaledViews(views)
    for factor in (0.5, 0.25, 0.5):  # memory is reused at every size
        for _ in range(2):
            pairs = [(few.at(i, factor), everything.at(i, factor)) for i in range(len(views))]
        assert all(torch.equal(a.image, b.image) for a, b in pairs)
        again = [few.at(i, factor) is pairs[i][0] for i in range(len(views))]
        assert sum(again) == min(len(views), 2 if factor == 0.5 else 8)


def test_a_card_keeps_photographs_within_one_budget(views) -> None:
    """Full-size and reduced pictures together stay within it at every size, and all views come out the same."""
    everything, full = DownscaledViews(views), views[0].nbytes
    bounded = DownscaledViews(views, resident_bytes=2 * full + full // 2)
    for factor in (0.5, 0.25, 1.0, 0.5):
        for i in [*range(len(views))] * 2:
            assert torch.equal(bounded.at(i, factor).image, everything.at(i, factor).image)
        held = sum(view.nbytes for held in (bounded._resident, bounded._kept) for view in held.values())
        assert held + bounded._budget.left == 2 * full + full // 2 and bounded._budget.left >= 0
    assert len(bounded._resident) == 2


def test_pixels_that_show_something(cameras) -> None:
    camera, opaque = cameras[0], torch.rand(4, 10, 3)
    half = torch.cat([opaque, torch.zeros(4, 10, 1)], -1)
    half[:, :5, 3] = 0.2
    mask = torch.ones(4, 10, 1, dtype=torch.bool)
    mask[:2] = False
    shares = {
        1.0: View(camera, opaque),
        0.5: View(camera, (255 * half).to(torch.uint8)),
        0.25: View(camera, half, mask[..., 0]),
    }
    for share, view in shares.items():
        assert covered_fraction([view]) == pytest.approx(share)
    assert covered_fraction([View(camera, opaque, mask)]) == pytest.approx(0.5)
    assert covered_fraction([shares[1.0], shares[0.5]]) == pytest.approx(0.75) and covered_fraction([]) == 0
    assert covered_fraction([shares[1.0]] * 300) == 1


def test_every_view_comes_once_an_epoch():
    epochs = [[training_order(7, 0, step) for step in range(7 * e, 7 * e + 7)] for e in range(4)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert epochs[0] != epochs[1]
    assert [training_order(7, 1, step) for step in range(7)] != epochs[0]
