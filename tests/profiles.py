"""ICC profiles."""

import struct

from PIL import ImageCms


def profile(red: tuple[float, ...], green: tuple[float, ...], blue: tuple[float, ...]) -> bytes:
    """Build a profile like sRGB's with other primaries (XYZ, D50)."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    tags = {
        bytes(data[at : at + 4]): struct.unpack_from(">I", data, at + 4)[0]
        for at in range(132, 132 + 12 * data[131], 12)
    }
    for name, primary in ((b"rXYZ", red), (b"gXYZ", green), (b"bXYZ", blue)):
        struct.pack_into(">3i", data, tags[name] + 8, *(round(65536 * value) for value in primary))
    return bytes(data)


DISPLAY_P3 = profile((0.5151, 0.2412, -0.0011), (0.2920, 0.6922, 0.0419), (0.1571, 0.0666, 0.7841))
SRGB = profile((0.4361, 0.2225, 0.0139), (0.3851, 0.7169, 0.0971), (0.1431, 0.0606, 0.7141))
