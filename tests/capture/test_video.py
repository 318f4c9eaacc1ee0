from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from bitymi_ns.capture import CaptureError, SfmOptions, find_poses
from bitymi_ns.capture.video import choose, displacement, extract_frames


def silent(step: str, done: int, total: int) -> None: ...


def write_video(path: Path, frames: list[np.ndarray], rate: int = 10) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=Fraction(rate))
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        container.mux(stream.encode())


@pytest.fixture(scope="module")
def wide() -> np.ndarray:
    """A picture to pan over."""
    noise = np.random.default_rng(0).integers(0, 256, (40, 160, 3)).astype(np.uint8)
    return np.asarray(Image.fromarray(noise).resize((1280, 320), Image.BICUBIC))


def pan(wide: np.ndarray, steps: list[int]) -> list[np.ndarray]:
    return [wide[40:280, step : step + 320] for step in np.cumsum(steps)]


def numbers(folder: Path) -> list[int]:
    return sorted(int(path.stem.split("_")[1]) for path in folder.iterdir())


def test_the_displacement_is_that_of_the_picture(wide: np.ndarray) -> None:
    grey = wide.mean(axis=2)[::2, ::2]
    for shift in (0, 3, 7):
        measured = displacement(grey[:120, :160], grey[:120, shift : shift + 160]) * 160
        assert measured == pytest.approx(shift, abs=0.7)


def test_frames_are_taken_where_the_camera_moves(tmp_path: Path, wide: np.ndarray) -> None:
    steps = [0] * 20 + [16] * 40 + [0] * 20
    write_video(tmp_path / "a.mp4", pan(wide, steps))
    taken = numbers(extract_frames(tmp_path / "a.mp4", tmp_path, None, silent))
    moving = [number for number in taken if 19 <= number <= 61]
    assert 20 <= len(taken) <= 45 and len(moving) >= len(taken) - 2
    assert max(np.diff(moving)) <= 5


def test_the_sharpest_of_each_stretch_is_taken() -> None:
    motion, sharp = np.linspace(0, 1, 9), np.array([1, 5, 1, 2, 1, 1, 9, 1, 3.0])
    assert choose(motion, sharp, 3) == [1, 3, 6]
    assert choose(np.array([0, 0.1, 1.0]), np.ones(3), 50) == [0, 1, 2]


def test_a_number_of_frames_can_be_asked_for(tmp_path: Path, wide: np.ndarray) -> None:
    write_video(tmp_path / "a.mp4", pan(wide, [16] * 40))
    assert len(numbers(extract_frames(tmp_path / "a.mp4", tmp_path, 10, silent))) == 10


def test_frames_are_taken_once(tmp_path: Path, wide: np.ndarray) -> None:
    write_video(tmp_path / "a.mp4", pan(wide, [16] * 30))
    folder = extract_frames(tmp_path / "a.mp4", tmp_path, 10, silent)
    (tmp_path / "a.mp4").unlink()
    assert extract_frames(tmp_path / "a.mp4", tmp_path, 10, silent) == folder


def test_the_rotation_of_a_phone_is_applied(tmp_path: Path, wide: np.ndarray) -> None:
    frames = pan(wide, [16] * 12)
    write_video(tmp_path / "a.mp4", frames)
    data = (tmp_path / "a.mp4").read_bytes()
    # The matrix in the track's header (tkhd): 1 0 0, 0 1 0, 0 0 1 becomes that of a phone held upright.
    flat = b"".join(int(v).to_bytes(4, "big", signed=True) for v in (65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30))
    turned = b"".join(
        int(v).to_bytes(4, "big", signed=True) for v in (0, 65536, 0, -65536, 0, 0, 240 << 16, 0, 1 << 30)
    )
    at = data.index(flat, data.index(b"tkhd"))
    (tmp_path / "b.mp4").write_bytes(data[:at] + turned + data[at + len(flat) :])
    taken = sorted(extract_frames(tmp_path / "b.mp4", tmp_path, 4, silent).iterdir())
    picture = np.asarray(Image.open(taken[0]), float)
    number = int(taken[0].stem.split("_")[1])
    assert picture.shape == (320, 240, 3)
    assert np.abs(picture - np.rot90(frames[number], -1)).mean() < 12  # turned clockwise to be seen


def test_a_video_without_motion_is_refused(tmp_path: Path, wide: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    still = wide[40:280, :320].astype(float)
    write_video(
        tmp_path / "a.mp4", [np.clip(still + rng.normal(0, 3, still.shape), 0, 255).astype(np.uint8) for _ in range(30)]
    )
    with pytest.raises(CaptureError, match="shows no motion: .* Film while you walk"):
        extract_frames(tmp_path / "a.mp4", tmp_path, None, silent)
    assert not (tmp_path / "images").exists()


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video at all" * 100)
    with pytest.raises(CaptureError, match="cannot be read as a video"):
        extract_frames(tmp_path / "a.mp4", tmp_path, None, silent)


def test_a_video_that_breaks_off_gives_what_it_has(tmp_path: Path, wide: np.ndarray) -> None:
    write_video(tmp_path / "a.avi", pan(wide, [16] * 40))
    whole = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "a.avi").write_bytes(whole[: len(whole) // 2])
    assert len(numbers(extract_frames(tmp_path / "a.avi", tmp_path, None, silent))) >= 8


def test_a_video_of_a_scene_gives_poses(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    path = tmp_path / "a walk.mp4"
    write_video(path, [picture for picture in pictures for _ in range(2)])
    poses = find_poses(path, SfmOptions(frames=8))
    assert poses.given >= 6 and poses.registered >= poses.given - 1
    assert poses.images.parent.parent == tmp_path / ".bitymi"
    assert all(path.name.startswith("frame_") for path in poses.images.iterdir())
