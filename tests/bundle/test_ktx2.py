import struct

import numpy as np
import pytest

from bitymi_ns.bundle.ktx2 import Ktx2Error, layer_bytes, parse_ktx2, write_ktx2

FORMATS = ["bc7", "uint8", "fp16"]


def make(folder, format, width=8, height=12, layers=3):
    g = np.random.default_rng(0)
    payload = [g.bytes(layer_bytes(format, width, height)) for _ in range(layers)]
    write_ktx2(folder / "a.ktx2", payload, format, width, height, "test 1.0")
    return payload, (folder / "a.ktx2").read_bytes()


def by_the_specification(data):
    """Parse the fields of a KTX2 file by the specification's tables, sharing no code with the writer."""

    names = "vkFormat typeSize pixelWidth pixelHeight pixelDepth layerCount faceCount levelCount scheme".split()
    names += "dfdByteOffset dfdByteLength kvdByteOffset kvdByteLength".split()
    names += "sgdByteOffset sgdByteLength byteOffset byteLength uncompressedByteLength".split()
    f = dict(zip(names, struct.unpack_from("<13I5Q", data, 12), strict=True)) | {"identifier": data[:12]}
    total, *word = struct.unpack_from(f"<{f['dfdByteLength'] // 4}I", data, f["dfdByteOffset"])
    f |= {"dfdTotalSize": total, "vendor": word[0] & 0x1FFFF, "descriptorType": word[0] >> 17}
    f |= {"versionNumber": word[1] & 0xFFFF, "blockSize": word[1] >> 16}
    f |= {"model": word[2] & 255, "primaries": word[2] >> 8 & 255, "transfer": word[2] >> 16 & 255}
    f |= {"flags": word[2] >> 24, "texelBlock": [word[3] >> 8 * i & 255 for i in range(4)]}
    f |= {"bytesPlane": [word[4 + i // 4] >> 8 * (i % 4) & 255 for i in range(8)], "samples": []}
    for i in range(6, len(word), 4):
        sample = (word[i] & 0xFFFF, (word[i] >> 16 & 255) + 1, word[i] >> 24 & 15, word[i] >> 28)
        f["samples"].append((*sample, word[i + 1], word[i + 2], word[i + 3]))
    f["keys"], at = [], f["kvdByteOffset"]
    while at < f["kvdByteOffset"] + f["kvdByteLength"]:
        (length,) = struct.unpack_from("<I", data, at)
        f["keys"].append(tuple(data[at + 4 : at + 4 + length].split(b"\0", 1)))
        assert not any(data[at + 4 + length : at + 4 + (length + 3) // 4 * 4])
        at += 4 + (length + 3) // 4 * 4
    assert at == f["kvdByteOffset"] + f["kvdByteLength"]
    return f


@pytest.mark.parametrize("format", FORMATS)
def test_every_field_is_what_the_specification_asks_for(tmp_path, format):
    payload, data = make(tmp_path, format)
    image = parse_ktx2(data)
    assert (image.format, image.width, image.height) == (format, 8, 12)
    assert [bytes(layer) for layer in image.payload] == payload
    f = by_the_specification(data)
    assert f["identifier"] == bytes([0xAB, 0x4B, 0x54, 0x58, 0x20, 0x32, 0x30, 0xBB, 0x0D, 0x0A, 0x1A, 0x0A])
    assert f["vkFormat"] == {"bc7": 145, "uint8": 37, "fp16": 97}[format]
    assert f["typeSize"] == {"bc7": 1, "uint8": 1, "fp16": 2}[format]
    assert (f["pixelWidth"], f["pixelHeight"], f["pixelDepth"]) == (8, 12, 0)
    assert (f["layerCount"], f["faceCount"], f["levelCount"], f["scheme"]) == (3, 1, 1, 0)
    assert f["dfdByteOffset"] == 80 + 24 and f["dfdTotalSize"] == f["dfdByteLength"]
    assert f["kvdByteOffset"] == f["dfdByteOffset"] + f["dfdByteLength"] and f["kvdByteOffset"] % 4 == 0
    assert (f["sgdByteOffset"], f["sgdByteLength"]) == (0, 0)
    assert f["byteOffset"] % {"bc7": 16, "uint8": 4, "fp16": 8}[format] == 0
    assert f["byteLength"] == f["uncompressedByteLength"] == len(data) - f["byteOffset"]
    assert data[f["byteOffset"] :] == b"".join(payload)
    assert (f["vendor"], f["descriptorType"], f["versionNumber"]) == (0, 0, 2)
    assert f["blockSize"] == f["dfdTotalSize"] - 4 == 24 + 16 * len(f["samples"])
    assert (f["transfer"], f["primaries"], f["flags"]) == (1, 1, 0)  # linear, BT.709, straight alpha
    assert f["keys"] == [(b"KTXorientation", b"rd\0"), (b"KTXwriter", b"test 1.0\0")]
    if format == "bc7":
        assert (f["model"], f["texelBlock"], f["bytesPlane"]) == (134, [3, 3, 0, 0], [16, 0, 0, 0, 0, 0, 0, 0])
        assert f["samples"] == [(0, 128, 0, 0, 0, 0, 0xFFFFFFFF)]
    else:
        bits, qualifier = (8, 0) if format == "uint8" else (16, 0xC)  # float and signed
        low, high = (0, 255) if format == "uint8" else struct.unpack("<2I", struct.pack("<2f", -1, 1))
        assert (f["model"], f["texelBlock"], f["bytesPlane"][:2]) == (1, [0, 0, 0, 0], [bits // 2, 0])
        assert f["samples"] == [(bits * i, bits, c, qualifier, 0, low, high) for i, c in enumerate((0, 1, 2, 15))]


def test_other_files_are_refused_with_a_reason(tmp_path):
    _, data = make(tmp_path, "bc7")

    def patched(at, value):
        return data[:at] + struct.pack("<I", value) + data[at + 4 :]

    cases = {"not a KTX2": b"DDS " + data[4:], "truncated": data[:-1], "texel format": patched(12, 146)}
    cases |= {"supercompressed": patched(44, 2), "2D array": patched(36, 6), "level index": patched(32, 4)}
    cases |= {"whole 4 x 4": patched(20, 9), "descriptor": patched(108, 7), "key/value": patched(60, 1 << 31)}
    for reason, bad in cases.items():
        with pytest.raises(Ktx2Error, match=reason):
            parse_ktx2(bad)
    for payload in ([bytes(15)], []):
        with pytest.raises(Ktx2Error):
            write_ktx2(tmp_path / "a", payload, "bc7", 4, 4, "test")
