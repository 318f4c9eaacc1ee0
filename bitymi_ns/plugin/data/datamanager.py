"""nerfstudio's full-image data manager with a resumable training order and views for multi-view scoring."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
)
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from bitymi_ns.plugin.console import fail, listed, warn
from bitymi_ns.plugin.data import duplicates
from bitymi_ns.plugin.data.bundle_cameras import BundleCamerasConfig
from bitymi_ns.plugin.data.cameras import check_cameras, check_views, to_camera
from bitymi_ns.plugin.data.capture_checks import check_capture, check_images, declares_box, reporting_input_errors
from bitymi_ns.plugin.data.colmap import checked_models
from bitymi_ns.plugin.data.dataparser import BitymiDataParserConfig
from bitymi_ns.plugin.data.dataset import BitymiDataset, without_blank_views
from bitymi_ns.plugin.data.downscale import LONGEST_SIDE, reduce_views
from bitymi_ns.plugin.data.images import check_orientation, file_has_transparency, set_up_pillow
from bitymi_ns.plugin.data.initial_points import for_a_new_scene
from bitymi_ns.plugin.data.photographs import PHOTOGRAPH_BYTES, Photographs
from bitymi_ns.plugin.data.ply import colours
from bitymi_ns.plugin.data.point_cloud import reporting_time
from bitymi_ns.plugin.data.poses import check_cloud, check_places, orienting_all, warn_of_mirrored
from bitymi_ns.plugin.data.transforms import corrected_files
from bitymi_ns.plugin.data.views import ALONE
from bitymi_ns.train.processes import Processes
from bitymi_ns.train.views import MemoryBudget, OnDemand, View, spread, training_order

LOOKED_AT = 8
"""Photographs of which it is looked whether any pixel is transparent."""
FEW_VIEWS = 10
"""Number of training views below which the multi-view scores rest on little."""


if TYPE_CHECKING:
    AnyDataParser = DataParserConfig
else:
    # ours for our methods alone: it needs this data manager, which knows lenses
    AnyDataParser = tyro.conf.OmitSubcommandPrefixes[
        tyro.extras.subcommand_type_from_defaults(
            {
                "bitymi-data": BitymiDataParserConfig(),
                **all_dataparsers,
                "nerfstudio-data": NerfstudioDataParserConfig(eval_mode="interval", load_3D_points=True),
            },
            prefix_names=False,
        )
    ]


@dataclass
class BitymiDataManagerConfig(FullImageDatamanagerConfig):
    """Configuration of the data manager."""

    _target: type = field(default_factory=lambda: BitymiDataManager)
    dataparser: AnyDataParser = field(default_factory=NerfstudioDataParserConfig)
    """How the capture is read."""
    cache_images_type: Literal["uint8", "float32"] = "uint8"
    """The image type that is kept in memory; uint8 takes a quarter of the space."""
    longest_side: int = LONGEST_SIDE
    """Photographs with more pixels along a side are reduced to this as they are read, and their cameras with them; 0 =
    all are used as they are."""
    train_cameras_sampling_seed: int = 42
    """Decides the order of the training views."""
    # options of nerfstudio's other data managers, which nothing reads here, are left out of the help
    train_cameras_sampling_strategy: tyro.conf.Suppress[Literal["random", "fps"]] = "random"
    fps_reset_every: tyro.conf.Suppress[int] = 100
    eval_num_images_to_sample_from: tyro.conf.Suppress[int] = -1
    eval_num_times_to_repeat_images: tyro.conf.Suppress[int] = -1
    eval_image_indices: tyro.conf.Suppress[tuple[int, ...] | None] = (0,)
    images_on_gpu: tyro.conf.Suppress[bool] = False
    masks_on_gpu: tyro.conf.Suppress[bool] = False


class BitymiDataManager(FullImageDatamanager[BitymiDataset]):
    """Full images and their cameras.

    Attributes:
        step_view: gives a training view by its number in the size that the current step wants; a run replaces it, which
            else gives the full size.

    The view of a training step is a function of the seed and the step alone, so that a resumed run sees the views that
    the uninterrupted one would have seen: each epoch of n steps is a permutation of the n views.
    """

    config: BitymiDataManagerConfig

    def __init__(
        self,
        config: BitymiDataManagerConfig,
        device: torch.device | str = "cpu",
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        **kwargs: Any,
    ) -> None:
        self._budget = MemoryBudget(PHOTOGRAPH_BYTES)
        self.step_view: Callable[[int], View] = lambda index: self.train_views[index]
        set_up_pillow()
        cloud = check_capture(config, images=test_mode != "inference")
        with (
            reporting_input_errors(config),
            corrected_files(config.dataparser),
            orienting_all(),
            checked_models(config.dataparser),
            reporting_time("Reading", cloud.points),
            for_a_new_scene(test_mode == "val"),
        ):
            super().__init__(config, device, test_mode, world_size, local_rank, **kwargs)
        self._check_images(test_mode)
        if test_mode == "val":
            self._check_points(cloud.file)
        outputs = self.train_dataparser_outputs
        color = outputs.alpha_color
        self.train_dataset.metadata["alpha_color"] = None if color is None else torch.as_tensor(color).float()
        files = outputs.image_filenames
        self.train_dataset.metadata["has_alpha"] = bool(files) and file_has_transparency(files[0])
        # what decides how a run trains; without one there may be no photographs to read
        self.train_dataset.metadata["transparent"] = self._looks(test_mode) and any(
            file_has_transparency(files[i]) and self.train_dataset.get_numpy_image(i).shape[-1] == 4
            for i in spread(len(files), LOOKED_AT)
        )
        self.train_dataset.metadata["declares_box"] = declares_box(config.dataparser)
        cameras = outputs.cameras
        self.train_dataset.metadata["train_pixels"] = int((cameras.width.long() * cameras.height.long()).sum())
        self.train_dataset.metadata["camera_centers"] = outputs.cameras.camera_to_worlds[..., :3, 3].reshape(-1, 3)

    def _looks(self, test_mode: str) -> bool:
        """Whether there are photographs to look into."""
        return test_mode != "inference" and ALONE not in self.train_dataparser_outputs.metadata

    def get_datapath(self) -> Path:
        """Where the viewer keeps camera paths: with the capture, or beside the bundle where that is gone."""
        place = Path(super().get_datapath())
        return place.parent if isinstance(self.config.dataparser, BundleCamerasConfig) else place

    @property
    def dataset_type(self) -> type[BitymiDataset]:  # type: ignore[override]
        return BitymiDataset

    def sample_train_cameras(self) -> list[int]:
        """The training views; their order comes from `train_index`. nerfstudio's base class asks for this."""
        if len(self.train_dataset) == 0:
            fail(
                f"no image is left for training in {self.config.data}: all {len(self.eval_dataset)} are held out for "
                "evaluation. Take more photographs, or train on all of them with `bitymi-data --eval-mode all`."
            )
        return list(range(len(self.train_dataset)))

    def _check_images(self, test_mode: str) -> None:
        """Stop, or warn, before any time is spent on a capture that cannot give a scene."""
        count = len(self.train_dataset)
        if not self._looks(test_mode):
            return
        train, held_out = self.train_dataset.image_filenames, self.eval_dataset.image_filenames
        for dataset in (self.train_dataset, self.eval_dataset):
            check_cameras(dataset.cameras, dataset.image_filenames)
        check_views([self.train_dataset.cameras, self.eval_dataset.cameras], [*train, *held_out])
        poses = (
            torch.cat([d.cameras.camera_to_worlds for d in (self.train_dataset, self.eval_dataset)]).double().numpy()
        )
        warn_of_mirrored(poses[:, :, :3], [*train, *held_out])
        check_places(poses[:, :, 3], [*train, *held_out])
        check_images([*train, *held_out])
        check_orientation(list(dict.fromkeys([*train, *held_out])))
        self._duplicates = duplicates.same_files(train, held_out)
        duplicates.warn_of(self._duplicates, train, held_out)
        if count == 1 and test_mode == "val":
            fail(
                f"only one training view in {self.config.data}. A scene cannot be learned from one image: take "
                "photographs from more sides."
            )
        if count < FEW_VIEWS and test_mode == "val":
            warn(
                f"Only {count} training views: all of them are used for multi-view scoring, and views "
                "from elsewhere will look poor. Twenty or more photographs are advisable."
            )

    def _check_points(self, file: Path | None) -> None:
        """Colours as the file has them, and a word where the points are in another unit than the poses."""
        outputs = self.train_dataparser_outputs
        points = outputs.metadata.get("points3D_xyz")
        if points is None:
            return
        if len(points) and not len(outputs.metadata["points3D_rgb"]):  # our own reader gives all of them some
            warn("The points of the capture have no colours: they start grey. `bitymi-data` takes them of photographs.")
        rgb = None if file is None else colours(file)
        if isinstance(rgb, str):
            warn(f"The points of {file} start without colours: {rgb}. Write them as bytes (property uchar red).")
            outputs.metadata["points3D_rgb"] = torch.zeros(0, 3, dtype=torch.uint8)
        elif rgb is not None and len(rgb) == len(points):
            outputs.metadata["points3D_rgb"] = torch.from_numpy(rgb)
        cameras = outputs.cameras
        check_cloud(
            points.double().numpy(),
            cameras.camera_to_worlds[:, :, 3].double().numpy(),
            (cameras.width / cameras.fx).flatten().double().numpy(),
        )

    def create_train_dataset(self) -> BitymiDataset:
        outputs = reduce_views(self.train_dataparser_outputs, self.config.longest_side, self.test_mode == "val")
        if self._looks(self.test_mode):
            outputs = without_blank_views(outputs, "training")
        self.train_dataparser_outputs = outputs
        return super().create_train_dataset()

    def create_eval_dataset(self) -> BitymiDataset:
        outputs = self.dataparser.get_dataparser_outputs(split=self.test_split)
        outputs = reduce_views(outputs, self.config.longest_side, announce=False)
        if self._looks(self.test_mode):
            outputs = without_blank_views(outputs, "held-out")
        return BitymiDataset(dataparser_outputs=outputs, scale_factor=self.config.camera_res_scale_factor)

    def check_pictures(self) -> None:
        """Stop, or warn, when the photographs themselves show nothing, or the same on both sides of the hold-out."""
        train, held_out = self.train_dataset, self.eval_dataset
        empty: dict[str, list[Path]] = {}
        for i, path in enumerate(train.image_filenames):
            if train.note(i).empty:
                empty.setdefault(train.note(i).empty, []).append(path)
        if sum(map(len, empty.values())) == len(train):
            what = "; ".join(f"{reason}: {listed(paths)}" for reason, paths in empty.items())
            fail(f"there is nothing to learn from the {len(train)} training photographs: {what}.")
        for reason, paths in empty.items():
            warn(f"Of {len(train)} training photographs {len(paths)} show nothing, {reason}: {listed(paths)}.")
        found = {j for _, j in self._duplicates}
        prints = [[d.note(i).fingerprint for i in range(len(d))] for d in (train, held_out)]
        pairs = [pair for pair in duplicates.same_contents(*prints) if pair[1] not in found]
        duplicates.warn_of(pairs, train.image_filenames, held_out.image_filenames)

    def _load_images(  # type: ignore[override]
        self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]
    ) -> Sequence[dict[str, torch.Tensor]]:
        dataset = self.train_dataset if split == "train" else self.eval_dataset
        if torch.device(self.device).type == "cpu":
            images = Photographs(
                dataset, self.config.cache_images_type, self._budget, self.config, f"Reading the {split} images"
            )
        else:
            with reporting_input_errors(self.config):
                images = super()._load_images(split, cache_images_device)
        # undistorted now, and their intrinsics changed with them
        if dataset.cameras.distortion_params is not None:
            dataset.cameras.distortion_params = torch.zeros_like(dataset.cameras.distortion_params)
            dataset.cameras.camera_type = torch.full_like(dataset.cameras.camera_type, CameraType.PERSPECTIVE.value)
        self.train_cameras = self.train_dataset.cameras.to(self.device)
        return images

    def get_train_rays_per_batch(self) -> int:
        """Pixels of the first training view, without reading it."""
        cameras = self.train_dataset.cameras
        return int(cameras.width[0]) * int(cameras.height[0])

    @property
    def fixed_indices_eval_dataloader(self) -> Sequence[tuple[Cameras, dict[str, Any]]]:  # type: ignore[override]
        """All held-out views in turn, each read when it is asked for."""
        _ = self.cached_eval  # undistorts, which changes the intrinsics
        return OnDemand(len(self.eval_dataset), self.eval_view)

    def train_index(self, step: int) -> int:
        """The training view of a step of this process."""
        (number,) = Processes(self.local_rank, self.world_size).numbers(step)
        return training_order(len(self.train_dataset), self.config.train_cameras_sampling_seed, number)

    def next_train(self, step: int) -> tuple[View, dict[str, Any]]:  # type: ignore[override]
        """The view of a step, as training wants it (`step_view`)."""
        index = self.train_index(step)
        view = self.step_view(index)
        return view, {"image_idx": index, "image": view.image, "mask": view.mask}

    @property
    def train_views(self) -> OnDemand[View]:
        """All training views at full size, each read when it is asked for."""
        return OnDemand(len(self.train_dataset), lambda i: _view(*self.train_view(i)))

    @property
    def eval_views(self) -> OnDemand[View]:
        """All held-out views at full size, each read when it is asked for."""
        return OnDemand(len(self.eval_dataset), lambda i: _view(*self.eval_view(i)))

    def next_eval_image(self, step: int) -> tuple[Cameras, dict[str, Any]]:
        """The held-out views in turn, without drawing from a shared random generator."""
        return self.eval_view(step % len(self.eval_dataset))

    def train_view(self, index: int) -> tuple[Cameras, dict[str, Any]]:
        """Camera and batch of a training view; the order of training is not touched."""
        data = self._batch(self.cached_train[index])
        camera = self.train_cameras[index : index + 1].to(self.device)
        camera.metadata = {**(camera.metadata or {}), "cam_idx": index}
        return camera, data

    def eval_view(self, index: int) -> tuple[Cameras, dict[str, Any]]:
        """Camera and batch of a held-out view."""
        data = self._batch(self.cached_eval[index])
        return self.eval_dataset.cameras[index : index + 1].to(self.device), data

    def _batch(self, cached: dict[str, Any]) -> dict[str, Any]:
        data = dict(cached)
        data["image"] = data["image"].to(self.device)
        return data

    def undistorted_train_cameras(self) -> Cameras:
        """All training cameras, as they belong to the images in memory."""
        distortion = self.train_dataset.cameras.distortion_params
        if distortion is not None and bool((distortion != 0).any()):
            _ = self.cached_train  # undistorts, which changes the intrinsics
        return self.train_dataset.cameras


def _view(cameras: Cameras, batch: dict[str, Any]) -> View:
    return View(to_camera(cameras), batch["image"], batch.get("mask"))
