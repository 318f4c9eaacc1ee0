import pytest
import torch
from torch.nn import Parameter, ParameterDict

from bitymi_ns.train.optimizers import adam, cap_opacity, replace_rows


def table(n=6):
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (n, 3), "opacity_logits": (n,)}
    surfels = ParameterDict({name: Parameter(torch.randn(s, generator=generator)) for name, s in shapes.items()})
    return surfels, {name: adam([p]) for name, p in surfels.items()}


def descend(surfels, optimizers, steps=3):
    for _ in range(steps):
        for name, optimizer in optimizers.items():
            optimizer.param_groups[0]["lr"] = 0.1
            optimizer.zero_grad()
            weights = torch.arange(1.0, 1 + surfels[name].numel()).view_as(surfels[name])
            (surfels[name].square() * weights).sum().backward()
            optimizer.step()


def test_rows_keep_their_moments_and_new_rows_start_from_zero():
    surfels, optimizers = table()
    descend(surfels, optimizers)
    before = {name: p.detach().clone() for name, p in surfels.items()}
    moments = {name: optimizers[name].state[p]["exp_avg"].clone() for name, p in surfels.items()}
    told = {}
    keep = torch.tensor([4, 0, 2])
    new = {name: torch.zeros(2, *p.shape[1:]) for name, p in surfels.items()}
    replace_rows(surfels, optimizers, keep, new, lambda name, p: told.__setitem__(name, p))
    for name, p in surfels.items():
        state = optimizers[name].state[p]
        assert told[name] is p and optimizers[name].param_groups[0]["params"] == [p]
        assert len(optimizers[name].state) == 1  # nothing of the old parameter remains
        assert p.requires_grad and p.is_contiguous() and p.shape[0] == 5
        torch.testing.assert_close(p[:3], before[name][keep])
        torch.testing.assert_close(state["exp_avg"][:3], moments[name][keep])
        assert (state["exp_avg"][3:] == 0).all() and (state["exp_avg_sq"][3:] == 0).all()
        assert state["step"].item() == 3
    descend(surfels, optimizers, 1)


def test_before_the_first_step_and_with_other_optimizers():
    surfels, optimizers = table()
    del optimizers["means"]
    replace_rows(surfels, optimizers, torch.tensor([1]))
    assert {len(p) for p in surfels.values()} == {1}
    descend(surfels, optimizers, 1)


@pytest.mark.parametrize("forget_all", [False, True])
def test_capped_opacities_forget_their_momentum(forget_all):
    surfels, optimizers = table()
    descend(surfels, optimizers)
    logits = surfels["opacity_logits"]
    with torch.no_grad():
        logits.copy_(torch.tensor([-8.0, -1, 0, 1, 2, 9]))
    assert cap_opacity(surfels, optimizers, 0.6, forget_all) == 3
    assert surfels["opacity_logits"] is logits
    torch.testing.assert_close(logits.sigmoid()[3:], torch.full((3,), 0.6))
    torch.testing.assert_close(logits[:3], torch.tensor([-8.0, -1, 0]))
    moment = optimizers["opacity_logits"].state[logits]["exp_avg"]
    assert (moment[3:] == 0).all()
    assert bool((moment[:3] == 0).all()) == forget_all
