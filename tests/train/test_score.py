import math

import pytest
import torch

from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.losses import photometric
from bitymi_ns.train.score import MOST_ERROR, bad_pixels, multi_view_scores, normalise, removal_errors
from bitymi_ns.train.views import View


def test_normalise():
    torch.testing.assert_close(normalise(torch.tensor([2.0, 4, 3])), torch.tensor([0.0, 1, 0.5]))
    assert normalise(torch.full((3,), 7.0)).tolist() == [0, 0, 0]
    assert normalise(torch.tensor([0.0, math.inf])).tolist() == [0, 0]
    assert normalise(torch.zeros(0)).shape == (0,)


def test_bad_pixels_are_relative_to_the_worst_pixel_that_counts():
    rgb, target = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)
    target[0, 0], target[0, 1], target[1, 0] = 0.8, 0.05, 0.2
    assert bad_pixels(rgb, target, 0.1).tolist() == [[True, False], [True, False]]
    mask = torch.tensor([[False, True], [True, True]])
    assert bad_pixels(rgb, target, 0.1, mask).tolist() == [[False, True], [True, False]]
    assert not bad_pixels(rgb, rgb, 0.1).any()
    assert not bad_pixels(rgb, target, 0.1, torch.zeros(2, 2, dtype=torch.bool)).any()


def test_scores_count_fragments_on_bad_pixels(make_scene, views):
    scene, config = make_scene(), TrainConfig()
    masked = views[2]._replace(mask=torch.arange(48)[:, None].expand(48, 48) > 20)
    chosen = [views[0], views[1], masked]
    scores = multi_view_scores(scene, chosen, config)
    counts = torch.zeros(3, len(scene), dtype=torch.int64)
    losses = []
    for j, (camera, image, mask, *_) in enumerate(chosen):
        with torch.no_grad():
            output = scene.render(camera)
        bad = bad_pixels(output.rgb, image, 0.1, mask).flatten()
        for surfel, pixel in zip(output.fragments.surfel.tolist(), output.fragments.pixel.tolist(), strict=True):
            counts[j, surfel] += bool(bad[pixel])
        losses.append(photometric(output.rgb, image, 0.2, mask).item())
    assert counts.sum() > 100
    assert scores.importance.tolist() == (counts.sum(0) // 3).tolist()
    expected = normalise((torch.tensor(losses).double()[:, None] * counts).sum(0))
    torch.testing.assert_close(scores.prune.double(), expected, atol=1e-6, rtol=1e-5)
    assert all(p.grad is None for p in scene.parameters())


def test_no_views_and_perfect_views_give_zero_scores(make_scene, views):
    scene = make_scene(texture=False)
    with torch.no_grad():
        perfect = View(views[0].camera, scene.render(views[0].camera).rgb)
    random, black = (multi_view_scores(scene, views[:2], TrainConfig(background=b)) for b in ("random", "black"))
    assert random.importance.tolist() == black.importance.tolist()
    for chosen in ([], [perfect]):
        scores = multi_view_scores(scene, chosen, TrainConfig())
        assert scores.importance.sum() == 0 and scores.prune.sum() == pytest.approx(0)


def test_removal_errors_are_those_of_removed_surfels(make_scene, views):
    scene, config = make_scene(), TrainConfig()
    mask = torch.arange(48)[:, None].expand(48, 48) > 20
    chosen = [views[0], views[1], views[2]._replace(mask=mask)]
    with torch.no_grad():
        scene.surfels["means"][0] = torch.tensor([0.0, 0.0, 500.0])  # seen by no view
        full = [scene.render(view.camera).rgb for view in chosen]
        exact, logits = torch.zeros(len(scene), dtype=torch.float64), scene.surfels["opacity_logits"]
        for row, logit in enumerate(logits.tolist()):
            logits[row] = -20.0
            for view, rgb in zip(chosen, full, strict=True):
                change = (scene.render(view.camera).rgb - rgb).square().sum(-1).double()
                exact[row] += change[view.mask].sum() if view.mask is not None else change.sum()
            logits[row] = logit
        present = sum(
            (rgb - view.image).square().sum(-1)[... if view.mask is None else view.mask].sum().item()
            for rgb, view in zip(full, chosen, strict=True)
        )
    found = [removal_errors(scene, chosen, config, 1000 * seed) for seed in range(200)]
    assert present > MOST_ERROR * 3 * (2 * 48 + 27) * 48
    assert all(total.item() == pytest.approx(MOST_ERROR * 3 * (2 * 48 + 27) * 48) for _, total in found)
    near = [view._replace(image=rgb + 0.01) for view, rgb in zip(chosen, full, strict=True)]
    assert removal_errors(scene, near, config, 0)[1].item() == pytest.approx(1e-4 * 3 * (2 * 48 + 27) * 48, rel=1e-3)
    added = torch.stack([errors for errors, _ in found])
    assert added[:, 0].eq(0).all() and exact[0] == 0
    # each estimate has a standard deviation of at most sqrt(2) of its mean
    torch.testing.assert_close(added.mean(0), exact, rtol=0.45, atol=1e-6)
    assert added.mean(0).sum().item() == pytest.approx(exact.sum().item(), rel=0.1)
    assert all(p.grad is None for p in scene.parameters())


def test_removal_errors_of_an_opaque_surfel_are_finite(make_scene, views):
    scene = make_scene()
    with torch.no_grad():
        scene.surfels["opacity_logits"][:3] = torch.tensor([40.0, 500.0, -500.0])
    errors, present = removal_errors(scene, views[:1], TrainConfig(), 0)
    assert errors.isfinite().all() and present.isfinite()
    errors, present = removal_errors(scene, [], TrainConfig(), 0)
    assert errors.sum() == 0 and present == 0
