"""The presets' dataparser on captures with a transforms.json, of Blender and of instant-ngp."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import tyro
import yaml
from nerfstudio.data.dataparsers.base_dataparser import DataParser
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.minimal_dataparser import MinimalDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from bitymi_ns.capture.read import OPTION_FORMATS
from bitymi_ns.plugin import methods
from bitymi_ns.plugin.data.capture_checks import bitymi_parser
from bitymi_ns.plugin.data.dataparser import BitymiDataParserConfig
from bitymi_ns.plugin.data.facts import CaptureFacts
from bitymi_ns.plugin.data.views import with_lenses
from tests import captures
from tests.captures import colmap_model, edit, edit_frames, expect, held_out, images_of, load, load_any, printed
from tests.formats import instant_ngp


def sides(of: Any) -> tuple[Any, Any, Any]:
    """Return training and evaluation views and the outputs with points, of a data manager or a nerfstudio parser."""
    if isinstance(of, DataParser):
        train = of.get_dataparser_outputs("train")
        return train, of.get_dataparser_outputs("val"), train
    return of.train_dataset, of.eval_dataset, of.train_dataparser_outputs


def equal(one: Any, other: Any) -> None:
    """Compare views, points and world frame up to float32 rounding."""
    (*views, a), (*other_views, b) = sides(one), sides(other)
    for mine, theirs in zip(views, other_views, strict=True):
        assert mine.image_filenames == theirs.image_filenames
        for column in ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height", "camera_type"):
            same(getattr(mine.cameras, column), getattr(theirs.cameras, column))
    same(a.dataparser_transform[:3], b.dataparser_transform[:3])
    assert a.dataparser_scale == pytest.approx(b.dataparser_scale, rel=1e-5)
    assert ("points3D_xyz" in a.metadata) == ("points3D_xyz" in b.metadata)
    if "points3D_xyz" in a.metadata:
        same(a.metadata["points3D_xyz"], b.metadata["points3D_xyz"])
        assert torch.equal(a.metadata["points3D_rgb"], b.metadata["points3D_rgb"])


def stock(capture: Path, **options: Any) -> DataParser:
    """Make nerfstudio's own parser, without our data manager."""
    return NerfstudioDataParserConfig(data=capture, load_3D_points=True, **options).setup()


def same(one: torch.Tensor, other: torch.Tensor) -> None:
    assert one.shape == other.shape
    assert torch.allclose(one.double(), other.double(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("as_file", [False, True])
def test_a_transforms_json_is_what_nerfstudios_parser_makes_of_it(
    capture: Path, as_file: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    given = capture / "transforms.json" if as_file else capture
    one = load_any(given)
    text = printed(capsys)
    assert f"Reading {capture / 'transforms.json'} (nerfstudio, 12 photographs)." in text
    assert "Held out for evaluation: 2 of 12 photographs, every 8th by name (frame_00001.png, frame_00009.png)." in text
    equal(one, stock(given, eval_mode="interval"))
    manager = load(given)
    equal(one, manager)
    assert torch.equal(one.train_dataset.scene_box.aabb, manager.train_dataset.scene_box.aabb)


def test_options_and_entries_mean_what_they_mean_to_nerfstudio(capture: Path) -> None:
    def change(meta: dict[str, Any]) -> None:
        meta.update(applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0.5]], applied_scale=2.0)
        meta["frames"].reverse()

    edit(capture, change)
    options: dict[str, Any] = {"orientation_method": "vertical", "center_method": "focus", "scale_factor": 0.5}
    for more in ({}, {"eval_interval": 3}, {"eval_mode": "all"}, {"eval_mode": "fraction"}):
        theirs = stock(capture, **{"eval_mode": "interval", **options, **more})
        equal(load_any(capture, **options, **more), theirs)


@pytest.mark.parametrize("turned", [False, True])
def test_every_camera_is_turned_with_its_capture(capture: Path, monkeypatch: pytest.MonkeyPatch, turned: bool) -> None:
    given, eigh = {}, torch.linalg.eigh

    def one_sign(matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Fix the signs of eigenvectors, which vary between processors and decide which capture is upside down."""
        values, vectors = eigh(matrix)
        return values, vectors * vectors.gather(0, vectors.abs().argmax(0, keepdim=True)).sign()

    monkeypatch.setattr(torch.linalg, "eigh", one_sign)

    def turn(frame: dict[str, Any]) -> None:
        pose = np.diag([1.0, 1.0 if turned else -1.0, 1.0 if turned else -1.0, 1.0]) @ frame["transform_matrix"]
        frame["transform_matrix"] = pose.tolist()
        given[Path(frame["file_path"]).name] = pose[:3, :3]

    edit_frames(capture, turn)
    manager = load_any(capture, eval_mode="all", orientation_method="pca")
    cameras = manager.train_dataset.cameras.camera_to_worlds
    nerfstudios = stock(capture, eval_mode="all", orientation_method="pca").get_dataparser_outputs("train")
    transform = manager.train_dataparser_outputs.dataparser_transform
    same(transform, nerfstudios.dataparser_transform)
    for path, found in zip(manager.train_dataset.image_filenames, cameras[:, :, :3].numpy(), strict=True):
        np.testing.assert_allclose(found, transform[:3, :3].numpy() @ given[path.name], atol=1e-5)
    works = bool((torch.linalg.det(nerfstudios.cameras.camera_to_worlds[:, :, :3]) > 0).all())
    assert torch.allclose(cameras, nerfstudios.cameras.camera_to_worlds, atol=1e-5) is works
    assert works is turned  # or one of the two captures proves nothing


def test_the_captures_own_lists_decide_what_is_held_out(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"images/{path.name}" for path in images_of(capture)]
    edit(capture, lambda meta: meta.update(train_filenames=names[3:], val_filenames=names[1:3]))
    one = load_any(capture)
    equal(one, stock(capture))
    assert held_out(one) == ["frame_00002.png", "frame_00003.png"]
    other = load_any(capture, eval_names=("images/frame_00003.png", "frame_00012.png"))  # options override the file
    assert held_out(other) == ["frame_00003.png", "frame_00012.png"] and len(other.train_dataset) == 10
    assert "2 of 12 photographs, by --eval-names (frame_00003.png, frame_00012.png)" in printed(capsys)


@pytest.mark.parametrize("given", ["train", "val", "test", "train val", "train test"])
def test_one_list_is_enough(capture: Path, given: str) -> None:
    names = [f"images/{path.name}" for path in images_of(capture)]
    lists = {f"{split}_filenames": names[2:] if split == "train" else names[:2] for split in given.split()}
    edit(capture, lambda meta: meta.update(lists))
    manager = load(capture)
    assert held_out(manager) == ["frame_00001.png", "frame_00002.png"]
    assert len(manager.train_dataset) == 10


def test_reduced_photographs_of_nerfstudio(capture: Path) -> None:
    captures.reduce_photographs(capture, 2, (24, 18))
    one = load_any(capture, downscale_factor=2)
    equal(one, stock(capture, downscale_factor=2, eval_mode="interval"))
    assert one.cached_train[0]["image"].shape == (18, 24, 3)
    names = [f"images/{path.name}" for path in images_of(capture)]
    edit(capture, lambda meta: meta.update(train_filenames=names[:-1], val_filenames=names[-1:]))
    assert len(load_any(capture, downscale_factor=2).eval_dataset) == 1


def test_photographs_of_one_name_in_two_folders(capture: Path) -> None:
    captures.reduce_photographs(capture, 2, (24, 18))
    (capture / "images/left").mkdir()
    Image.new("RGB", (48, 36), "red").save(capture / "images/left/frame_00001.png")
    edit(capture, lambda meta: meta["frames"][1].update(file_path="images/left/frame_00001.png"))
    manager = load_any(capture, eval_names=("left/frame_00001.png",))
    assert manager.eval_dataset.image_filenames == [capture / "images/left/frame_00001.png"]
    with expect("images/frame_00001.png, images/left/frame_00001.png have the same names in different folders"):
        load_any(capture, downscale_factor=2)


def test_points_of_the_model_that_a_capture_was_made_of(capture: Path) -> None:
    """nerfstudio's parser would offer to convert them."""
    applied = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    colmap_model(capture, capture / "colmap/sparse/0")
    edit(capture, lambda meta: meta.pop("ply_file_path"))
    outputs = load_any(capture).train_dataparser_outputs
    edit(capture, lambda meta: meta.update(applied_transform=applied))  # nerfstudio's default
    parser = NerfstudioDataParserConfig(data=capture, eval_mode="interval").setup()
    theirs = parser.get_dataparser_outputs("train")
    same(outputs.dataparser_transform, theirs.dataparser_transform)
    moved = torch.tensor([[0, 0, 0.5], [0.1, 0, 0.5]]) @ theirs.dataparser_transform[:, :3].T
    expected = (moved + theirs.dataparser_transform[:, 3]) * theirs.dataparser_scale
    assert torch.allclose(outputs.metadata["points3D_xyz"], expected, atol=1e-6)
    assert outputs.metadata["points3D_rgb"].tolist() == [[200, 10, 10], [200, 10, 10]]


# Blender


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    """Six views of 8 x 8 pixels with alpha for training, two in each of the other files."""
    for split, count in (("train", 6), ("val", 2), ("test", 2)):
        (tmp_path / split).mkdir()
        frames = []
        for i in range(count):
            pixels = np.random.default_rng(i).integers(0, 255, (8, 8, 4), np.uint8)
            Image.fromarray(pixels).save(tmp_path / split / f"r_{i}.png")
            turn = np.array([[math.cos(i), 0, math.sin(i)], [0, 1, 0], [-math.sin(i), 0, math.cos(i)]])
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, turn @ [0, 0, 3.0]
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        meta = {"camera_angle_x": 0.7, "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(meta))
    return tmp_path


def test_a_blender_data_set_has_its_own_split_and_alpha(blender: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = load_any(blender)
    equal(one, BlenderDataParserConfig(data=blender).setup())
    text = printed(capsys)
    assert f"Reading {blender}/transforms_train.json (blender, 6 photographs)." in text
    assert "Held out for evaluation: 2 of transforms_val.json and 2 of transforms_test.json." in text
    assert one.train_dataset.facts.has_alpha and one.cached_train[0]["image"].shape == (8, 8, 4)
    assert torch.equal(one.train_dataset.facts.alpha_color, torch.ones(3))
    assert load_any(blender, alpha_color=None).train_dataset.facts.alpha_color is None
    with expect("--eval-names is not for .* read as blender"):
        load_any(blender, eval_names=("r_0.png",))


def test_one_file_of_held_out_views_is_enough(blender: Path) -> None:
    (blender / "transforms_val.json").unlink()
    assert [path.parent.name for path in load_any(blender).eval_dataset.image_filenames] == ["test", "test"]
    (blender / "transforms_test.json").unlink()
    manager = load_any(blender)  # held out from training views by the common rule
    assert held_out(manager) == ["r_0.png"]
    assert len(manager.train_dataset) == 5
    path = blender / "transforms_train.json"  # named with its extension
    path.write_text(path.read_text().replace('"./train/r_1"', '"./train/r_1.png"'))
    assert load_any(blender).train_dataset.image_filenames[0] == blender / "train/r_1.png"


# instant-ngp


def test_instant_ngps_transforms(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    instant_ngp(capture)
    edit_frames(capture, lambda frame: frame.update(file_path=f"./{frame['file_path'].removesuffix('.png')}"))
    one = load_any(capture)
    text = printed(capsys)
    assert "transforms.json (instant-ngp, 12 photographs)" in text
    assert "If nerfstudio wrote it: `bitymi-data --format nerfstudio`." in text
    assert held_out(one) == ["frame_00001.png", "frame_00009.png"]
    assert one.train_dataset.facts.declares_box is True
    assert one.train_dataset.scene_box.aabb.tolist() == [[-2.0] * 3, [2.0] * 3]
    theirs = InstantNGPDataParserConfig(data=capture, eval_mode="all").setup().get_dataparser_outputs("train")
    places = {p.name: c[:, 3] for p, c in zip(theirs.image_filenames, theirs.cameras.camera_to_worlds, strict=True)}
    for path, pose in zip(one.train_dataset.image_filenames, one.train_dataset.cameras.camera_to_worlds, strict=True):
        same(places[path.name], pose[:, 3])


def test_focal_lengths_of_instant_ngp(capture: Path) -> None:
    instant_ngp(capture)
    edit(capture, lambda meta: meta.update(fl_x=40.0, fl_y=50.0, camera_angle_x=1.1))
    cameras = load_any(capture).train_dataset.cameras
    assert (float(cameras.fx[0]), float(cameras.fy[0])) == (40.0, 50.0)
    edit(capture, lambda meta: (meta.pop("fl_x"), meta.pop("fl_y"), meta.update(camera_angle_y=0.9)))
    fy = float(load_any(capture).train_dataset.cameras.fy[0])
    assert fy == pytest.approx(18 / math.tan(0.45))


# on the command line, and in config.yml


def parsed(*args: str) -> Any:
    default = methods.bitymi.config
    return tyro.cli(type(default), default=default, args=list(args)).pipeline.datamanager.dataparser


def test_it_is_what_the_presets_read_with() -> None:
    assert OPTION_FORMATS.keys() <= BitymiDataParserConfig.__dataclass_fields__.keys()
    assert isinstance(parsed(), BitymiDataParserConfig)
    given = parsed("bitymi-data", "--data", "x", "--eval-names", "a b.jpg", "\u00e4.jpg", "--downscale-factor", "4")
    assert given == BitymiDataParserConfig(data=Path("x"), eval_names=("a b.jpg", "\u00e4.jpg"), downscale_factor=4)


@pytest.mark.slow
@pytest.mark.parametrize("parser", ["bitymi-data", "nerfstudio-data", "blender-data"])
def test_two_captures_are_refused(tmp_path: Path, parser: str) -> None:
    """nerfstudio silently reads the first."""
    for first in ("--data", "--pipeline.datamanager.data"):
        with expect(rf"two captures are given: .*a \({first}\) and .*b \(--data after the name of the parser\)"):
            parsed(first, str(tmp_path / "a"), parser, "--data", str(tmp_path / "b"))
    with expect(r"two captures are given: .*a \(--data\) and .*b \(--pipeline.datamanager.data\)"):
        parsed("--data", str(tmp_path / "a"), "--pipeline.datamanager.data", str(tmp_path / "b"), parser)
    same = parsed("--data", str(tmp_path / "a"), parser, "--data", f"{tmp_path}/b/../a")
    assert same.data == tmp_path / "b/../a"


def test_nerfstudios_parsers_are_read_by_ours(blender: Path) -> None:
    options = bitymi_parser(NerfstudioDataParserConfig(data=blender, eval_mode="all", scale_factor=2.0))
    own = dict(points="random", depth_unit_scale_factor=1e-3)  # nerfstudio's defaults
    assert options == BitymiDataParserConfig(
        data=blender, format="nerfstudio", eval_mode="all", scale_factor=2.0, **own
    )
    ngp = bitymi_parser(InstantNGPDataParserConfig(data=blender, eval_mode="interval"))
    assert ngp == BitymiDataParserConfig(data=blender, format="instant-ngp", points="random")
    model = bitymi_parser(ColmapDataParserConfig(data=blender, masks_path=Path("m")))
    assert (model.format, model.masks_path, model.points) == ("colmap", Path("m"), "auto")
    equal(captures.load_with(blender, BlenderDataParserConfig()), load_any(blender, points="random"))
    for kept in (
        NerfstudioDataParserConfig(mask_color=(1.0, 0.0, 0.0)),
        InstantNGPDataParserConfig(scene_scale=1.0),
        ColmapDataParserConfig(assume_colmap_world_coordinate_convention=False),
        MinimalDataParserConfig(),
    ):
        assert bitymi_parser(kept) is kept


def test_parsers_of_other_formats_are_undistorted_by_lenses(capture: Path) -> None:
    """Captures read by nerfstudio become the views of our parser."""
    for distortion in ({}, {"k1": 0.08, "p2": 0.004}, {"k1": 0.05, "k3": 0.01}, {"camera_model": "OPENCV_FISHEYE"}):
        edit(capture, lambda meta, distortion=distortion: meta.update(camera_model="OPENCV", k1=0, p2=0, k3=0) or
             meta.update(distortion))  # fmt: skip
        ours = load_any(capture)
        read = with_lenses(stock(capture, eval_mode="interval").get_dataparser_outputs("train"))
        for one, other in zip(CaptureFacts.of(read.metadata).lenses, ours.train_dataset.facts.lenses, strict=True):
            assert one.camera.model == other.camera.model and one.pinhole.width == other.pinhole.width
            assert one.camera.params == pytest.approx(other.camera.params, rel=1e-6)


def test_a_list_of_names_is_kept_in_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "names.txt"
    path.write_text("a.jpg\nb.jpg\n")
    run = methods._specification("bitymi").config
    run.pipeline.datamanager.dataparser.eval_names = (str(path),)
    run.set_timestamp()
    again = yaml.load(yaml.dump(run), Loader=yaml.Loader)
    assert again.pipeline.datamanager.dataparser.eval_names == ("a.jpg", "b.jpg")


def test_configurations_of_earlier_runs_are_read(capture: Path) -> None:
    run = methods._specification("bitymi").config
    run.pipeline.datamanager.dataparser = NerfstudioDataParserConfig(eval_mode="interval", load_3D_points=True)
    run.pipeline.datamanager.data = capture
    again = yaml.load(yaml.dump(run), Loader=yaml.Loader).pipeline.datamanager
    equal(again.setup(device="cpu", test_mode="test"), load(capture))


@pytest.mark.parametrize("change", [str.upper, lambda name: Path(name).stem, lambda name: f"C:\\room\\{name}"])
def test_lists_of_names_that_differ_as_those_of_the_photographs_do(capture: Path, change: Any) -> None:
    names = [change(f"images/{path.name}") for path in images_of(capture)]
    edit_frames(capture, lambda frame: frame.update(file_path=change(frame["file_path"])))
    edit(capture, lambda meta: meta.update(train_filenames=names[2:], val_filenames=names[:2]))
    assert list(load_any(capture).eval_dataset.image_filenames) == images_of(capture)[:2]
