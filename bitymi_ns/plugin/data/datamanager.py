"""Full-image data manager with a resumable training order and views for multi-view scoring."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from torch import Tensor

from bitymi_ns.capture import image_files, splits
from bitymi_ns.capture.find_files import check_photographs_exist
from bitymi_ns.capture.pose_checks import check_outliers, check_point_unit, warn_of_mirrored
from bitymi_ns.ranges import spread
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.exposure import restored
from bitymi_ns.train.poses import carried, cross_matrix
from bitymi_ns.train.processes import Processes
from bitymi_ns.train.views import MemoryBudget, OnDemand, View, training_order
from ..console import as_input_error, fail, listed, warn
from .cameras import check_cameras, to_camera, to_cameras
from .capture_checks import check_capture, declares_box, reporting_input_errors
from .dataparser import BitymiDataParserConfig, BundleCamerasConfig
from .dataset import BitymiDataset, CachedImages, drop_blank_views, photograph_bytes
from .depth import with_depth
from .facts import KEY, CaptureFacts
from .views import LONGEST_SIDE, limit_size, with_lenses

ALPHA_SAMPLES = 8  # photographs searched for transparent pixels
FEW_VIEWS = 10  # below, multi-view scores are unreliable

if TYPE_CHECKING:
    AnyDataParser = DataParserConfig
else:
    # bitymi-data needs this data manager, which undistorts by lenses
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
    _target: type = field(default_factory=lambda: BitymiDataManager)
    dataparser: AnyDataParser = field(default_factory=NerfstudioDataParserConfig)  # Parser of the capture.
    cache_images_type: Literal["uint8", "float32"] = "uint8"
    """Type of the images in memory."""
    longest_side: int = LONGEST_SIDE
    """Downscale photographs to this many pixels along a side as they are read; 0 = not at all."""
    train_cameras_sampling_seed: int = 42  # Seed of the order of training views.
    # nerfstudio's options without effect
    train_cameras_sampling_strategy: tyro.conf.Suppress[Literal["random", "fps"]] = "random"
    fps_reset_every: tyro.conf.Suppress[int] = 100
    eval_num_images_to_sample_from: tyro.conf.Suppress[int] = -1
    eval_num_times_to_repeat_images: tyro.conf.Suppress[int] = -1
    eval_image_indices: tyro.conf.Suppress[tuple[int, ...] | None] = (0,)
    cache_images: tyro.conf.Suppress[Literal["cpu", "gpu"]] = "cpu"
    images_on_gpu: tyro.conf.Suppress[bool] = False
    masks_on_gpu: tyro.conf.Suppress[bool] = False


class BitymiDataManager(FullImageDatamanager[BitymiDataset]):
    """Full images and their cameras. A step's view is a function of seed and step alone, so that resumed runs see the
    views of uninterrupted ones."""

    config: BitymiDataManagerConfig

    @as_input_error()
    def __init__(
        self, config: BitymiDataManagerConfig, test_mode: Literal["test", "val", "inference"] = "val", **kwargs: Any
    ) -> None:
        image_files.set_up_pillow()
        check_capture(config, trains=test_mode == "val")
        with reporting_input_errors(config):
            super().__init__(config, test_mode=test_mode, **kwargs)
        self._check_images(test_mode)
        if test_mode == "val":
            self._check_points()
        outputs, dataset = self.train_dataparser_outputs, self.train_dataset
        cameras, color, files = outputs.cameras, outputs.alpha_color, dataset.facts.files
        # photographs may be missing unless a run trains
        sampled = spread(len(files), ALPHA_SAMPLES) if self._has_photos(test_mode) else ()
        declare_alpha = (i for i in sampled if image_files.file_has_transparency(files[i]))
        dataset.metadata[KEY] = replace(
            dataset.facts,
            alpha_color=None if color is None else torch.as_tensor(color).float(),
            has_alpha=bool(files) and image_files.file_has_transparency(files[0]),
            transparent=any(dataset.get_numpy_image(i).shape[-1] == 4 for i in declare_alpha),
            declares_box=dataset.facts.declares_box or declares_box(config.dataparser),
            train_pixels=int((cameras.width.long() * cameras.height.long()).sum()),
            camera_centers=cameras.camera_to_worlds[..., :3, 3].reshape(-1, 3),
            background_views=self.train_views if test_mode == "val" else (),
            seed=config.train_cameras_sampling_seed,
        )

    def _has_photos(self, test_mode: str) -> bool:
        return test_mode != "inference" and not CaptureFacts.of(self.train_dataparser_outputs.metadata).lost

    def get_datapath(self) -> Path:
        """Return the viewer's folder of camera paths: the capture's, or beside the bundle if that is gone."""
        path = Path(super().get_datapath())
        return path.parent if isinstance(self.config.dataparser, BundleCamerasConfig) else path

    def sample_train_cameras(self) -> list[int]:
        """Return all training views; `train_index` orders them."""
        if len(self.train_dataset) == 0:
            held_out = f"all {len(self.eval_dataset)} photographs of {self.config.data} are held out"
            fail(f"{held_out}. Take more, or train on all of them with `bitymi-data --eval-mode all`.")
        return list(range(len(self.train_dataset)))

    def _check_images(self, test_mode: str) -> None:
        """Fail or warn if no scene can be learned from the capture."""
        if not self._has_photos(test_mode):
            return
        count, datasets = len(self.train_dataset), (self.train_dataset, self.eval_dataset)
        train, held_out = (dataset.image_filenames for dataset in datasets)
        names = [*train, *held_out]
        check_cameras([dataset.cameras for dataset in datasets], names)
        poses = torch.cat([dataset.cameras.camera_to_worlds for dataset in datasets]).double().numpy()
        warn_of_mirrored(poses[:, :, :3], names)
        check_outliers(poses[:, :, 3], names)
        check_photographs_exist(self.get_datapath(), [file for dataset in datasets for file in dataset.facts.files])
        if count == 1 and test_mode == "val":
            fail(f"only one training view in {self.config.data}: take photographs from more sides.")
        if count < FEW_VIEWS and test_mode == "val":
            warn(f"Only {count} training views: other views will look poor. Take twenty or more photographs.")

    def _check_points(self) -> None:
        """Warn if points have no colors, or another unit than the poses."""
        outputs = self.train_dataparser_outputs
        points = outputs.metadata.get("points3D_xyz")
        if points is None:
            return
        if len(points) and not len(outputs.metadata["points3D_rgb"]):
            warn("The points of the capture have no colors: they start grey.")
        cameras = outputs.cameras
        centers = cameras.camera_to_worlds[:, :, 3].double()
        widths = (cameras.width / cameras.fx).flatten().double()
        check_point_unit(points.double().numpy(), centers.numpy(), widths.numpy())

    def create_train_dataset(self) -> BitymiDataset:
        self.train_dataparser_outputs = self._prepared(self.train_dataparser_outputs, "training")
        return super().create_train_dataset()

    def create_eval_dataset(self) -> BitymiDataset:
        outputs = self._prepared(self.dataparser.get_dataparser_outputs(split=self.test_split), "held-out")
        return BitymiDataset(dataparser_outputs=outputs, scale_factor=self.config.camera_res_scale_factor)

    def _prepared(self, outputs: DataparserOutputs, split: str) -> DataparserOutputs:
        """Undistort and limit the size of views; drop those that are masked out."""
        verbose = split == "training" and self.test_mode == "val"
        outputs = limit_size(with_lenses(outputs), self.config.longest_side, verbose)
        if verbose and isinstance(self.config.dataparser, BitymiDataParserConfig):
            parser = self.config.dataparser
            outputs = with_depth(outputs, parser.depth, parser.depth_unit_scale_factor, parser.points == "auto")
        return drop_blank_views(outputs, split) if self._has_photos(self.test_mode) else outputs

    def check_pictures(self) -> None:
        """Fail or warn if training photographs show nothing; warn of held-out ones that equal them."""
        train, held_out = self.train_dataset, self.eval_dataset
        empty: dict[str, list[Path]] = {}
        for i, path in enumerate(train.image_filenames):
            if reason := train.summary(i).empty:
                empty.setdefault(reason, []).append(path)
        if sum(map(len, empty.values())) == len(train):
            what = "; ".join(f"{reason}: {listed(paths)}" for reason, paths in empty.items())
            fail(f"there is nothing to learn from the {len(train)} training photographs: {what}.")
        for reason, paths in empty.items():
            warn(f"Of {len(train)} training photographs {len(paths)} show nothing, {reason}: {listed(paths)}.")
        summaries = [[dataset.summary(i) for i in range(len(dataset))] for dataset in (train, held_out)]
        fingerprints = [[None if image.empty else image.fingerprint for image in images] for images in summaries]
        splits.warn_of_duplicates(splits.duplicates(*fingerprints), train.image_filenames, held_out.image_filenames)

    @cached_property
    def _budget(self) -> MemoryBudget:
        return MemoryBudget(photograph_bytes(torch.device(self.device), self.world_size))

    def _load_images(self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]) -> CachedImages:
        """Cache a split in host memory."""
        dataset = self.train_dataset if split == "train" else self.eval_dataset
        with reporting_input_errors(self.config):
            return CachedImages(dataset, self.config.cache_images_type, self._budget, f"Reading the {split} images")

    def get_train_rays_per_batch(self) -> int:
        """Count the pixels of the first training view without reading it."""
        cameras = self.train_dataset.cameras
        return int(cameras.width[0]) * int(cameras.height[0])

    @property
    def fixed_indices_eval_dataloader(self) -> Sequence[tuple[Cameras, dict[str, Any]]]:
        """Held-out views in turn, read on demand."""
        return OnDemand(len(self.eval_dataset), self.eval_view)

    @property
    def eval_dataloader(self) -> SimpleNamespace:
        """Loader that gives `ns-render spiral` its first camera."""
        cameras = (self.eval_dataset if len(self.eval_dataset) else self.train_dataset).cameras
        return SimpleNamespace(get_camera=lambda image_idx: (cameras[image_idx : image_idx + 1], {}))

    def train_index(self, step: int) -> int:
        """Return the training view's index in a step of this process."""
        (number,) = Processes.joined().view_numbers(step)
        return training_order(len(self.train_dataset), self.config.train_cameras_sampling_seed, number)

    @property
    def train_views(self) -> OnDemand[View]:
        """Training views at full size, read on demand, with pictures in host memory."""
        return self._views(self.train_dataset, lambda i: self.cached_train[i])

    @property
    def eval_views(self) -> OnDemand[View]:
        return self._views(self.eval_dataset, lambda i: self.cached_eval[i])

    def move_cameras(self, motions: Tensor) -> Callable[[Camera], Camera] | None:
        """Apply a run's pose corrections, motions [V, 6] of `Poses`, to the training cameras; return a function that
        carries other cameras along, or None if the motions are of other photographs."""
        cameras = self.train_dataset.cameras
        if len(motions) != len(cameras):
            return None
        given = torch.stack([camera.viewmat.double() for camera in to_cameras(cameras, "cpu")])
        poses = cameras.camera_to_worlds.double().cpu()
        turns = torch.linalg.matrix_exp(torch.stack([cross_matrix(motion[:3]) for motion in motions]))
        poses = torch.cat([turns @ poses[..., :3], (poses[..., 3] + motions[:, 3:])[..., None]], -1)
        cameras.camera_to_worlds = poses.to(cameras.camera_to_worlds)
        return lambda camera: carried(camera, given, motions)

    def corrections(self, state: Mapping[str, Any] | None) -> list[list[Tensor | None]]:
        """Return the color corrections of training and held-out views, by the state of a run's `Exposure`."""
        train, held_out = self.train_dataset.facts.files, self.eval_dataset.facts.files
        exposure = restored(state, len(train), train)
        return [[exposure.at(file) for file in files] for files in (train, held_out)]

    def corrected_eval_views(self, state: Mapping[str, Any] | None) -> OnDemand[View]:
        """Return the held-out views with their color corrections."""
        views, (_, held_out) = self.eval_views, self.corrections(state)
        return OnDemand(len(views), lambda i: views[i]._replace(correction=held_out[i]))

    def _views(self, dataset: BitymiDataset, batch: Callable[[int], dict[str, Any]]) -> OnDemand[View]:
        cameras: dict[int, Camera] = {}  # converting one takes 1 % of a training step

        def view(index: int) -> View:
            if index not in cameras:
                cameras[index] = to_camera(dataset.cameras[index : index + 1], self.device)
            pictures = batch(index)
            maps = {name: pictures.get(name) for name in ("mask", "depth", "normal")}
            return View(cameras[index], pictures["image"], **maps, file=dataset.facts.files[index])

        return OnDemand(len(dataset), view)

    def next_eval_image(self, step: int) -> tuple[Cameras, dict[str, Any]]:
        """Return the held-out views in turn."""
        return self.eval_view(step % len(self.eval_dataset))

    def train_view(self, index: int) -> tuple[Cameras, dict[str, Any]]:
        """Return camera and batch of a training view."""
        data = self._batch(self.cached_train[index])
        return self.train_dataset.cameras[index : index + 1].to(self.device), data

    def eval_view(self, index: int) -> tuple[Cameras, dict[str, Any]]:
        return self.eval_dataset.cameras[index : index + 1].to(self.device), self._batch(self.cached_eval[index])

    def _batch(self, cached: dict[str, Any]) -> dict[str, Any]:
        return {**cached, "image": cached["image"].to(self.device)}
