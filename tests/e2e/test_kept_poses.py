"""A run on photographs keeps its poses, even if the photographs change or disappear."""

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from bitymi_ns.capture.frame import WorldFrame, write_frame
from bitymi_ns.capture.types import SfmSettings
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export.trained import load_trained, world_of
from bitymi_ns.plugin.run import folder_lock
from bitymi_ns.plugin.run.folder_lock import POSES
from tests.captures import colmap_model, edit, found_poses, printed
from tests.e2e.conftest import small_run
from tests.e2e.exports import run_export
from tests.e2e.runs import a_run_of, checkpoint, config_of, different, rewrite
from tests.typed import Patch, Printed

STEPS = 4


class Shot:
    """A run on photographs.

    Attributes:
        config: configuration of the run.
        photographs: their folder.
        work: cached pose estimation, with some captures including the training pictures.
    """

    def __init__(self, room: Path, folder: Path, upright: bool, data: Path = Path()) -> None:
        self.photographs, self.work, self.outputs = folder / "photographs" / data, folder / "work", folder / "outputs"
        shutil.copytree(room / "images", self.photographs)
        colmap_model(room, self.work / "result/sparse/0")
        write_frame(self.work / "result", WorldFrame("gps", 2.5, None, None, 0, torch.eye(4)[:3].tolist()))
        (self.work / "result/report.json").write_text("{}")
        self.images = self.photographs
        if upright:  # the first was rotated by EXIF, the others are links
            self.images = self.work / "images"
            self.images.mkdir()
            for i, path in enumerate(sorted(self.photographs.iterdir())):
                shutil.copyfile(path, self.images / path.name) if i == 0 else (self.images / path.name).symlink_to(path)
        self.config = small_run(folder / "photographs", self.outputs)
        self.config.max_num_iterations, self.config.save_only_latest_checkpoint = STEPS, False
        self.config.steps_per_save = 2

    @property
    def run(self) -> Path:
        return self.config.get_base_dir()

    def find_poses(self, *arguments: Any) -> Any:
        return found_poses(self.work / "result/sparse/0", self.images, self.work / "result")

    def spoil(self) -> None:
        """Invalidate the cache key: touch the photographs, add one, remove the cached results."""
        shutil.rmtree(self.work)
        paths = sorted(self.photographs.iterdir())
        for path in paths:
            os.utime(path, (10, 10))
        shutil.copyfile(paths[0], paths[0].with_name("frame_00000_new.png"))


def never(*arguments: Any) -> Any:
    pytest.fail("poses are found anew")


@pytest.fixture
def shoot(room: Path, tmp_path: Path, monkeypatch: Patch) -> Callable[..., Shot]:
    """Return a function that trains on photographs, after which pose estimation is disabled."""

    def make(upright: bool = False, sfm: SfmSettings | None = None, **options: Any) -> Shot:
        shot = Shot(room, tmp_path, upright, **options)
        shot.config.pipeline.datamanager.dataparser.sfm = sfm or SfmSettings()
        monkeypatch.setattr("bitymi_ns.capture.poses.find_poses", shot.find_poses)
        ns_train.main(shot.config)
        monkeypatch.setattr("bitymi_ns.capture.poses.find_poses", never)
        return shot

    return make


def seen(pipeline: Any) -> dict[str, torch.Tensor]:
    manager = pipeline.datamanager
    result = {"points": manager.train_dataparser_outputs.metadata["points3D_xyz"]}
    for dataset in (manager.train_dataset, manager.eval_dataset):
        poses = dataset.cameras.camera_to_worlds
        result |= {path.name: pose for path, pose in zip(dataset.image_filenames, poses, strict=True)}
    return result


@pytest.mark.parametrize("upright", [False, True], ids=["as they are", "upright copies"])
def test_evaluation_has_training_poses(
    shoot: Callable[..., Shot], upright: bool, capsys: Printed, monkeypatch: Patch
) -> None:
    shot = shoot(upright)
    monkeypatch.setattr("bitymi_ns.capture.poses.find_poses", shot.find_poses)
    kept = shot.run / POSES
    kept.rename(shot.run / "aside")  # like a run of an earlier version, which estimates again
    _, before = load_trained(shot.run / "config.yml")
    trained, world = seen(before), world_of(before.datamanager).described()
    held_out = before.datamanager.eval_view(0)[1]["image"]
    (shot.run / "aside").rename(kept)
    monkeypatch.setattr("bitymi_ns.capture.poses.find_poses", never)

    shot.spoil()
    capsys.readouterr()
    _, after = load_trained(shot.run / "config.yml")
    assert different(trained, seen(after)) == []
    assert torch.equal(held_out, after.datamanager.eval_view(0)[1]["image"])
    stated = world_of(after.datamanager).described()
    assert stated.keys() == world.keys() and "metres_per_unit" in stated
    assert all(np.array_equal(stated[key], world[key]) for key in world)
    text = printed(capsys)
    assert f"Poses of 12 photographs of {shot.photographs} as the run was trained with them, of {kept}." in text
    assert "frame_00099.png (blurred)" in text and ("frame_00000_new.png" in text) is not upright


def test_linked_pictures_take_no_space(shoot: Callable[..., Shot], monkeypatch: Patch, tmp_path: Path) -> None:
    shot = shoot(upright=True)
    copy, link = sorted((shot.run / POSES / "images").iterdir())[:2]
    assert copy.samefile(shot.images / copy.name) and not copy.is_symlink()
    assert link.readlink() == shot.photographs / link.name
    shutil.rmtree(shot.run)

    def refused(*arguments: Any) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refused)
    monkeypatch.setattr("bitymi_ns.capture.poses.find_poses", shot.find_poses)
    shot.config.max_num_iterations = 1
    ns_train.main(shot.config)
    assert copy.read_bytes() == (shot.images / copy.name).read_bytes()
    assert not copy.samefile(shot.images / copy.name) and link.is_symlink()


def test_poses_not_kept_do_not_stop_the_run(shoot: Callable[..., Shot], monkeypatch: Patch, capsys: Printed) -> None:
    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(folder_lock, "write_kept_poses", full)
    shot = shoot()
    assert checkpoint(shot.config, STEPS - 1)["step"] == STEPS - 1 and not (shot.run / POSES).exists()
    assert "the disk is full" in (text := printed(capsys)) and "Nor are the poses: leave the photographs" in text


def test_a_resumed_run_goes_on_in_the_same_world(shoot: Callable[..., Shot]) -> None:
    shot = shoot()
    shot.spoil()
    for name, by in (("dir", "load_dir"), ("file", "load_checkpoint")):
        config = small_run(shot.photographs, shot.outputs, name)
        config.max_num_iterations, config.steps_per_save = STEPS, 2
        folder = shot.config.get_checkpoint_dir()
        setattr(config, by, folder if by == "load_dir" else folder / "step-000000002.ckpt")
        if by == "load_dir":
            config.load_step = 2
        ns_train.main(config)
        assert different(checkpoint(shot.config, STEPS - 1), checkpoint(config, STEPS - 1)) == []
        assert (config.get_base_dir() / POSES / "sparse/0/images.txt").is_file()
    shutil.rmtree(shot.run)
    eval_setup(config.get_base_dir() / "config.yml")


def test_options_for_poses_not_found_anew(shoot: Callable[..., Shot], capsys: Printed) -> None:
    shot = shoot(sfm=SfmSettings(mapper="global", max_features=500))

    def go_on(name: str, sfm: SfmSettings, used: SfmSettings) -> str:
        config = small_run(shot.photographs, shot.outputs, name)
        config.load_dir = shot.config.get_checkpoint_dir()
        config.pipeline.datamanager.dataparser.sfm = sfm
        capsys.readouterr()
        config.set_timestamp()
        assert config.pipeline.datamanager.dataparser.sfm == used
        return printed(capsys)

    given = SfmSettings(mapper="global", max_features=500)
    for same in (SfmSettings(), SfmSettings(mapper="global"), given):
        assert "--sfm" not in go_on("same", same, given)
    text = go_on("other", SfmSettings(mapper="incremental", max_features=500, frames=7), given)
    assert "--sfm.mapper incremental and --sfm.frames 7 are not used" in text and "leave out --load-dir" in text
    assert str(shot.run / POSES) in text
    origin = shot.run / POSES / "origin.json"
    edit(origin, lambda values: values["origin"].pop("settings"))  # as in earlier versions
    assert "--sfm.frames 7 is not used" in go_on("earlier", SfmSettings(frames=7), SfmSettings(frames=7))


def test_a_run_that_goes_on_in_its_own_folder(shoot: Callable[..., Shot]) -> None:
    shot = shoot(upright=True)
    shot.spoil()
    kept = sorted(path for path in (shot.run / POSES).rglob("*"))
    config = config_of(shot.run)
    config.load_dir, config.max_num_iterations = shot.config.get_checkpoint_dir(), STEPS + 2
    ns_train.main(config)
    assert sorted(path for path in (shot.run / POSES).rglob("*")) == kept
    assert checkpoint(config, STEPS + 1)["step"] == STEPS + 1
    gone = shot.photographs / "frame_00004.png"  # behind a link
    gone.unlink()
    with pytest.raises(InputError, match=f"trained with, 1 are missing \\({gone}\\), so"):
        eval_setup(shot.run / "config.yml")


def test_a_run_that_was_moved_and_a_capture_with_other_files_by_now(shoot: Callable[..., Shot], tmp_path: Path) -> None:
    shot = shoot(data=Path("first"))
    poses = seen(eval_setup(shot.run / "config.yml")[1])
    moved = a_run_of(shot.config, tmp_path / "elsewhere")
    shutil.rmtree(shot.outputs)
    shot.spoil()
    capture = shot.photographs.parent
    shutil.copytree(shot.photographs, capture / "second")
    (capture / "transforms.json").write_text("{}")  # takes precedence over photographs, but not over kept poses
    assert different(poses, seen(eval_setup(moved / "config.yml")[1])) == []


def test_a_bundle_has_its_runs_world(shoot: Callable[..., Shot], tmp_path: Path, capsys: Printed) -> None:
    shot = shoot()
    shot.spoil()
    poses = seen(load_trained(shot.run / "config.yml")[1])
    run_export(shot.config, tmp_path / "bundle", finetune_steps=0)
    assert different(poses, seen(eval_setup(tmp_path / "bundle/config.yml")[1])) == []
    shutil.rmtree(shot.run)
    with pytest.raises(pytest.fail.Exception, match="poses are found anew"):
        eval_setup(tmp_path / "bundle/config.yml")
    assert f"are no longer in {shot.run / POSES}: others can be found now" in printed(capsys)


def test_photographs_that_changed_are_named_in_one_message(shoot: Callable[..., Shot]) -> None:
    shot = shoot()
    gone, smaller = [shot.photographs / f"frame_0000{i}.png" for i in (3, 5)]
    Image.open(smaller).resize((24, 18)).save(smaller)
    with pytest.raises(InputError) as only_size:
        eval_setup(shot.run / "config.yml")
    size = f"1 have another size ({smaller}: 24 x 18 pixels, 48 x 36 then)"
    assert f"of the 12 photographs that the run was trained with, {size}, so" in str(only_size.value)
    gone.unlink()
    with pytest.raises(InputError) as both:
        eval_setup(shot.run / "config.yml")
    assert f"trained with, 1 are missing ({gone}) and {size}, so" in str(both.value)
    assert str(shot.run / POSES) in str(both.value)
    for path in shot.photographs.iterdir():
        path.unlink()
    with pytest.raises(InputError, match="12 are missing"):
        eval_setup(shot.run / "config.yml")
    eval_setup(shot.run / "config.yml", test_mode="inference")  # needs none


DAMAGED = ["", "[]", "{}", json.dumps({"origin": {"kind": "photographs"}, "left_out": {}}),
           json.dumps({"origin": {"kind": "x", "path": ".", "photographs": None}, "left_out": {}})]  # fmt: skip


def test_damaged_poses_are_named_and_other_runs_find_their_own(shoot: Callable[..., Shot], monkeypatch: Patch) -> None:
    shot = shoot()
    origin = shot.run / POSES / "origin.json"
    config = config_of(shot.run)
    config.pipeline.datamanager.dataparser.poses = shot.run / POSES  # as in a resumed run
    config.timestamp = "new"
    with pytest.raises(pytest.fail.Exception, match="poses are found anew"):
        ns_train.main(config)
    for text in DAMAGED:
        origin.write_text(text)
        with pytest.raises(InputError, match=r"origin.json, which says .* cannot be read"):
            eval_setup(shot.run / "config.yml")
    shutil.rmtree(shot.run / POSES / "sparse")
    origin.unlink()
    rewrite(shot.run, lambda config: vars(config.pipeline.datamanager.dataparser).pop("poses"))  # an earlier version
    with pytest.raises(pytest.fail.Exception, match="poses are found anew"):
        eval_setup(shot.run / "config.yml")
    monkeypatch.setattr("bitymi_ns.capture.poses.find_poses", shot.find_poses)
    eval_setup(shot.run / "config.yml")
