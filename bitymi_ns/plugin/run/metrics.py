"""Measure image quality and render times."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from bitymi_ns.train.losses import color_fitted, psnr
from ..console import warn, warn_once
from . import lpips

LPIPS = {"lpips": "alex", "lpips_vgg": "vgg"}
"""Backbones by name in the results: nerfstudio's and gsplat's convention, and 3DGS's."""
_lpips_missing: list[str] = []


def image_metrics(
    image: Tensor, reference: Tensor, mask: Tensor | None = None, mean_exposure: Tensor | None = None
) -> dict[str, float]:
    """Measure psnr, ssim, flip (if its package is installed), lpips and lpips_vgg (if their weights can be had) of
    images [H, W, 3] in [0, 1]; fitted_psnr, fitted_ssim and fitted_lpips of the `color_fitted` image; and
    mean_exposure_psnr and so on of the image without correction, if given. Pixels that a mask [H, W, 1] excludes are 0
    in all images, and left out of PSNR and fit."""
    image = image.detach().float().clamp(0.0, 1.0)
    reference = reference.detach().float().clamp(0.0, 1.0)
    if mask is not None:
        mask = mask.to(image.device).bool().reshape(*image.shape[:2], 1)
        image, reference = image * mask, reference * mask
    result = _similarity(image, reference, mask, tuple(LPIPS))
    if (found := flip(image, reference)) is not None:
        result["flip"] = found
    images = {"fitted": color_fitted(image, reference, mask)}
    if mean_exposure is not None:
        images["mean_exposure"] = mean_exposure.detach().float().clamp(0.0, 1.0)
    for name, variant in images.items():
        variant = variant if mask is None else variant * mask
        result |= {f"{name}_{k}": v for k, v in _similarity(variant, reference, mask, ("lpips",)).items()}
    return result


def _similarity(image: Tensor, reference: Tensor, mask: Tensor | None, distances: Sequence[str]) -> dict[str, float]:
    from torchmetrics.functional.image import structural_similarity_index_measure

    first, second = (x.permute(2, 0, 1)[None] for x in (image, reference))
    ssim = structural_similarity_index_measure(first, second, data_range=1.0)
    ssim = float(ssim[0] if isinstance(ssim, tuple) else ssim)
    return {"psnr": psnr(image, reference, mask), "ssim": ssim, **lpips_metrics(image, reference, distances)}


def flip(image: Tensor, reference: Tensor) -> float | None:
    """Measure the mean of NVIDIA's FLIP (LDR); None without its package."""
    try:
        from flip_evaluator import nbflip
    except ImportError as error:
        warn_once(f"FLIP is left out: {error} (pip install flip-evaluator).")
        return None
    # LDR, sRGB, no colour map, with mean error, default viewing conditions
    pair = (reference.cpu().contiguous().numpy(), image.cpu().contiguous().numpy())
    _, mean, _ = nbflip.evaluate(*pair, False, True, False, True, {})
    return float(mean)


def lpips_metrics(image: Tensor, reference: Tensor, names: Sequence[str]) -> dict[str, float]:
    """Measure distances by names in `LPIPS`; empty without weights, or below 32 pixels along a side."""
    found: dict[str, float] = {}
    for name in names if min(image.shape[:2]) >= lpips.LEAST_SIDE else ():
        if name in _lpips_missing:  # the next one is missing, too
            break
        try:
            found[name] = lpips.lpips(image, reference, LPIPS[name])
        except lpips.LpipsUnavailable as error:
            _lpips_missing.append(name)
            warn(f"{name.upper()} is left out: {error}.")
            break
    return found


REPEATS = 3  # of timed renders


def render_milliseconds(render: Callable[[], Any], device: torch.device) -> float:
    """Measure the median time of rendering alone, after a warm-up."""

    wait = torch.cuda.synchronize if device.type == "cuda" else lambda _: None

    def timed() -> float:
        wait(device)
        start = time.perf_counter()
        render()
        wait(device)
        return 1000.0 * (time.perf_counter() - start)

    with torch.no_grad():
        timed()
        return sorted(timed() for _ in range(REPEATS))[REPEATS // 2]
