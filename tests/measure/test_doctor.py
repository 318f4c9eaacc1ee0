"""The doctor tries what it lists; its exit status says whether anything trains."""

import platform
import warnings
from importlib import metadata
from typing import Any

import pytest
import torch

pytest.importorskip("nerfstudio")

from bitymi_ns import cli
from bitymi_ns.errors import KernelsUnavailable
from bitymi_ns.measure import doctor
from bitymi_ns.plugin.run import config, device

TRAINS = doctor._train


def fails(*_: Any) -> float:
    raise KernelsUnavailable("the CPU lacks AVX2")


def warned(_: str) -> None:
    warnings.warn("`torch.jit.script` is deprecated", FutureWarning, stacklevel=1)


@pytest.mark.parametrize(
    ("owner", "name", "value", "status", "said"),
    [
        (doctor, "_train", TRAINS, 0, "result      ns-train bitymi trains on cpu"),
        (doctor, "_train", fails, 1, "cpu         a training step failed: KernelsUnavailable: the CPU lacks AVX2"),
        (doctor, "_train", fails, 1, "result      ns-train bitymi cannot train here"),
        (doctor.backend, "load", fails, 1, "kernels     CPU: the CPU lacks AVX2"),
        (config, "method_config", fails, 1, "nerfstudio  the methods cannot be loaded: KernelsUnavailable: the CPU"),
        (config, "method_config", warned, 0, "result      ns-train bitymi trains on cpu"),
        (torch.cuda, "device_count", lambda: 1, 0, "cuda:0      cannot be used: nvcc 11.4 is too old"),
        (device, "built", lambda name: "no g++" * (name == "WHY_NOT"), 0, "kernels     CUDA: no g++"),
        (doctor, "user_cache", lambda: None, 0, "cache       None (cannot be written)"),
    ],
)
def test_what_is_tried_is_told_in_a_screen(
    owner: Any, name: str, value: Any, status: int, said: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(device, "why_not_cuda", lambda index=None: "nvcc 11.4 is too old")
    monkeypatch.setattr(owner, name, value)
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        assert cli.main(["doctor"]) == status
    out = capsys.readouterr().out
    assert said in out and len(out.splitlines()) < 24
    assert f"Python {platform.python_version()}" in out and f"torch {metadata.version('torch')}" in out
