"""Image quality and honest render times."""

from __future__ import annotations

import os
import socket
import time
import urllib.error
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bitymi_ns.host.errors import warn
from bitymi_ns.train.losses import cc_psnr, psnr

LPIPS_TIMEOUT = 30.0
"""Seconds to wait for the server that has the weights of LPIPS."""

_lpips: list[Any] = []
"""Empty, or holding the network, or None when it cannot be had: tried once per process."""
_flip_missing: list[bool] = []


def image_metrics(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> dict[str, float]:
    """psnr, cc_psnr (after an affine fit of the colours), ssim, flip (where its package is installed) and lpips (where
    its weights can be had).

    Args:
        image, reference: [H, W, 3] in [0, 1].
        mask: [H, W, 1] bool; pixels where it is False are the same in both for every metric and left out of psnr
            and cc_psnr.
    """
    image, reference = image.detach().float().clamp(0.0, 1.0), reference.detach().float().clamp(0.0, 1.0)
    if mask is not None:
        mask = mask.to(image.device).bool().reshape(*image.shape[:2], 1)
        image, reference = image * mask, reference * mask
    result = {"psnr": psnr(image, reference, mask), "cc_psnr": cc_psnr(image, reference, mask)}
    result["ssim"] = ssim(image, reference)
    for name, value in (("flip", flip(image, reference)), ("lpips", lpips(image, reference))):
        if value is not None:
            result[name] = value
    return result


def ssim(image: Tensor, reference: Tensor) -> float:
    """Structural similarity, by torchmetrics (11 x 11 Gaussian window, sigma 1.5, data range 1)."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    pair = [x.permute(2, 0, 1)[None] for x in (image, reference)]
    return float(structural_similarity_index_measure(*pair, data_range=1.0))


def flip(image: Tensor, reference: Tensor) -> float | None:
    """NVIDIA's FLIP (LDR), mean over the image; None when its package is not installed."""
    if _flip_missing:
        return None
    try:
        from flip_evaluator import nbflip
    except ImportError:
        _flip_missing.append(True)
        warn("FLIP is left out: its package is not installed (pip install flip-evaluator).")
        return None
    # LDR, sRGB input, no colour map, with mean error, default viewing conditions
    pair = (reference.cpu().contiguous().numpy(), image.cpu().contiguous().numpy())
    _, mean, _ = nbflip.evaluate(*pair, False, True, False, True, {})
    return float(mean)


def lpips(image: Tensor, reference: Tensor) -> float | None:
    """LPIPS with AlexNet; None when the weights cannot be had (one warning per process says why)."""
    if not _lpips:
        _lpips.append(_build_lpips())
    network = _lpips[0]
    if network is None:
        return None
    pair = [x.permute(2, 0, 1)[None] for x in (image, reference)]
    network.to(image.device)
    with torch.no_grad():
        return float(network(*pair))


def _build_lpips() -> Any:
    """The network, of which torchmetrics ships the heads and torch.hub fetches the backbone into its cache."""
    weights = Path(torch.hub.get_dir()) / "checkpoints" / "alexnet-owt-7be5be79.pth"
    timeout = socket.getdefaulttimeout()
    try:
        if not weights.is_file() and os.environ.get("BITYMI_NO_DOWNLOAD"):
            raise OSError("BITYMI_NO_DOWNLOAD is set")
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        socket.setdefaulttimeout(LPIPS_TIMEOUT)
        return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).eval()
    except (OSError, urllib.error.URLError, ImportError, RuntimeError, ValueError) as error:
        warn(f"LPIPS is left out: its weights are not at {weights} and cannot be fetched ({error}).")
        return None
    finally:
        socket.setdefaulttimeout(timeout)


def render_milliseconds(render: Callable[[], Any], device: torch.device, repeats: int = 3) -> float:
    """Median time of rendering alone, after one run to warm up, waiting for the device each time."""

    def timed() -> float:
        _synchronize(device)
        start = time.perf_counter()
        render()
        _synchronize(device)
        return 1000.0 * (time.perf_counter() - start)

    with torch.no_grad():
        timed()
        return sorted(timed() for _ in range(repeats))[repeats // 2]


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
