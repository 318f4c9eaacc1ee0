"""BC7 encoding of atlas pages (ispc_texcomp); `ops.baked_scene.decode_bc7` decodes the blocks."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

Profile = Literal["slow", "basic", "fast", "veryfast", "ultrafast"]
AlphaProfile = Literal["alpha_slow", "alpha_basic", "alpha_fast", "alpha_veryfast", "alpha_ultrafast"]
WITH_ALPHA: dict[Profile, AlphaProfile] = dict(zip(get_args(Profile), get_args(AlphaProfile), strict=True))

STRIP = 64  # rows per encoder call: enough calls for all threads and for progress


def bc7_encoder(profile: Profile, alpha: bool = False) -> Callable[[npt.NDArray[np.uint8]], bytes]:
    """Return a function that encodes RGBA texels [h, w, 4] (sides multiples of 4) to BC7 blocks, row by row; without
    `alpha` all alphas are 255. Raises RuntimeError: the encoder is not installed; ValueError: unknown profile."""
    try:
        import ispc_texcomp
    except ImportError as error:
        remedy = "`pip install ispc_texcomp` (Python 3.11 or later), or choose another format"
        raise RuntimeError(f"BC7 needs the encoder ispc_texcomp: {remedy}") from error
    if profile not in WITH_ALPHA:
        raise ValueError(f"the BC7 profile must be {', '.join(WITH_ALPHA)}, not {profile!r}")
    settings = ispc_texcomp.BC7EncSettings.from_profile(WITH_ALPHA[profile] if alpha else profile)

    def compress(rgba: npt.NDArray[np.uint8]) -> bytes:
        height, width = rgba.shape[:2]
        surface = ispc_texcomp.RGBASurface(rgba.tobytes(), width, height)
        return bytes(ispc_texcomp.compress_blocks_bc7(surface, settings))

    return compress


def bc7_blocks(pages: npt.NDArray[np.uint8], profile: Profile, alpha: bool = False) -> npt.NDArray[np.uint8]:
    """Encode texels [layers, height, width, 4] as `bc7_encoder` does: [layers, height / 4, width / 4, 16] blocks."""
    compress = bc7_encoder(profile, alpha)
    layers, height, width, _ = pages.shape
    strips = [page[top : top + STRIP] for page in pages for top in range(0, height, STRIP)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        blocks = bytearray().join(pool.map(compress, strips))
    return np.frombuffer(blocks, np.uint8).reshape(layers, height // 4, width // 4, 16)
