"""Tone mapping of high dynamic range frames (HLG or PQ, the 10-bit video of phones) to sRGB; without it they are
pale."""

import av
import numpy as np
import numpy.typing as npt
from PIL import Image

PQ, HLG = 16, 18  # transfer functions as ITU-T H.273 numbers them
FULL_RANGE = 2
WHITE = 203.0  # candelas per square metre of white paper in such films (ITU-R BT.2408); a screen's white here
HLG_PEAK = 1000.0
HLG_GAMMA = 1.2  # peak luminance and gamma of the reference display of HLG (ITU-R BT.2100)
KNEE = 0.8  # light up to this share of white is kept; brighter light is compressed up to white
LUMA = np.array([0.2627, 0.6780, 0.0593])  # luma coefficients of BT.2020
TO_709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
"""BT.2020's red, green and blue to those of BT.709 and sRGB, linear."""


def is_hdr(frame: av.VideoFrame) -> bool:
    """Test for one of these transfer functions."""
    return getattr(frame, "color_trc", None) in (PQ, HLG)


def tone_mapped(frame: av.VideoFrame) -> Image.Image:
    """Convert a frame to 8-bit sRGB."""
    signal = _signal(frame)
    nits = pq_to_nits(signal) if frame.color_trc == PQ else hlg_to_nits(signal)
    light = nits @ TO_709.T / WHITE
    brightest = np.maximum(light.max(-1, keepdims=True), 1e-6)
    light *= _compressed(brightest) / brightest
    return Image.fromarray(np.uint8(_srgb(np.clip(light, 0.0, 1.0)) * 255.0 + 0.5))


def pq_to_nits(signal: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Convert a PQ signal in [0, 1] to display light in cd/m^2 (ITU-R BT.2100)."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = np.maximum(signal, 0.0) ** (1.0 / m2)
    return 10_000.0 * (np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1.0 / m1)


def hlg_to_nits(signal: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Convert an HLG signal [..., 3] in [0, 1] to display light in cd/m^2."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - c) / a) + b) / 12.0)
    luminance = np.maximum(scene @ LUMA, 1e-6)[..., None]
    return HLG_PEAK * luminance ** (HLG_GAMMA - 1.0) * scene


def _signal(frame: av.VideoFrame) -> npt.NDArray[np.float32]:
    """Decode the non-linear RGB signal [h, w, 3] in [0, 1]."""
    whole = frame.reformat(format="yuv444p16le")
    planes = []
    for plane in whole.planes:
        rows = np.frombuffer(plane, np.uint16).reshape(plane.height, plane.line_size // 2)
        planes.append(rows[:, : plane.width].astype(np.float32) / 65536.0)
    if frame.color_range == FULL_RANGE:
        y, cb, cr = planes[0], planes[1] - 0.5, planes[2] - 0.5
    else:
        y, cb, cr = ((p - low / 256.0) * 256.0 / span for p, low, span in
                     zip(planes, (16, 128, 128), (219, 224, 224), strict=True))  # fmt: skip
    red, blue = y + 2.0 * (1.0 - LUMA[0]) * cr, y + 2.0 * (1.0 - LUMA[2]) * cb
    green = (y - LUMA[0] * red - LUMA[2] * blue) / LUMA[1]
    return np.clip(np.stack([red, green, blue], -1), 0.0, 1.0).astype(np.float32)


def _compressed(light: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    rest = 1.0 - KNEE
    return np.where(light <= KNEE, light, KNEE + rest * (1.0 - np.exp(-np.maximum(light - KNEE, 0.0) / rest)))


def _srgb(light: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
