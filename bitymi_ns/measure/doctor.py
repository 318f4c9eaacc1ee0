"""`bitymi doctor`: versions, kernels and devices, and a training step on each device."""

import importlib
import importlib.metadata
import os
import platform
import shutil
import time
import warnings
from collections.abc import Iterator

import torch

from bitymi_ns.capture.cache import user_cache
from bitymi_ns.ops import backend
from bitymi_ns.safe_reading import why
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.init import scene_for_views
from bitymi_ns.train.preset import load_preset
from bitymi_ns.train.views import View
from .machine import machine, output

PACKAGES = (
    "bitymi-ns", "torch", "torchvision", "nerfstudio", "gsplat", "numpy", "opencv-python-headless", "opencv-python",
    "open3d", "av", "pycolmap",
)  # fmt: skip
CARDS = "index,name,compute_cap,driver_version,memory.total"


def examine() -> Iterator[tuple[str, str]]:
    """Yield a name and a line about each part, the last one for "result": empty if `ns-train bitymi` cannot train."""
    yield "system", f"{platform.platform()}, Python {platform.python_version()}"
    installed = {package.metadata["Name"].lower(): package.version for package in importlib.metadata.distributions()}
    yield "packages", ", ".join(f"{name} {installed[name]}" for name in PACKAGES if name in installed)
    yield "torch", f"CUDA {torch.version.cuda or 'none'}, {torch.get_num_threads()} threads"
    yield "machine", machine()
    cache = user_cache()
    usable = cache is not None and os.access(next(p for p in (cache, *cache.parents) if p.exists()), os.W_OK)
    yield "cache", f"{cache}{'' if usable else ' (cannot be written)'}"
    nvcc = shutil.which("nvcc") or shutil.which("nvcc", path="/usr/local/cuda/bin")
    release = output([nvcc, "--version"]).partition("release ")[2].partition(",")[0] if nvcc else ""
    yield "nvcc", f"{release or 'does not run'} ({nvcc})" if nvcc else "none"
    for card in output(["nvidia-smi", f"--query-gpu={CARDS}", "--format=csv,noheader"]).splitlines() or ["none"]:
        yield "card", card
    try:
        name = backend.load("_cpu").__name__.rpartition(".")[2]
        flags = importlib.import_module("bitymi_ns._cpu_features").FEATURES[name].split()
        level = next((level for flag, level in (("avx512f", "AVX-512"), ("avx2", "AVX2")) if flag in flags), "no AVX2")
        yield "kernels", f"CPU: {name}, {level}"
    except Exception as error:
        yield "kernels", f"CPU: {why(error)}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about code of others
            from bitymi_ns.plugin.run.config import method_config
            from bitymi_ns.plugin.run.device import built, why_not_cuda

            method_config("bitymi")
    except Exception as error:
        yield "nerfstudio", f"the methods cannot be loaded: {type(error).__name__}: {why(error)}"
        yield "result", ""
        return
    reason = why_not_cuda() or "ready"
    for line in (reason, *(built(name) for name in ("WHY_NOT", "NOTE"))):
        if line and (line is reason or line not in reason):
            yield "kernels", f"CUDA: {line}"
    devices = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    trained = []
    for device in devices:
        problem = why_not_cuda(int(device[5:])) if device != "cpu" else None
        try:
            yield device, f"cannot be used: {problem}" if problem else f"a training step took {_train(device):.2f} s"
            trained += [] if problem else [device]
        except Exception as error:
            yield device, f"a training step failed: {type(error).__name__}: {why(error)}"
    yield "result", f"ns-train bitymi trains on {trained[-1].partition(':')[0]}" if trained else ""


def _train(device: str) -> float:
    """Train a scene of 64 surfels for one step; return its seconds."""
    numbers = torch.Generator().manual_seed(0)
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0.0, 24.0], [0.0, 40.0, 18.0], [0.0, 0.0, 1.0]]), 48, 36)
    points = torch.rand(64, 3, generator=numbers) + torch.tensor([-0.5, -0.5, 1.0])
    views = [View(camera, torch.rand(36, 48, 3, generator=numbers)).to(device)]
    preset = load_preset("bitymi")
    start = time.perf_counter()
    scene = scene_for_views(views, points, points.clamp(0, 1), preset.scene, preset.train, 1).to(device)
    Trainer(scene, views, preset.train, 1).advance()
    if not all(bool(values.isfinite().all()) for values in scene.surfels.values()):
        raise ArithmeticError("the surfels are not finite")
    return time.perf_counter() - start
