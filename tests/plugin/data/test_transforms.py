"""Entries of transforms.json beside the poses, valid and invalid."""

from pathlib import Path

import pytest
from PIL import Image

from bitymi_ns.plugin.console import InputError, say, warn
from tests.captures import (
    edit,
    edit_frames,
    held_out,
    images_of,
    load,
    load_any,
    printed,
    save_masks,
)


def test_names_do_not_control_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say("a\x1b[2Jb [red]")
    warn("\x9b")
    assert "a\\x1b[2Jb [red]" in (text := printed(capsys)) and "\\x9b" in text and "\x9b" not in text
    assert str(InputError("\x1b]0;x\x07")) == "bitymi: \\x1b]0;x\\x07"


def test_a_frame_with_a_camera_of_its_own(capture: Path) -> None:
    path = images_of(capture)[5]
    Image.open(path).resize((96, 72)).save(path)
    own = {"w": 96, "h": 72, "fl_x": 80.0, "fl_y": 81.0, "cx": 48.0, "cy": 36.0, "k1": 0.01}
    edit(capture, lambda meta: meta["frames"][5].update(own))
    manager = load(capture)
    train = manager.train_dataset
    index = train.image_filenames.index(path)
    assert train.metadata["lenses"][index].camera.size == (96, 72) and int(train.cameras.width[index - 1]) == 48
    assert float(train.cameras.fy[index]) == 81.0 and float(train.cameras.fy[index - 1]) != 81.0
    assert [lens.distorts for lens in train.metadata["lenses"][index - 1 : index + 1]] == [False, True]
    assert len(manager.cached_train) == 10


def test_doubtful_focal_lengths_are_said(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load(capture)
    assert "focal length" not in printed(capsys)
    edit(capture, lambda meta: meta.update(fl_x=4.2))
    load(capture)
    message = printed(capsys)
    assert message.count("The focal length of") == 1
    assert "is 4.2 pixels (fl_x): 48 pixels of the picture span 160 deg" in message


@pytest.mark.parametrize("given", ["train", "val", "test", "train val", "train test"])
def test_one_list_is_enough(capture: Path, given: str) -> None:
    names = [f"images/{path.name}" for path in images_of(capture)]
    lists = {f"{split}_filenames": names[2:] if split == "train" else names[:2] for split in given.split()}
    edit(capture, lambda meta: meta.update(lists))
    manager = load(capture)
    assert held_out(manager) == ["frame_00001.png", "frame_00002.png"]
    assert len(manager.train_dataset) == 10


@pytest.mark.parametrize("place", ["masks\\", "/home/me/room/masks/", "D:\\room\\Masks\\"])
def test_masks_by_their_names_on_another_machine(capture: Path, place: str) -> None:
    save_masks(capture, lambda i: 255 if i else 0)
    edit_frames(capture, lambda frame: frame.update(mask_path=f"{place}{Path(frame['file_path']).stem}.PNG"))
    manager = load_any(capture)
    assert manager.train_dataset.get_data(0)["mask"].all()
    assert len(manager.eval_dataset) == 1  # the mask of the first photograph, which is held out, is black
