import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from bitymi_ns.capture.poses import find_poses
from bitymi_ns.capture.types import CaptureError, SfmOptions
from bitymi_ns.capture.video import PER_SECOND, _survey, choose, displacement, extract_frames
from bitymi_ns.progress import no_progress


def write_video(
    path: Path, frames: list[np.ndarray], rate: int = 10, times: list[int] | None = None, shape: int | Fraction = 1
) -> None:
    """Write frames at a constant rate, or at these times in milliseconds, of this pixel aspect ratio; an MP4 with its
    index first."""
    options = {"movflags": "faststart"} if path.suffix == ".mp4" else {}
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("mpeg4", rate=Fraction(rate))
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        stream.codec_context.sample_aspect_ratio = Fraction(shape)
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for i, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            if times is not None:
                picture.pts, picture.time_base = times[i], Fraction(1, 1000)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def overwrite_packets(path: Path, *numbers: int) -> None:
    """Overwrite packets of a video, counted as they lie in the file."""
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    data = bytearray(path.read_bytes())
    for begin, size in (packets[number] for number in numbers):
        data[begin : begin + size] = bytes(size)
    path.write_bytes(data)


@pytest.fixture(scope="module")
def wide() -> np.ndarray:
    """A picture to pan over."""
    noise = np.random.default_rng(0).integers(0, 256, (40, 160, 3)).astype(np.uint8)
    return np.asarray(Image.fromarray(noise).resize((1280, 320), Image.BICUBIC))


def pan(wide: np.ndarray, steps: list[int]) -> list[np.ndarray]:
    return [wide[40:280, step : step + 320] for step in np.cumsum(steps)]


def numbers(folder: Path) -> list[int]:
    return sorted(int(path.stem.split("_")[1]) for path in folder.iterdir())


@pytest.mark.parametrize("data", ["ffconcat version 1.0\nfile private.mp4\n", "no video at all" * 100])
def test_what_is_no_video_is_refused(tmp_path: Path, wide: np.ndarray, data: str) -> None:
    write_video(tmp_path / "private.mp4", pan(wide, [4] * 6))
    (tmp_path / "a.mp4").write_text(data)
    with pytest.raises(CaptureError, match="a.mp4 cannot be read as a video"):
        extract_frames(tmp_path / "a.mp4", tmp_path, None, no_progress)


def test_a_name_that_begins_like_an_address(tmp_path: Path, wide: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "walk.mp4", pan(wide, [16] * 6))
    (tmp_path / "walk.mp4").rename("subfile:walk.mp4")
    assert len(numbers(extract_frames(Path("subfile:walk.mp4"), tmp_path, 3, no_progress))) == 3


def test_the_displacement_is_that_of_the_picture(wide: np.ndarray) -> None:
    grey = wide.mean(axis=2)[::2, ::2]
    for shift in (0, 3, 7):
        measured = displacement(grey[:120, :160], grey[:120, shift : shift + 160]) * 160
        assert measured == pytest.approx(shift, abs=0.7)


def test_frames_are_taken_where_the_camera_moves(tmp_path: Path, wide: np.ndarray) -> None:
    steps = [0] * 20 + [16] * 40 + [0] * 20
    write_video(tmp_path / "a.mp4", pan(wide, steps))
    taken = numbers(extract_frames(tmp_path / "a.mp4", tmp_path, None, no_progress))
    moving = [number for number in taken if 19 <= number <= 61]
    assert 20 <= len(taken) <= 45 and len(moving) >= len(taken) - 2
    assert max(np.diff(moving)) <= 5


def test_the_sharpest_of_each_stretch_is_taken() -> None:
    motion, sharp = np.linspace(0, 1, 9), np.array([1, 5, 1, 2, 1, 1, 9, 1, 3.0])
    assert choose(motion, sharp, 3) == [1, 3, 6]
    assert choose(np.array([0, 0.1, 1.0]), np.ones(3), 50) == [0, 1, 2]


def test_a_number_of_frames_is_taken_once(tmp_path: Path, wide: np.ndarray) -> None:
    write_video(tmp_path / "a.mp4", pan(wide, [16] * 30))
    folder = extract_frames(tmp_path / "a.mp4", tmp_path, 10, no_progress)
    (tmp_path / "a.mp4").unlink()
    assert len(numbers(folder)) == 10 and extract_frames(tmp_path / "a.mp4", tmp_path, 10, no_progress) == folder


def test_frames_of_a_varying_rate_are_looked_at_by_their_times(tmp_path: Path, wide: np.ndarray) -> None:
    """Half a second at 250 fps without motion, then four at 8 fps with a moving camera."""
    times = [*range(0, 500, 4), *range(500, 4500, 125)]
    still = sum(time < 500 for time in times)
    write_video(tmp_path / "a.mp4", pan(wide, [0] * still + [25] * (len(times) - still)), times=times)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert float(container.streams.video[0].average_rate) > 30  # every other frame, if that were the rate of all
        assert [round(1000 * frame.time) for frame in container.decode(video=0)] == times
    seen, _, _ = _survey(tmp_path / "a.mp4", no_progress)
    assert [number for number in seen if number > still] == list(range(still + 1, len(times)))
    assert 7 <= sum(number <= still for number in seen) <= 11
    taken = numbers(extract_frames(tmp_path / "a.mp4", tmp_path, None, no_progress))
    assert len(taken) >= 20 and sum(number < still for number in taken) <= 1


def test_all_frames_of_a_clip_of_a_second_are_looked_at(tmp_path: Path, wide: np.ndarray) -> None:
    write_video(tmp_path / "a.mp4", pan(wide, [25] * 30), rate=30)
    assert len(numbers(extract_frames(tmp_path / "a.mp4", tmp_path, None, no_progress))) >= 20
    with pytest.raises(CaptureError, match=r"has too few frames \(2\): film for ten"):
        write_video(tmp_path / "b.mp4", pan(wide, [25] * 2), rate=30)
        extract_frames(tmp_path / "b.mp4", tmp_path / "b", None, no_progress)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [24, 30, 60])
def test_of_a_longer_video_about_fifteen_frames_per_second_are_looked_at(
    tmp_path: Path, wide: np.ndarray, rate: int
) -> None:
    write_video(tmp_path / "a.mp4", pan(wide[:, ::4], [0] * (5 * rate)), rate=rate)
    seen, _, _ = _survey(tmp_path / "a.mp4", no_progress)
    assert seen == list(range(0, 5 * rate, round(rate / PER_SECOND)))


@pytest.mark.parametrize(
    ("matrix", "seen"),
    [
        ((0, 1, -1, 0), lambda frame: np.rot90(frame, -1)),
        ((-1, 0, 0, -1), lambda frame: np.rot90(frame, 2)),
        ((0, -1, 1, 0), lambda frame: np.rot90(frame, 1)),
        ((1, 0, 0, 1), np.asarray),
        ((-1, 0, 0, 1), np.fliplr),
        ((1, 0, 0, -1), np.flipud),
        ((0, 1, 1, 0), lambda frame: frame.swapaxes(0, 1)),
        ((0, -1, -1, 0), lambda frame: np.rot90(frame.swapaxes(0, 1), 2)),
        ((0, 0, 0, 0), np.asarray),
        ((1, 1, -1, 1), np.asarray),
    ],
)
def test_every_display_matrix_is_applied_or_named(
    tmp_path: Path,
    wide: np.ndarray,
    matrix: tuple[int, int, int, int],
    seen: Callable[[np.ndarray], np.ndarray],
    caplog: pytest.LogCaptureFixture,
) -> None:
    frames = pan(wide, [16] * 12)
    write_video(tmp_path / "a.mp4", frames)
    data = (tmp_path / "a.mp4").read_bytes()
    header = data.index(b"tkhd")
    stored = data[header:].replace(entries(1, 0, 0, 1), entries(*matrix), 1)
    (tmp_path / "a.mp4").write_bytes(data[:header] + stored)
    for path in extract_frames(tmp_path / "a.mp4", tmp_path, 4, no_progress).iterdir():
        expected = seen(frames[int(path.stem.split("_")[1])])
        picture = np.asarray(Image.open(path), float)
        assert picture.shape == expected.shape and np.abs(picture - expected).mean() < 12
    assert ("is no turn or mirror" in caplog.text) is (sum(map(abs, matrix)) != 2)


def entries(a: int, b: int, c: int, d: int) -> bytes:
    """Pack the matrix of a track's header, without translation."""
    values = (a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    return b"".join(value.to_bytes(4, "big", signed=True) for value in values)


def test_a_video_without_motion_is_refused(tmp_path: Path, wide: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    still = wide[40:280, :320].astype(float)
    noisy = (np.clip(still + rng.normal(0, 3, still.shape), 0, 255).astype(np.uint8) for _ in range(30))
    write_video(tmp_path / "a.mp4", list(noisy))
    with pytest.raises(CaptureError, match="shows no motion: .* Film while you walk"):
        extract_frames(tmp_path / "a.mp4", tmp_path, None, no_progress)
    assert not (tmp_path / "images").exists()


def test_an_error_of_the_decoder_without_a_reason_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise ValueError("a value of the file is out of range")

    (tmp_path / "film.mp4").write_bytes(b"\0" * 64)
    monkeypatch.setattr(av, "open", refuse)
    with pytest.raises(CaptureError, match="out of range"):
        extract_frames(tmp_path / "film.mp4", tmp_path, None, no_progress)


@pytest.mark.parametrize(
    ("name", "share", "line"),
    [
        ("a.avi", 0.5, r"a.avi is damaged: \d+ of its 40 frames are left out"),
        ("a.mp4", 0.5, r"a.mp4 is damaged: \d+ of its 40 frames are left out"),
        ("a.mkv", 0.5, r"a.mkv ends early: its pictures last \d\.\d of 4\.0 seconds"),
        ("a.mkv", 1.0, r"^$"),
    ],
)
def test_a_video_that_breaks_off_gives_what_it_has(
    tmp_path: Path, wide: np.ndarray, caplog: pytest.LogCaptureFixture, name: str, share: float, line: str
) -> None:
    path = tmp_path / name
    write_video(path, pan(wide, [16] * 40))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    assert len(numbers(extract_frames(path, tmp_path, None, no_progress))) >= 8
    assert re.search(line, caplog.text)


def test_frames_that_cannot_be_used_are_named_with_the_reason(tmp_path: Path, wide: np.ndarray) -> None:
    strips = [np.asarray(Image.fromarray(frame).resize((3000, 16))) for frame in pan(wide, [16] * 12)]
    write_video(tmp_path / "a.mp4", strips)
    with pytest.raises(CaptureError, match="of the frames of .*a.mp4, only 0 can be used .*only 3000 x 16 pixels"):
        find_poses(tmp_path / "a.mp4")


def test_frames_behind_damage_keep_their_numbers(
    tmp_path: Path, wide: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    frames = pan(wide, [16] * 40)
    write_video(tmp_path / "a.mp4", frames)  # a key frame every 12
    overwrite_packets(tmp_path / "a.mp4", 15)
    taken = sorted(extract_frames(tmp_path / "a.mp4", tmp_path, 40, no_progress).iterdir())
    assert numbers(tmp_path / "images") == [*range(15), *range(24, 40)]
    assert "a.mp4 is damaged: 9 of its 40 frames are left out" in caplog.text
    for path in taken:
        assert np.abs(np.asarray(Image.open(path), float) - frames[int(path.stem.split("_")[1])]).mean() < 12


@pytest.mark.parametrize("sizes", [[(320, 240)] * 6 + [(240, 320)] * 6, [(3000, 16)] * 12])
def test_frames_of_any_size_are_surveyed(tmp_path: Path, wide: np.ndarray, sizes: list[tuple[int, int]]) -> None:
    """A phone that was turned, which MPEG-TS allows, and a strip."""
    for i, size in enumerate(dict.fromkeys(sizes)):
        frames = pan(wide, [16] * sizes.count(size))
        write_video(tmp_path / f"{i}.ts", [np.asarray(Image.fromarray(frame).resize(size)) for frame in frames])
    parts = sorted(tmp_path.glob("?.ts"))
    (tmp_path / "a.mts").write_bytes(b"".join(part.read_bytes() for part in parts))
    assert len(_survey(tmp_path / "a.mts", no_progress)[0]) == 12
    taken = extract_frames(tmp_path / "a.mts", tmp_path, 12, no_progress).iterdir()
    assert {Image.open(path).size for path in taken} == {*sizes}


def test_a_video_of_a_scene_gives_poses(
    tmp_path: Path, pictures: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    path = tmp_path / "a walk.mp4"
    write_video(path, [picture for picture in pictures for _ in range(2)])
    poses = find_poses(path, SfmOptions(frames=8))
    assert poses.given >= 6 and poses.registered >= poses.given - 1
    assert poses.images.parent.parent == tmp_path / ".bitymi"
    assert all(path.name.startswith("frame_") for path in poses.images.iterdir())
    assert not any((tmp_path / "temporary").iterdir())  # no logs of COLMAP


def test_a_cover_is_not_the_film(tmp_path: Path, wide: np.ndarray) -> None:
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 64, 64, "yuvj420p"
        film = container.add_stream("mpeg4", rate=10)
        film.width, film.height, film.pix_fmt = 320, 240, "yuv420p"
        container.mux(cover.encode(av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), format="rgb24")))
        for frame in pan(wide, [0] + [20] * 20):
            container.mux(film.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        container.mux(film.encode())
    folder = extract_frames(path, tmp_path, None, no_progress)
    assert {Image.open(frame).size for frame in folder.iterdir()} == {(320, 240)}
    assert len(numbers(folder)) > 3


def test_pixels_that_are_not_square_are_stretched(tmp_path: Path, wide: np.ndarray) -> None:
    write_video(tmp_path / "a.mp4", pan(wide, [0] + [20] * 10), shape=Fraction(4, 3))
    folder = extract_frames(tmp_path / "a.mp4", tmp_path, 3, no_progress)
    assert {Image.open(frame).size for frame in folder.iterdir()} == {(427, 240)}
