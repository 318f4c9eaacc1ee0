"""Images of a capture: alpha and masks kept, errors that name the file."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from torch import Tensor

from bitymi_ns.plugin.console import fail, listed, warn
from bitymi_ns.plugin.data.downscale import Reduction
from bitymi_ns.plugin.data.images import Note, masks_without_pixels, note, read_image, read_mask, wrong_size
from bitymi_ns.plugin.data.lens import Lens
from bitymi_ns.plugin.data.poses import rotations
from bitymi_ns.plugin.data.views import ALONE
from bitymi_ns.plugin.run.commands import MOVED
from bitymi_ns.train.views import over_background


class BitymiDataset(InputDataset):
    """nerfstudio's dataset, except that images with transparent pixels stay [H, W, 4]: the model composes them over a
    background.

    Attributes:
        shows_blanks: photographs that are gone are grey, for the viewer, which shows them in small; else they are
            missed.
    """

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0) -> None:
        c2w = dataparser_outputs.cameras.camera_to_worlds
        if c2w.ndim != 3:  # seen with instant-ngp's files: nerfstudio's Cameras lose the dimension of a single view
            fail(
                "nerfstudio's reader of this format fails on a split with a single photograph. Hold out more of them, "
                "for example with `--eval-mode interval --eval-interval 4` after the name of the reader."
            )
        parts = rotations(c2w[:, :3, :3].double().numpy(), dataparser_outputs.image_filenames, "the capture")
        c2w[:, :3, :3] = torch.from_numpy(parts)
        super().__init__(dataparser_outputs, scale_factor)
        self._notes: dict[int, Note] = {}
        self.shows_blanks = False

    def get_numpy_image(self, image_idx: int) -> npt.NDArray[np.uint8]:
        if ALONE in self._dataparser_outputs.metadata:
            return self._blank(image_idx)
        path = self._dataparser_outputs.image_filenames[image_idx]
        lens, reduction = self._lens(image_idx), self._reduction(image_idx)
        if lens is not None:
            image = lens.picture(read_image(path, lens.stored, lens.size))
        elif reduction is not None:
            image = read_image(path, reduction.stored, reduction.size).resize(reduction.size, Image.Resampling.BOX)
        else:
            image = read_image(path)
        image = self._scaled(image, Image.Resampling.BILINEAR)
        camera = self.cameras[image_idx].reshape(())
        declared = (int(camera.width), int(camera.height))
        if image.size != declared:
            fail(wrong_size(path, image.size, declared))
        pixels = np.array(image, dtype=np.uint8)
        if pixels.shape[-1] == 4 and pixels[..., 3].min(initial=255) == 255:
            pixels = np.ascontiguousarray(pixels[..., :3])  # nothing is transparent
        self._notes[image_idx] = note(pixels)
        return pixels

    def _blank(self, image_idx: int) -> npt.NDArray[np.uint8]:
        if not self.shows_blanks:
            path = self._dataparser_outputs.image_filenames[image_idx]
            fail(f"the photograph {path} is needed, and the capture is gone. {MOVED}")
        camera = self.cameras[image_idx].reshape(())
        return np.full((int(camera.height), int(camera.width), 3), 128, np.uint8)

    def note(self, image_idx: int) -> Note:
        """What there is to know of a photograph; it is read for that if it has not been yet."""
        if image_idx not in self._notes:
            self.get_numpy_image(image_idx)
        return self._notes[image_idx]

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
        """The photograph, and its mask [H, W, 1] bool where the capture has masks."""
        read = self.get_image_float32 if image_type == "float32" else self.get_image_uint8
        data: dict[str, Any] = {"image_idx": image_idx, "image": read(image_idx)}
        masks = self._dataparser_outputs.mask_filenames
        if masks is not None:
            mask, lens, reduction = read_mask(masks[image_idx]), self._lens(image_idx), self._reduction(image_idx)
            if lens is not None:
                mask = lens.mask(mask, masks[image_idx])
            elif reduction is not None and mask.size == reduction.stored:
                mask = mask.resize(reduction.size, Image.Resampling.NEAREST)
            mask = self._scaled(mask, Image.Resampling.NEAREST)
            height, width = data["image"].shape[:2]
            if mask.size != (width, height):
                fail(
                    f"the mask {masks[image_idx]} has {mask.width} x {mask.height} pixels, but its image {width} x "
                    f"{height}. Make it of the same size."
                )
            data["mask"] = torch.from_numpy(np.array(mask, dtype=bool))[..., None]
            if self.mask_color:
                data["image"] = _painted(data["image"], data["mask"], self.mask_color)
        data.update(self.get_metadata(data))
        return data

    def _lens(self, image_idx: int) -> Lens | None:
        """Through which a photograph was taken; None = its camera is that of the file."""
        lenses = self._dataparser_outputs.metadata.get("lenses")
        return None if lenses is None else lenses[image_idx]

    def _reduction(self, image_idx: int) -> Reduction | None:
        """From which size a photograph is reduced; None = it is not, or its lens does it."""
        reductions = self._dataparser_outputs.metadata.get("reductions")
        return None if reductions is None else reductions[image_idx]

    def _scaled(self, image: Image.Image, resample: Image.Resampling) -> Image.Image:
        if self.scale_factor == 1.0:
            return image
        size = (int(image.width * self.scale_factor), int(image.height * self.scale_factor))
        return image.resize(size, resample=resample)


def _painted(image: Tensor, mask: Tensor, color: tuple[float, float, float]) -> Tensor:
    """The image with `color`, in [0, 1], where the mask is False; alpha is left alone."""
    paint = torch.tensor(color) if image.is_floating_point() else torch.tensor(color).mul(255.0).round().to(image.dtype)
    return torch.cat([torch.where(mask, image[..., :3], paint), image[..., 3:]], -1)


def without_blank_views(outputs: DataparserOutputs, which: str) -> DataparserOutputs:
    """The views of which any pixel counts: a mask that excludes all of them leaves nothing to learn from or to compare.

    Args:
        outputs: what nerfstudio's reader found.
        which: "training" or "held-out", for messages.

    Raises:
        InputError: no training view is left.
    """
    masks = outputs.mask_filenames
    blank = set(masks_without_pixels(masks)) if masks else set()
    if not blank:
        return outputs
    named = listed([masks[i] for i in sorted(blank)])
    if which == "training" and len(blank) == len(masks):
        fail(
            f"the masks of all {len(masks)} {which} photographs exclude every pixel: {named}. Pixels count where the "
            "mask is not black; if the masks are inverted, invert them."
        )
    warn(
        f"The masks of {len(blank)} of {len(masks)} {which} photographs exclude every pixel: {named}. These views are "
        "left out."
    )
    return views_of(outputs, [i for i in range(len(masks)) if i not in blank])


def views_of(outputs: DataparserOutputs, keep: Sequence[int]) -> DataparserOutputs:
    """These of the views, with all that belongs to them."""
    count = len(outputs.image_filenames)
    masks = outputs.mask_filenames
    metadata = {
        key: [value[i] for i in keep] if isinstance(value, list) and len(value) == count else value
        for key, value in outputs.metadata.items()
    }
    return dataclasses.replace(
        outputs,
        image_filenames=[outputs.image_filenames[i] for i in keep],
        mask_filenames=None if masks is None else [masks[i] for i in keep],
        cameras=outputs.cameras[torch.tensor(keep, dtype=torch.long)],
        metadata=metadata,
    )
