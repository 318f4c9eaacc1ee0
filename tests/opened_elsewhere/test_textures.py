"""Atlases, read by ktx-parse and another BC7 decoder."""

import base64
from pathlib import Path

import numpy as np
import pytest
import texture2ddecoder

from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops.baked_scene import decode_bc7
from tests.bundle.made import make
from tests.opened_elsewhere.node import said_by

VULKAN = {"bc7": 145, "uint8": 37, "fp16": 97}
"""VK_FORMAT_BC7_UNORM_BLOCK, VK_FORMAT_R8G8B8A8_UNORM, VK_FORMAT_R16G16B16A16_SFLOAT"""


@pytest.mark.parametrize("format", list(VULKAN))
def test_ktx_parse_reads_an_atlas(surfels, format: str, tmp_path: Path) -> None:
    _, _, _, atlas = make(surfels, tmp_path / "b", format=format, count=40)
    found = said_by("read_ktx2.mjs", "ktx-parse", tmp_path / "b" / "atlas.ktx2")
    assert found["vkFormat"] == VULKAN[format] and found["levels"] == found["faceCount"] == 1
    assert found["supercompressionScheme"] == found["pixelDepth"] == 0 and found["layerCount"] == len(atlas.payload)
    assert found["keyValue"]["KTXwriter"].startswith("bitymi") and found["keyValue"]["KTXorientation"] == "rd"
    assert base64.b64decode(found["data"]) == b"".join(atlas.payload)
    if format == "bc7":
        read = other_decoder(atlas.payload[0], found["pixelWidth"], found["pixelHeight"])
        ours = read_bundle(tmp_path / "b").scene.atlas[0].numpy()
        assert np.array_equal(read, ours)


def other_decoder(blocks: bytes, width: int, height: int) -> np.ndarray:
    """Decode to [height, width, 4] RGBA by texture2ddecoder, which returns BGRA."""
    read = np.frombuffer(texture2ddecoder.decode_bc7(blocks, width, height), np.uint8)
    return read.reshape(height, width, 4)[..., [2, 1, 0, 3]]


@pytest.mark.parametrize("mode", range(8))
def test_another_decoder_of_bc7_agrees(mode: int) -> None:
    blocks = np.random.default_rng(mode).integers(0, 256, (1000, 16), np.uint8)
    blocks[:, 0] = blocks[:, 0] >> (mode + 1) << (mode + 1) | 1 << mode
    ours = np.asarray(decode_bc7(blocks.tobytes(), 4000, 4))
    assert np.array_equal(ours.reshape(4, 4000, 4), other_decoder(blocks.tobytes(), 4000, 4))
