"""Write bc7.json: random BC7 blocks, equally many of every mode, and their texels by the package's decoder."""

import base64
import json
import random
from pathlib import Path

from bitymi_ns.ops.baked_scene import decode_bc7

EACH = 64


def main() -> None:
    draw = random.Random(0)
    blocks = b""
    for mode in range(8):
        for _ in range(EACH):
            bits = draw.getrandbits(128) >> (mode + 1) << (mode + 1) | 1 << mode
            blocks += bits.to_bytes(16, "little")
    texels = decode_bc7(blocks, 4 * 8 * EACH, 4).tobytes()
    encoded = {"blocks": base64.b64encode(blocks).decode(), "texels": base64.b64encode(texels).decode()}
    Path(__file__).with_name("bc7.json").write_text(json.dumps(encoded) + "\n", encoding="utf8")


if __name__ == "__main__":
    main()
