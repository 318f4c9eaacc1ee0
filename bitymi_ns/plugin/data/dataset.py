"""Dataset of a capture: undistorted images with alpha and masks, cached in memory."""

import hashlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import psutil
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from rich.progress import track
from torch import Tensor

from bitymi_ns.bundle.sizes import memory_limit
from bitymi_ns.capture.image_files import ImageSummary, in_threads, pixels_of, read_image, summarize, wrong_size
from bitymi_ns.capture.masks import checked_mask
from bitymi_ns.capture.pose_checks import rotations
from bitymi_ns.train.views import MemoryBudget, OnDemand, over_background, resample_nearest
from ..console import as_input_error, fail, listed, warn
from .facts import CaptureFacts
from .views import MOVED, select_views

PHOTOGRAPH_BYTES = 1 << 28
"""Memory for a capture's images in a run on the CPU, where a step takes far longer than reading one."""
PREFETCH = 4  # images read together at the start
RECENT = 2  # last images cached beyond the budget: a step asks more than once
POSE_STEP = 1e-4  # resolution of compared poses, units of the scene


class BitymiDataset(InputDataset):
    """Dataset with images undistorted by their `Lens`; the model composes transparent ones, [H, W, 4]."""

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0) -> None:
        c2w = dataparser_outputs.cameras.camera_to_worlds
        parts = rotations(c2w[:, :3, :3].double().numpy(), dataparser_outputs.image_filenames, "the capture")
        c2w[:, :3, :3] = torch.from_numpy(parts)
        super().__init__(dataparser_outputs, scale_factor)
        self._summaries: dict[int, ImageSummary] = {}
        # show missing photographs grey; else fail
        self.gray_images = self.facts.gray
        self._read_shared = lru_cache(maxsize=RECENT)(read_image)  # views of one follow each other

    @property
    def facts(self) -> CaptureFacts:
        return CaptureFacts.of(self.metadata)

    @as_input_error()
    def get_numpy_image(self, image_idx: int) -> npt.NDArray[np.uint8]:
        """Read an undistorted image [H, W, 3 or 4]."""
        path = self.facts.files[image_idx]
        camera = self.cameras[image_idx].reshape(())
        declared = (int(camera.width), int(camera.height))
        if self.facts.lost:
            if not self.gray_images:
                fail(f"the photograph {path} is needed, and the capture is gone. {MOVED}")
            return np.full((*declared[::-1], 3), 128, np.uint8)
        lens = self.facts.lenses[image_idx]
        read = self._read_shared if lens.face else read_image
        image = lens.undistort(read(path, lens.stored, lens.camera.size))
        image = self._scaled(image, Image.Resampling.BILINEAR)
        if image.size != declared:
            fail(wrong_size(path, image.size, declared))
        pixels = pixels_of(image)
        self._summaries[image_idx] = summarize(pixels)
        return pixels

    def summary(self, image_idx: int) -> ImageSummary:
        if image_idx not in self._summaries:
            self.get_numpy_image(image_idx)
        return self._summaries[image_idx]

    def __getitem__(self, image_idx: int) -> dict[str, Any]:
        """Return the batch for viewer and ns-render, with composed alpha."""
        data = self.get_data(image_idx)
        color = self._dataparser_outputs.alpha_color
        data["image"] = over_background(data["image"], None if color is None else torch.as_tensor(color).float())
        return data

    @as_input_error()
    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """Read an image [H, W, 3 or 4], alpha not composed, its mask [H, W, 1] bool if any, and, if used, its depth [H,
        W] in units of the scene and normal [H, W, 3], both float16."""
        image = torch.from_numpy(self.get_numpy_image(image_idx))
        image = image.float() / 255.0 if image_type == "float32" else image
        data: dict[str, Any] = {"image_idx": image_idx, "image": image}
        masks = self._dataparser_outputs.mask_filenames
        if masks is not None or not (self.facts.lost or self.facts.lenses[image_idx].whole):
            mask = self._scaled(view_mask(self._dataparser_outputs, image_idx), Image.Resampling.NEAREST)
            data["mask"] = torch.from_numpy(np.array(mask, dtype=bool))[..., None]
            if self.mask_color:
                fill = torch.tensor(self.mask_color)
                if not image.is_floating_point():
                    fill = fill.mul(255.0).round().to(image.dtype)
                colors = torch.where(data["mask"], image[..., :3], fill)
                data["image"] = torch.cat([colors, image[..., 3:]], -1)
        if self.facts.fitted:
            size = (data["image"].shape[1], data["image"].shape[0])
            maps = self.facts.fitted[image_idx].read(self.facts.lenses[image_idx])
            data |= {name: resample_nearest(torch.from_numpy(values), *size).half() for name, values in maps.items()}
        data.update(self.get_metadata(data))
        return data

    def _scaled(self, image: Image.Image, resample: Image.Resampling) -> Image.Image:
        if self.scale_factor == 1.0:
            return image
        size = (int(image.width * self.scale_factor), int(image.height * self.scale_factor))
        return image.resize(size, resample=resample)


def photograph_bytes(device: torch.device, processes: int = 1) -> int:
    """Return the bytes of host memory for images in each of a run's processes. On GPUs they share half of what is
    available, as a step takes less time than reading a photograph."""
    if device.type == "cpu":
        return PHOTOGRAPH_BYTES
    return max(PHOTOGRAPH_BYTES, int(min(psutil.virtual_memory().available, memory_limit()) / (2 * processes)))


def view_mask(outputs: DataparserOutputs, index: int) -> Image.Image:
    """Read the mask of a view, if its photograph has one or does not cover it."""
    path = None if outputs.mask_filenames is None else outputs.mask_filenames[index]
    lens = CaptureFacts.of(outputs.metadata).lenses[index]
    return lens.undistort_mask(None if path is None else checked_mask(path), path)


class CachedImages(OnDemand[dict[str, Any]]):
    """Batches of a dataset, kept within the budget, which datasets share, and read at every use beyond it. Reads all at
    the start, to notice unreadable ones."""

    def __init__(
        self, dataset: BitymiDataset, image_type: Literal["uint8", "float32"], budget: MemoryBudget, description: str
    ) -> None:
        read = partial(dataset.get_data, image_type=image_type)
        read_recently = lru_cache(maxsize=RECENT)(read)
        self._kept: dict[int, dict[str, Any]] = {}
        super().__init__(len(dataset), lambda index: self._kept.get(index) or read_recently(index))
        starts = range(0, len(dataset), PREFETCH)
        with ThreadPoolExecutor(max_workers=2) as readers:
            for start in track(starts, description, transient=True):
                indices = range(len(dataset))[start : start + PREFETCH]
                for index, batch in zip(indices, list(readers.map(read, indices)), strict=True):
                    if budget.reserve(sum(value.nbytes for value in batch.values() if isinstance(value, Tensor))):
                        self._kept[index] = batch


def drop_blank_views(outputs: DataparserOutputs, split: str) -> DataparserOutputs:
    """Leave out fully masked views. Raises InputError: no training view is left."""
    masks = outputs.mask_filenames
    if not masks:
        return outputs
    boxes = in_threads(lambda i: view_mask(outputs, i).getbbox(), range(len(masks)))
    blank = [i for i, box in enumerate(boxes) if box is None]
    if not blank:
        return outputs
    which = f"{len(masks)} {split} photographs exclude every pixel"
    named = listed([outputs.image_filenames[i] for i in blank])
    if split == "training" and len(blank) == len(masks):
        fail(f"the masks of all {which}: {named}. Pixels count where the mask is not black: invert inverted masks.")
    warn(f"The masks of {len(blank)} of {which}: {named}. These views are left out.")
    return select_views(outputs, [i for i in range(len(masks)) if i not in blank])


def capture_fingerprint(dataset: BitymiDataset) -> dict[str, Any]:
    """Summarize the training views: number, and digests of names and poses."""
    poses = (dataset.cameras.camera_to_worlds / POSE_STEP).round().cpu().numpy()
    names = "\n".join(path.name for path in dataset.image_filenames)
    digests = {"names": names.encode("utf8", "surrogateescape"), "poses": poses.tobytes()}
    return {"views": len(dataset), **{name: hashlib.sha256(data).hexdigest() for name, data in digests.items()}}


def warn_of_other_capture(before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> None:
    """Warn if a run that is resumed, measured or exported reads another capture, by fingerprints."""
    if before is None:
        return
    if before["views"] != now["views"]:
        what = f"it had {before['views']} training photographs, this one has {now['views']}"
    elif before["names"] != now["names"]:
        what = "its training photographs have other names"
    elif before["poses"] != now["poses"]:
        what = "its cameras stand elsewhere"
    else:
        return
    warn(f"The run was trained on another capture: {what}. What is held out now may have been trained on.")
