"""Optimisers stepped by one kernel equal those that step themselves."""

import pytest
import torch
from torch.nn import Parameter
from torch.optim import SGD, Adam, Optimizer

from bitymi_ns.train import optimizers as module
from bitymi_ns.train.optimizers import adam, forget_gradients, step

RATES = (1e-2, 1e-2, 3e-4, 0.0)


def optimizers(device: torch.device | str = "cpu") -> dict[str, Optimizer]:
    g = torch.Generator().manual_seed(0)
    made: dict[str, Optimizer] = {}
    for number, rate in enumerate(RATES):
        parameters = [Parameter(torch.randn(7 + i, 3, generator=g).to(device)) for i in range(1 + number % 2)]
        made[str(number)] = adam(parameters, (0.9, 0.99 + 0.009 * (number // 2)))
        made[str(number)].param_groups[0]["lr"] = rate
    made["decayed"] = Adam([Parameter(torch.randn(5, generator=g).to(device))], lr=1e-2, weight_decay=0.1)
    made["unfused"] = Adam([Parameter(torch.randn(5, generator=g).to(device))], lr=1e-2, foreach=False, fused=False)
    made["other"] = SGD([Parameter(torch.randn(5, generator=g).to(device))], lr=1e-2)
    return made


def parameters_of(given: dict[str, Optimizer]) -> list[Parameter]:
    return [p for optimizer in given.values() for group in optimizer.param_groups for p in group["params"]]


@pytest.mark.parametrize("left_out", [(), (0, 3), tuple(range(9))], ids=["all", "some", "none"])
def test_a_step_together_is_a_step_of_each(left_out: tuple[int, ...], device: torch.device) -> None:
    together, alone = optimizers(device), optimizers(device)
    g = torch.Generator().manual_seed(1)
    for number in range(4):
        gradients = [torch.randn(p.shape, generator=g) for p in parameters_of(together)]
        for given in (together, alone):
            for i, (p, gradient) in enumerate(zip(parameters_of(given), gradients, strict=True)):
                p.grad = None if number == 2 and i in left_out else gradient.to(device, copy=True)
        step(together, {})
        for optimizer in alone.values():
            optimizer.step()
        for a, b in zip(parameters_of(together), parameters_of(alone), strict=True):
            torch.testing.assert_close(a, b)
    for name, optimizer in together.items():
        a, b = (o.state_dict()["state"] for o in (optimizer, alone[name]))
        assert a.keys() == b.keys()
        for row, state in b.items():
            torch.testing.assert_close(a[row], state)
    forget_gradients(together.values())
    assert all(p.grad is None for p in parameters_of(together))


def test_steps_of_rows_are_scaled(device: torch.device) -> None:
    """Including the first step, which the optimiser itself takes."""
    scaled, plain = optimizers(device), optimizers(device)
    factor = torch.linspace(0.0, 3.0, 7, device=device)
    g = torch.Generator().manual_seed(1)
    for _ in range(3):
        gradients = [torch.randn(p.shape, generator=g) for p in parameters_of(scaled)]
        before = {id(p): p.detach().clone() for p in parameters_of(scaled) + parameters_of(plain)}
        for given in (scaled, plain):
            for p, gradient in zip(parameters_of(given), gradients, strict=True):
                p.grad = gradient.to(device, copy=True)
        step(scaled, {"0": factor, "unknown": factor})
        step(plain, {})
        for i, (a, b) in enumerate(zip(parameters_of(scaled), parameters_of(plain), strict=True)):
            moved = (p.detach() - before[id(p)] for p in (a, b))
            by = factor[:, None] if i == 0 else 1.0
            a_moved, b_moved = moved
            torch.testing.assert_close(a_moved, by * b_moved, rtol=1e-4, atol=1e-6)


def test_where_torch_has_no_fused_adam_each_steps_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """As before torch 2.4 on the CPU."""

    class Older(Adam):
        def __init__(self, *args, fused: bool, **options) -> None:
            if fused:
                raise RuntimeError("`fused=True` requires all the params to be on supported devices: ['cuda']")
            super().__init__(*args, fused=fused, **options)

    fused = optimizers()
    with monkeypatch.context() as older:
        older.setattr(module, "Adam", Older)
        older.setattr(module, "_fuses", module._fuses.__wrapped__)
        plain = optimizers()
        for given in (fused, plain):
            g = torch.Generator().manual_seed(1)
            for p in 3 * parameters_of(given):
                p.grad = torch.randn(p.shape, generator=g)
                step(given, {})
    for a, b in zip(parameters_of(fused), parameters_of(plain), strict=True):
        torch.testing.assert_close(a, b)


def test_a_lack_of_memory_is_no_lack_of_the_fused_form(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **options: object) -> None:
        raise RuntimeError(why)

    monkeypatch.setattr(module, "Adam", fails)
    for why in ("CUDA out of memory", "`fused=True` is not supported"):
        module._fuses.cache_clear()
        if "memory" in why:
            with pytest.raises(RuntimeError, match="memory"):
                module._fuses("cpu")
        else:
            assert not module._fuses("cpu")
    module._fuses.cache_clear()
