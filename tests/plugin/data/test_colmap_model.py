"""COLMAP models as other programs and editors write them."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from bitymi_ns.capture.colmap_model import read_model, write_model
from tests.captures import as_binary, held_out, load_any, printed


def points(project: Path, *rows: str) -> Path:
    (project / "sparse/0/points3D.txt").write_text("".join(f"{i} {row}\n" for i, row in enumerate(rows, 1)))
    return project / "sparse/0"


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_3dgs_list_of_held_out_views(project: Path, encoding: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = project / "sparse/0/test.txt"
    path.write_text("frame_00004.png\nframe_00007\nframe_00099.png\n")
    assert held_out(load_any(project)) == ["frame_00004.png", "frame_00007.png"]
    assert f"2 of 12 photographs, by {path} (frame_00004.png, frame_00007.png)" in (text := printed(capsys))
    assert f"{path}: 1 of 3 names are of no photograph of the capture." in text
    (project / "test_list.txt").write_text("frame_00001.png\n", encoding)
    assert held_out(load_any(project)) == ["frame_00001.png"]


@pytest.mark.parametrize("name", ["{}", "my {}", "my photo {}"])
def test_images_without_their_second_line(project: Path, name: str) -> None:
    path = project / "sparse/0/images.txt"
    lines = [line.split() for line in path.read_text().splitlines() if line]
    path.write_text("".join(f"{' '.join(words[:9])} {name.format(words[9])}\n" for words in lines))
    assert [image.name for image in read_model(path.parent).images] == [name.format(words[9]) for words in lines]


def test_spheres_of_sphere_sfm(project: Path) -> None:
    (project / "sparse/0/cameras.txt").write_text("1 SPHERE 48 24 1.0 24 12\n")
    assert read_model(project / "sparse/0").cameras == {1: ("EQUIRECTANGULAR", 48, 24, (48.0, 24.0))}


@pytest.mark.parametrize(
    ("colors", "expected"),
    [
        (("200 10 0", "1 0 1"), [[200, 10, 0], [1, 0, 1]]),
        (("0.8 0.04 0", "1 0 1"), [[204, 10, 0], [255, 0, 255]]),
        (("65535 2570 0", "257 0 257"), [[255, 10, 0], [1, 0, 1]]),
        (("200.0 10.4 0.0", "1 0 1"), [[200, 10, 0], [1, 0, 1]]),
    ],
)
def test_colors_by_which_white_they_fit(project: Path, colors: tuple[str, str], expected: list[list[int]]) -> None:
    model = read_model(points(project, f"0 0 0.5 {colors[0]} 0.5", f"0.1 0 0.5 {colors[1]} 0.5"))
    assert model.rgb.tolist() == expected and not model.without_colors


def test_two_forms_that_differ(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = project / "sparse/0"
    texts = {path.name: path.read_text() for path in folder.iterdir()}
    as_binary(folder)
    for name, text in texts.items():
        (folder / name).write_text(text)
    read_model(folder)
    assert "two models" not in printed(capsys)
    (folder / "cameras.txt").write_text("1 PINHOLE 48 36 20 20 24 18\n")
    read_model(folder)
    assert f"{folder} holds two models, of 12 images in text and 12 in binary form" in printed(capsys)
    (folder / "images.txt").write_text("\n".join(texts["images.txt"].split("\n")[:8]))
    assert len(read_model(folder).images) == 4
    assert f"{folder} holds two models, of 4 images in text and 12 in binary form" in printed(capsys)


def test_a_single_file_in_text_is_of_another_model(project: Path) -> None:
    folder = project / "sparse/0"
    as_binary(folder)
    (folder / "cameras.txt").write_text("1 PINHOLE 48 36 20 20 24 18\n")
    assert read_model(folder).cameras[1].params[0] == 40.0


@pytest.fixture
def synthetic() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=9, num_points3D=50)
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("name", ["rigs", "cameras", "frames", "images", "points3D"])
def test_each_file_of_a_model_is_checked_and_the_true_reason_named(
    tmp_path: Path, name: str, synthetic: pycolmap.Reconstruction
) -> None:
    (tmp_path / f"{name}.bin").mkdir()
    with pytest.raises(IsADirectoryError):
        write_model(synthetic, tmp_path)
    (tmp_path / f"{name}.bin").rmdir()

    def loses_its_last_byte(folder: Path) -> None:
        synthetic.write_binary(folder)
        path = folder / f"{name}.bin"
        path.write_bytes(path.read_bytes()[:-1])

    with pytest.raises(OSError, match="Input/output error"):
        write_model(SimpleNamespace(write_binary=loses_its_last_byte), tmp_path)


@pytest.mark.parametrize("form", ["txt", "bin"])
def test_every_camera_of_a_rig_has_its_own_pose_in_a_model(tmp_path: Path, form: str) -> None:
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=20, sensor_from_rig_rotation_stddev=20.0
    )
    pycolmap.set_random_seed(0)
    written = pycolmap.synthesize_dataset(options)
    (written.write_text if form == "txt" else written.write_binary)(tmp_path)
    by_name = {image.name: image for image in written.images.values()}
    images = read_model(tmp_path).images
    assert len(images) == len(by_name) == 6
    for image in images:
        other = by_name[image.name]
        x, y, z, w = other.cam_from_world().rotation.quat
        np.testing.assert_allclose(image.qvec, [w, x, y, z], atol=1e-12)
        np.testing.assert_allclose(image.tvec, other.cam_from_world().translation, atol=1e-12)
        assert (image.camera_id, image.frame) == (other.camera_id, other.frame_id)
    (turn,) = {round(image.cam_from_world().rotation.angle_to(image.frame.rig_from_world.rotation), 9)
               for image in by_name.values() if image.camera_id == 2}  # fmt: skip
    assert turn > 0.01  # or the poses would prove nothing
