"""Checks of a caller's views and points, and of torch's modes."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from .views import View

_ROUNDING = 1e-3  # by which resampled images may exceed 0 to 1


@contextmanager
def learning_modes() -> Iterator[None]:
    """Enable gradients, and make new tensors float32. Raises ValueError: torch is in inference mode."""
    if torch.is_inference_mode_enabled():
        raise ValueError("nothing can learn in torch.inference_mode(): call this outside of it")
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        with torch.enable_grad():
            yield
    finally:
        torch.set_default_dtype(before)


def checked_views(views: Sequence[View], name: str = "views") -> list[View]:
    """Check views, and convert masks to bool. Raises ValueError: something has another shape, type or range than `View`
    states; names it with its index."""
    return [_checked(view, f"{name}[{i}]") for i, view in enumerate(views)]


def check_counted(views: Sequence[View]) -> None:
    """Raise ValueError if there are no views, or no pixel of any counts."""
    if not views:
        raise ValueError("there is nothing to learn from: no views")
    if not any(view.mask is None or bool(view.mask.any()) for view in views):
        raise ValueError("there is nothing to learn from: the masks of all views exclude all pixels")


def check_points(points: Tensor, colors: Tensor) -> None:
    """Raise ValueError unless points are finite [M, 3], and colors [M, 3] from 0 to 1."""
    for name, values in (("points", points), ("colors", colors)):
        if values.ndim != 2 or values.shape[1] != 3 or len(values) != len(points):
            raise ValueError(f"{name} have to be [M, 3], as many as points, not {list(values.shape)}")
    _check_finite(points, "points")
    _check_image(colors, "colors")


def _checked(view: View, name: str) -> View:
    camera = view.camera
    height, width = camera.height, camera.width
    _check_finite(camera.viewmat, f"{name}.camera.viewmat")
    _check_finite(camera.K, f"{name}.camera.K")
    if min(float(camera.K[0, 0]), float(camera.K[1, 1])) <= 0 or camera.skewed:
        raise ValueError(f"{name}.camera.K needs positive focal lengths and no skew, not {camera.K.tolist()}")
    one = [(height, width), (height, width, 1)]
    shapes = {"image": [(height, width, 3), (height, width, 4)], "mask": one, "depth": one}
    for key, allowed in {**shapes, "normal": [(height, width, 3)], "correction": [(3,), (3, 4)]}.items():
        value = getattr(view, key)
        if value is None:
            continue
        if tuple(value.shape) not in allowed:
            raise ValueError(f"{name}.{key} has to be {list(allowed[0])}, as its camera is, not {list(value.shape)}")
        if key != "mask" and not (value.is_floating_point() or (key == "image" and value.dtype == torch.uint8)):
            raise ValueError(f"{name}.{key} has to be {'uint8 or ' * (key == 'image')}float, not {value.dtype}")
    if view.image.dtype != torch.uint8:
        _check_image(view.image, f"{name}.image")
    if view.correction is not None:
        _check_finite(view.correction, f"{name}.correction")
    if view.mask is None or view.mask.dtype == torch.bool:
        return view
    if view.mask.is_floating_point():
        raise ValueError(f"{name}.mask has to be bool, or integers of which 0 excludes, not {view.mask.dtype}")
    return view._replace(mask=view.mask != 0)


def _check_finite(values: Tensor, name: str) -> None:
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"{name} has to be finite, and is not")


def _check_image(values: Tensor, name: str) -> None:
    if not values.is_floating_point():
        raise ValueError(f"{name} has to be float, from 0 to 1, not {values.dtype}")
    _check_finite(values, name)
    if values.numel() and (values.min() < -_ROUNDING or values.max() > 1 + _ROUNDING):
        raise ValueError(f"{name} has to be from 0 to 1, not from {float(values.min()):g} to {float(values.max()):g}")
