"""Photographs of a capture on the CPU: undistorted, in memory while there is room, read anew at every use beyond."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, Literal

import torch
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from rich.progress import track

from bitymi_ns.plugin.data.capture_checks import reporting_input_errors
from bitymi_ns.plugin.data.dataset import BitymiDataset
from bitymi_ns.train.views import MemoryBudget

PHOTOGRAPH_BYTES = 1 << 28
"""Memory for the photographs of a capture, training and held-out views together."""
AT_ONCE = 4
"""Number of photographs that are read together at the start."""
RECENT = 2
"""Number of photographs beyond the memory that are kept until the next ones are read, because one step asks for a view
more than once."""


class Photographs(Sequence):
    """The batches of a dataset, as nerfstudio's data managers make them: image, mask and what else it has.

    All are read once at the start, so that one that cannot be read is noticed then. The cameras of the dataset become
    those of the undistorted images.

    Args:
        dataset: with the cameras of the files.
        image_type: of the pixels.
        budget: for the pictures, shared with other datasets.
        config: of the data manager, for messages.
        description: of what is being read, for the progress bar.
    """

    def __init__(
        self,
        dataset: BitymiDataset,
        image_type: Literal["uint8", "float32"],
        budget: MemoryBudget,
        config: Any,
        description: str,
    ) -> None:
        self._files = copy.copy(dataset)
        self._files.cameras = copy.deepcopy(dataset.cameras)
        self._image_type, self._config = image_type, config
        self._read_recently = lru_cache(maxsize=RECENT)(self._read)
        self._kept: dict[int, dict[str, Any]] = {}
        starts = range(0, len(dataset), AT_ONCE)
        with ThreadPoolExecutor(max_workers=2) as readers:
            for start in track(starts, description, transient=True):
                indices = range(len(dataset))[start : start + AT_ONCE]
                for index, (batch, K) in zip(indices, list(readers.map(self._read, indices)), strict=True):
                    _set_camera(dataset, index, batch["image"], K)
                    if budget.reserve(sum(value.nbytes for value in batch.values() if isinstance(value, torch.Tensor))):
                        self._kept[index] = batch

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> dict[str, Any]:  # type: ignore[override]
        index = range(len(self))[index]
        return self._kept[index] if index in self._kept else self._read_recently(index)[0]

    def _read(self, index: int) -> tuple[dict[str, Any], Any]:
        """The batch, and the matrix of its camera where that changed."""
        with reporting_input_errors(self._config):
            batch = self._files.get_data(index, image_type=self._image_type)
            camera = self._files.cameras[index].reshape(())
            distortion = camera.distortion_params
            if distortion is None or not bool(distortion.any()):
                return batch, None
            K = camera.get_intrinsics_matrices().numpy()
            K, image, mask = _undistort_image(camera, distortion.numpy(), batch, batch["image"].numpy(), K)
            batch["image"] = torch.from_numpy(image)
            if mask is not None:
                batch["mask"] = mask
            return batch, K


def _set_camera(dataset: BitymiDataset, index: int, image: torch.Tensor, K: Any) -> None:
    """Makes the camera of a view that of its undistorted image; K [3, 3], None = it was not distorted."""
    if K is None:
        return
    cameras = dataset.cameras
    cameras.fx[index], cameras.fy[index] = float(K[0, 0]), float(K[1, 1])
    cameras.cx[index], cameras.cy[index] = float(K[0, 2]), float(K[1, 2])
    cameras.height[index], cameras.width[index] = image.shape[:2]
