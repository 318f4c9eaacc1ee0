"""Frames of HLG and PQ videos become as bright and colourful as those of an SDR video."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from bitymi_ns.capture.video import HLG, HLG_PEAK, LUMA, PQ, TO_709, WHITE, _frames, _picture, hlg_to_nits, pq_to_nits


def scene() -> np.ndarray:
    """Build [64, 64, 3] sRGB in [0, 1], below the knee: a grey ramp over a colourful one."""
    ramp = np.linspace(0.05, 0.85, 64)
    grey = np.repeat(ramp[None, :, None], 32, 0).repeat(3, 2)
    return np.concatenate([grey, np.stack([grey[..., 0], grey[::-1, ::-1, 0], np.full((32, 64), 0.4)], -1)])


def coded(picture: np.ndarray, transfer: int) -> np.ndarray:
    """Encode the picture as 10-bit video: Y, Cb and Cr of limited range."""
    light = np.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4)
    nits = np.clip(WHITE * light @ np.linalg.inv(TO_709).T, 0.0, None)
    steps = np.linspace(0.0, 1.0, 20001).astype(np.float64)
    if transfer == PQ:
        signal = np.interp(nits, pq_to_nits(steps), steps)
    else:
        luminance = np.maximum(nits @ LUMA, 1e-6)[..., None] / HLG_PEAK
        scene_light = nits / HLG_PEAK * luminance ** (1 / 1.2 - 1.0)
        grey = np.repeat(steps[:, None], 3, 1)
        signal = np.interp(scene_light, (hlg_to_nits(grey)[:, 0] / HLG_PEAK) ** (1 / 1.2), steps)
    y = signal @ LUMA
    cb, cr = (signal[..., 2] - y) / (2 - 2 * LUMA[2]), (signal[..., 0] - y) / (2 - 2 * LUMA[0])
    return np.stack([64 + 876 * y, 512 + 896 * cb, 512 + 896 * cr]).round().astype(np.uint16)


@pytest.mark.parametrize("transfer", [HLG, PQ])
def test_frames_are_as_bright_as_the_scene(tmp_path: Path, transfer: int) -> None:
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=Fraction(10))
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv444p10le"
        context = stream.codec_context
        context.color_trc, context.color_primaries, context.colorspace, context.color_range = transfer, 9, 9, 1
        frame = av.VideoFrame(64, 64, "yuv444p10le")
        for plane, values in zip(frame.planes, coded(scene(), transfer), strict=True):
            rows = np.zeros((64, plane.line_size // 2), np.uint16)
            rows[:, :64] = values
            plane.update(rows.tobytes())
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    ((_, found),) = _frames(path)
    pixels = np.asarray(_picture(found), np.float64) / 255.0
    error = np.abs(pixels - scene())
    assert error.max() < 0.05 and error.mean() < 0.01  # of 10 bits, in 8
    as_it_is = np.asarray(found.to_image(), np.float64) / 255.0
    assert np.abs(as_it_is - scene()).mean() > 0.03  # pale, or dark


def test_white_and_what_is_brighter() -> None:
    assert float(pq_to_nits(np.float64(0.58))) == pytest.approx(WHITE, rel=0.01)
    assert hlg_to_nits(np.full((1, 3), 0.75))[0, 0] == pytest.approx(WHITE, rel=0.01)
    assert float(pq_to_nits(np.float64(1.0))) == pytest.approx(10_000.0)
    assert hlg_to_nits(np.ones((1, 3)))[0, 0] == pytest.approx(HLG_PEAK, rel=1e-3)
