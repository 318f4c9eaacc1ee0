"""Write archive.json: small parts stored like those of a bundle by `bitymi_ns.bundle.single`, and damaged containers
with the parts that both readers find in them; None: a part that is refused, or the whole file."""

import base64
import io
import json
import struct
import zipfile
from pathlib import Path

PARTS = {
    "bundle.json": '{"format": "a test"}',
    "surfels.bin": "surfels",
    "texels.bin": "",
    "photograph-0001.jpg": "b" * 40,
}


def damaged(whole: bytes) -> dict[str, tuple[bytes, dict[str, str | None] | None]]:
    """Make damaged files by the kind of damage, each with what is read of it."""
    local, row = whole.index(b"surfels.bin") - 30, whole.rindex(b"surfels.bin") - 46
    photograph, end = whole.rindex(b"photograph") - 46, len(whole) - 22
    no_surfels = {**PARTS, "surfels.bin": None}

    def put(at: int, data: bytes) -> bytes:
        return whole[:at] + data + whole[at + len(data) :]

    def long(*numbers: int) -> bytes:
        return struct.pack(f"<{len(numbers)}L", *numbers)

    return {
        "a name in a header": (put(local + 30, b"x"), PARTS),
        "flags and version of a header": (put(local + 4, b"\xff" * 4), PARTS),
        "a CRC in a header": (put(local + 14, b"\xff" * 4), PARTS),
        "the signature of a header": (put(local, b"x"), no_surfels),
        "a header that is too long": (put(local + 28, b"\x41"), no_surfels),
        "a byte of a part": (put(local + 41, b"S"), {**PARTS, "surfels.bin": "Surfels"}),
        "encryption in the directory": (put(row + 8, b"\x01"), PARTS),
        "a version in the directory": (put(row + 6, b"\x63"), PARTS),
        "a CRC in the directory": (put(row + 16, b"\xff" * 4), PARTS),
        "a method in the directory": (put(row + 10, b"\x08"), no_surfels),
        "a packed size in the directory": (put(row + 20, b"\x06"), no_surfels),
        "a size in the directory": (put(row + 24, b"\x06"), no_surfels),
        "a smaller part": (put(row + 20, long(6, 6)), {**PARTS, "surfels.bin": "surfel"}),
        "a part that is too large": (put(row + 20, long(10**6, 10**6)), no_surfels),
        "a part beyond the end": (put(row + 42, long(10**6)), no_surfels),
        "a part inside another": (put(row + 42, long(local + 31)), no_surfels),
        "a name in the directory": (put(row + 46, b"\xff"), no_surfels),
        "a name of NUL": (put(row + 46, b"\0"), no_surfels),
        "a name twice": (put(row + 46, b"bundle.json"), None),
        "a row's signature": (put(row, b"x"), None),
        "a row beyond the directory": (put(photograph + 32, b"\x01"), None),
        "three parts more": (put(end + 8, b"\x07\0\x07"), PARTS),
        "a longer directory": (put(end + 12, b"\xff"), None),
        "a directory elsewhere": (put(end + 16, b"\xff"), None),
        "a comment that is not there": (put(end + 20, b"\x05"), None),
        "a comment": (put(end + 20, b"\x05") + b"words", None),
        "something before": (b"x" + whole, None),
        "something behind": (whole + b"x", None),
        "a missing end": (whole[:-1], None),
    }


def main() -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, text in PARTS.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), text)
    whole = buffer.getvalue()
    damage = {kind: {"file": base64.b64encode(data).decode(), "parts": parts}
              for kind, (data, parts) in damaged(whole).items()}  # fmt: skip
    made = {"file": base64.b64encode(whole).decode(), "parts": PARTS, "damage": damage}
    Path(__file__).with_name("archive.json").write_text(json.dumps(made) + "\n", encoding="utf8")


if __name__ == "__main__":
    main()
