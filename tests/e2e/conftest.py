"""A short training run on a small ray-traced room, shared by the tests of this folder."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nerfstudio")

from nerfstudio.scripts import train as ns_train

from bitymi_ns.plugin.run.config import BitymiTrainerConfig, method_config
from tests.e2e.exports import TOLERANCE, run_export

STEPS = 60


def small_run(data: Path, output: Path, name: str = "run", method: str = "bitymi") -> BitymiTrainerConfig:
    config = method_config(method).config
    config.output_dir, config.experiment_name, config.timestamp = output, "room", name
    config.pipeline.datamanager.data = data
    config.vis, config.max_num_iterations, config.steps_per_save = "none", STEPS, 20
    config.logging.local_writer.enable = False
    config.pipeline.model.curve_points = 3
    scene, train = config.pipeline.model.scene, config.pipeline.model.train
    scene.log2_table_size, scene.min_resolution = 10, 16
    train.densify.importance, train.densify.reset_interval = 1, 100_000  # densifies, without rollbacks
    train.densify.max_surfels, train.densify.min_interval, train.densify.pixels_per_surfel = 800, 1, 0.0
    return config


@pytest.fixture
def start(room: Path, tmp_path: Path) -> Callable[..., BitymiTrainerConfig]:
    def make(**options: Any) -> BitymiTrainerConfig:
        return small_run(options.pop("data", room), tmp_path / "outputs", **options)

    return make


def finished(config: BitymiTrainerConfig) -> BitymiTrainerConfig:
    config.save_only_latest_checkpoint = False
    ns_train.main(config)
    return config


@pytest.fixture(scope="session")
def trained(room: Path, tmp_path_factory: pytest.TempPathFactory) -> BitymiTrainerConfig:
    """A finished run with all its checkpoints. Not to be changed."""
    return finished(small_run(room, tmp_path_factory.mktemp("outputs")))


@pytest.fixture(scope="session")
def bundle(trained: BitymiTrainerConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The trained room as a bundle with its texels as trained, at a tolerance low enough for a short run to have tiles.
    Not to be changed."""
    folder = tmp_path_factory.mktemp("bundles") / "room-bc7"
    run_export(trained, folder, tolerance=TOLERANCE, finetune_steps=0)
    return folder


@pytest.fixture(scope="session")
def field_run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> BitymiTrainerConfig:
    """A finished run with a field and all its checkpoints. Not to be changed."""
    return finished(small_run(room, tmp_path_factory.mktemp("outputs"), method="bitymi-field"))


@pytest.fixture(scope="session")
def field_bundle(field_run: BitymiTrainerConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundles") / "field-bc7"
    run_export(field_run, folder, tolerance=TOLERANCE, finetune_steps=0)
    return folder


@pytest.fixture
def capture(room: Path, tmp_path: Path) -> Path:
    """A copy of the room, to be changed."""
    return Path(shutil.copytree(room, tmp_path / "capture"))


@pytest.fixture
def copied(bundle: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(bundle, tmp_path / "elsewhere"))
