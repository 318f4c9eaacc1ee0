"""Parser of a bundle's cameras.json, for commands that need no photographs where the capture is gone."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs

from bitymi_ns.bundle import BundleError
from bitymi_ns.bundle.cameras import CapturedCamera
from bitymi_ns.bundle.parts import CAMERAS
from bitymi_ns.bundle.read import read_cameras, read_manifest
from bitymi_ns.capture.camera import OPENCV_AXES
from bitymi_ns.capture.lens import Pinhole
from bitymi_ns.plugin.console import fail
from bitymi_ns.plugin.data.views import NO_PHOTOS, Views, pinhole_cameras
from bitymi_ns.trust import inside


@dataclass
class BundleCamerasConfig(DataParserConfig):
    """Cameras of a bundle."""

    _target: type = field(default_factory=lambda: BundleCameras)
    data: Path = Path()
    """Folder of the bundle."""
    capture: Path = Path()
    """Folder of the capture before it was lost."""


class BundleCameras(DataParser):
    """Views with the cameras of a bundle, without photographs."""

    config: BundleCamerasConfig
    downscale_factor = None  # nerfstudio sets it where photographs are not needed

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        folder = Path(self.config.data)
        try:
            info, rows = read_manifest(folder), read_cameras(folder)
            files = {row.name: inside(Path(self.config.capture), row.name) for row in rows}
        except BundleError as error:
            fail(str(error), error)
        except ValueError as error:
            fail(f"{folder}, {CAMERAS}: {error}.", error)
        chosen = [row for row in rows if row.held_out == (split != "train")] or rows
        world = info.world
        return Views(
            image_filenames=[files[row.name] for row in chosen],
            cameras=_cameras(chosen),
            dataparser_scale=float(world.scale),
            dataparser_transform=torch.tensor(np.asarray(world.transform, np.float64)[:3]),
            metadata={NO_PHOTOS: True},
        )


def has_cameras(bundle: Path) -> bool:
    """Test if a bundle states the cameras of its capture."""
    try:
        return bool(read_cameras(bundle))
    except BundleError as error:
        fail(str(error), error)


def _cameras(rows: Sequence[CapturedCamera]) -> Cameras:
    poses, pinholes = [], []
    for camera in (row.camera for row in rows):
        poses.append((torch.linalg.inv(camera.viewmat.double()) @ torch.from_numpy(OPENCV_AXES)).float())
        K = camera.K.tolist()
        pinholes.append(Pinhole(K[0][0], K[1][1], K[0][2], K[1][2], camera.width, camera.height))
    return pinhole_cameras(pinholes, torch.stack(poses))
