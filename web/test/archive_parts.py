"""Write archive.json: small parts stored like those of a bundle by `bitymi_ns.bundle.single`."""

import base64
import io
import json
import zipfile
from pathlib import Path

PARTS = {
    "bundle.json": '{"format": "a test"}',
    "surfels.bin": "surfels",
    "texels.bin": "",
    "photograph-0001.jpg": "b" * 40,
}


def main() -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, text in PARTS.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), text)
    made = {"file": base64.b64encode(buffer.getvalue()).decode(), "parts": PARTS}
    Path(__file__).with_name("archive.json").write_text(json.dumps(made) + "\n", encoding="utf8")


if __name__ == "__main__":
    main()
