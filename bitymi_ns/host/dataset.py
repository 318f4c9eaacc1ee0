"""Images of a capture: alpha and masks kept, errors that name the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from bitymi_ns.host.errors import fail
from bitymi_ns.train.views import over_background


class BitymiDataset(InputDataset):
    """nerfstudio's dataset, except that images with alpha stay [H, W, 4]: the model composes them over a background."""

    def get_numpy_image(self, image_idx: int) -> npt.NDArray[np.uint8]:
        path = self._dataparser_outputs.image_filenames[image_idx]
        try:
            with Image.open(path) as file:
                image = file.convert("RGBA" if has_transparency(file) else "RGB")
        except FileNotFoundError as error:
            fail(f"the image {path} is missing, but the capture has a pose for it", error)
        except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
            fail(f"the image {path} cannot be read: {error}. Replace it or remove it from the capture.", error)
        if self.scale_factor != 1.0:
            size = (int(image.width * self.scale_factor), int(image.height * self.scale_factor))
            image = image.resize(size, resample=Image.Resampling.BILINEAR)
        camera = self.cameras[image_idx].reshape(())
        declared = (int(camera.width), int(camera.height))
        if image.size != declared:
            fail(
                f"the image {path} has {image.width} x {image.height} pixels, but its camera is for "
                f"{declared[0]} x {declared[1]}. Correct w and h (and fl_x, fl_y, cx, cy) in the capture, or resize "
                "the image."
            )
        return np.array(image, dtype=np.uint8)

    def get_image_float32(self, image_idx: int) -> Tensor:
        """[H, W, 3 or 4] in [0, 1]; alpha is not composed."""
        return torch.from_numpy(self.get_numpy_image(image_idx)).float() / 255.0

    def get_image_uint8(self, image_idx: int) -> Tensor:
        """[H, W, 3 or 4]; alpha is not composed."""
        return torch.from_numpy(self.get_numpy_image(image_idx))

    def __getitem__(self, image_idx: int) -> dict[str, Any]:
        """For viewer and ns-render, which show images as they get them: alpha is composed."""
        data = self.get_data(image_idx)
        color = self._dataparser_outputs.alpha_color
        data["image"] = over_background(data["image"], None if color is None else torch.as_tensor(color).float())
        return data

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        masks = self._dataparser_outputs.mask_filenames
        try:
            data = super().get_data(image_idx, image_type)
        except FileNotFoundError as error:
            fail(f"the mask {masks[image_idx] if masks else error} is missing", error)
        except AssertionError as error:
            fail(f"the mask {masks[image_idx] if masks else ''} does not fit its image: {error}", error)
        if "mask" in data:
            data["mask"] = data["mask"].bool()
        return data


def has_transparency(image: Image.Image) -> bool:
    """Whether an image has an alpha channel or a transparent colour."""
    return image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info


def file_has_transparency(path: Path) -> bool:
    """The same for a file, of which only the header is read; False when there is none to read."""
    try:
        with Image.open(path) as image:
            return has_transparency(image)
    except (OSError, SyntaxError, ValueError):
        return False
