"""The GPU is used if the kernels can run on it; otherwise a message says why and what to do."""

import sys
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import pytest
import torch

from bitymi_ns.plugin import console
from bitymi_ns.plugin.run import device


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """A stub GPU and a stub module of kernels that accepts it."""
    kernels = ModuleType("bitymi_ns._cuda")
    kernels.device_problem = lambda number: ""
    monkeypatch.setitem(sys.modules, "bitymi_ns._cuda", kernels)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: kernels)
    device._device_problem.cache_clear()
    console.warn_once.cache_clear()
    yield kernels
    device._device_problem.cache_clear()


def test_a_usable_card_is_used(card: ModuleType) -> None:
    assert device.has_cuda_kernels() and device.kernel_device("cuda:0") == torch.device("cuda:0")
    assert device.kernel_device("cpu").type == "cpu"


def test_an_unusable_card_is_left_alone_with_one_message(card: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    card.device_problem = lambda number: "the kernels were built for 90, and this GPU has 75: install again"
    for _ in range(2):
        assert device.kernel_device("cuda").type == "cpu"
    assert " ".join(capsys.readouterr().out.split()).count("and this GPU has 75: install again") == 1


def test_why_a_card_is_not_used(card: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    card.device_problem = lambda number: "too old" if number else ""
    assert device.kernel_device("cuda:0").type == "cuda" and device.kernel_device("cuda:1").type == "cpu"
    assert device.why_not_cuda() is None and device.why_not_cuda(1) == "too old"
    device._device_problem.cache_clear()
    monkeypatch.setitem(sys.modules, "bitymi_ns._cuda", None)
    assert "cannot be loaded" in device.why_not_cuda()
    device._device_problem.cache_clear()
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "bitymi_ns._cuda_build", SimpleNamespace(WHY_NOT="nvcc 11.4 is too old"))
    assert device.why_not_cuda() == "this installation has no CUDA kernels: nvcc 11.4 is too old"
    monkeypatch.setitem(sys.modules, "bitymi_ns._cuda_build", None)
    assert "install bitymi-ns again" in device.why_not_cuda() and not device.has_cuda_kernels()


@pytest.fixture
def config():
    """Make a run's configuration; nerfstudio is imported before the stub, as its libraries query a GPU."""
    from bitymi_ns.plugin.run.config import method_config

    return method_config("bitymi").config


def test_a_card_trains(config, card: ModuleType) -> None:
    config.machine.device_type = "cuda"
    config.set_timestamp()
    assert config.machine.device_type == "cuda"
    config.machine.num_devices = 2
    with pytest.raises(SystemExit, match=r"1 of 2 GPUs that .*--machine.num-devices"):
        config.set_timestamp()


@pytest.mark.parametrize("option", ["mixed_precision", "use_grad_scaler"])
def test_what_scales_the_loss_is_refused(config, option: str) -> None:
    setattr(config, option, True)
    with pytest.raises(SystemExit, match=rf"--{option.replace('_', '-')} True scales the gradients"):
        config.set_timestamp()


@pytest.mark.parametrize(("group", "steps"), [("means", 0), ("no-such-group", 2)])
def test_gradients_are_accumulated_over_steps_of_known_groups(config, group: str, steps: int) -> None:
    config.gradient_accumulation_steps = {group: steps}
    with pytest.raises(SystemExit, match=f"--gradient-accumulation-steps {group} {steps}: give at least 1 for one of "):
        config.set_timestamp()


def test_no_card_and_other_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    device._device_problem.cache_clear()
    assert device.why_not_cuda() and device.kernel_device("cuda").type == "cpu"
    assert device.kernel_device("mps").type == "cpu"
    device._device_problem.cache_clear()
