"""Blocks of BC7, 4 x 4 texels in 16 bytes each, where no texture unit decodes them."""

import numpy as np
import numpy.typing as npt
from PIL import Image


def decode_bc7(blocks: bytes, width: int, height: int) -> npt.NDArray[np.uint8]:
    """Texels [height, width, 4] of rows of blocks from the top; the sides are multiples of 4."""
    return np.array(Image.frombytes("RGBA", (width, height), blocks, "bcn", (7, "BC7")))
