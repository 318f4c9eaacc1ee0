"""KTX2 files: 2D array textures with one level, in the texel formats of an atlas, by the Khronos KTX File Format
Specification 2.0 and Data Format Specification 1.3."""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bitymi_ns.codec.quantise import Format

IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"

_HEADER = struct.Struct("<12s9I4I2Q3Q")  # identifier, header, index, the level
_KEY_LIMIT = 1 << 20
HEADER_LIMIT = 1 << 10  # bytes of header, index, level and data format descriptor, at most


@dataclass(frozen=True)
class _Layout:
    """Fields that depend on the texel format."""

    vk_format: int
    type_size: int  # bytes of one component, 1 for compressed formats
    block: int  # texels per block along x and y
    block_bytes: int
    color_model: int
    samples: tuple[tuple[int, int, int, int, int], ...]  # bit offset, bit length, channel type, lower, upper


_RGBA = (0, 1, 2, 15)  # channel numbers of the colour model RGBSDA
_FLOAT_SIGNED = 0xC0
_LAYOUTS: dict[Format, _Layout] = {
    "bc7": _Layout(145, 1, 4, 16, 134, ((0, 128, 0, 0, 0xFFFFFFFF),)),
    "uint8": _Layout(37, 1, 1, 4, 1, tuple((8 * i, 8, c, 0, 255) for i, c in enumerate(_RGBA))),
    "fp16": _Layout(
        97, 2, 1, 8, 1, tuple((16 * i, 16, c | _FLOAT_SIGNED, 0xBF800000, 0x3F800000) for i, c in enumerate(_RGBA))
    ),
}


class Ktx2Error(ValueError):
    """Bytes that are no KTX2 file of the supported kind; the message says why."""


@dataclass(frozen=True)
class Ktx2Image:
    """A 2D array texture."""

    format: Format
    # width, height: in texels
    width: int
    height: int
    layers: int
    data_at: int  # byte offset of the texels, which end with the file
    payload: Sequence[memoryview] = ()  # one buffer per layer; empty if only the header was read


def layer_bytes(format: Format, width: int, height: int) -> int:
    layout = _LAYOUTS[format]
    return -(-width // layout.block) * -(-height // layout.block) * layout.block_bytes


def descriptor(format: Format) -> bytes:
    """Build the Data Format Descriptor: a basic block with linear transfer and BT.709 primaries."""
    layout = _LAYOUTS[format]
    size = 24 + 16 * len(layout.samples)
    block = struct.pack("<IHH", 0, 2, size)  # Khronos, basic format, version 1.3
    block += struct.pack("<4B", layout.color_model, 1, 1, 0)  # BT.709, linear, straight alpha
    block += struct.pack("<4B", layout.block - 1, layout.block - 1, 0, 0)
    block += struct.pack("<8B", layout.block_bytes, 0, 0, 0, 0, 0, 0, 0)
    for bit_offset, bit_length, channel, lower, upper in layout.samples:
        block += struct.pack("<HBB4xII", bit_offset, bit_length - 1, channel, lower, upper)
    return struct.pack("<I", 4 + size) + block


def write_ktx2(
    path: str | Path, payload: Sequence[bytes], format: Format, width: int, height: int, writer: str
) -> None:
    """Write a 2D array texture, without supercompression. `payload`: a layer each, rows from the top. `width`,
    `height`: in texels; multiples of 4 for bc7. `writer`: name and version of the program (KTXwriter)."""
    layout = _LAYOUTS[format]
    expected = layer_bytes(format, width, height)
    if not payload or any(len(layer) != expected for layer in payload):
        sizes = sorted({len(layer) for layer in payload})
        raise Ktx2Error(f"{format} layers of {width} x {height} texels have {expected} bytes each, not {sizes}")
    dfd = descriptor(format)
    kvd = _key_values({"KTXorientation": "rd", "KTXwriter": writer})
    start = _HEADER.size + len(dfd) + len(kvd)
    alignment = max(layout.block_bytes, 4)
    padding = -start % alignment
    total = expected * len(payload)
    header = _HEADER.pack(
        IDENTIFIER,
        *(layout.vk_format, layout.type_size, width, height, 0, len(payload), 1, 1, 0),
        *(_HEADER.size, len(dfd), _HEADER.size + len(dfd), len(kvd), 0, 0),
        *(start + padding, total, total),
    )
    with open(path, "wb") as file:
        file.write(header + dfd + kvd + bytes(padding))
        for layer in payload:
            file.write(layer)


def read_header(data: bytes | bytearray | memoryview, size: int) -> Ktx2Image:
    """Parse the header from at least the first `HEADER_LIMIT` bytes of a file of `size` bytes. Raises Ktx2Error:
    another kind of file, another size than the header states, or contradictory fields."""
    view = memoryview(data)
    if len(view) < _HEADER.size or bytes(view[:12]) != IDENTIFIER:
        raise Ktx2Error("not a KTX2 file")
    fields = _HEADER.unpack(view[: _HEADER.size])[1:]
    vk_format, type_size, width, height, depth, layers, faces, levels, scheme = fields[:9]
    dfd_at, dfd_size, kvd_at, kvd_size, sgd_at, sgd_size = fields[9:15]
    data_at, data_size, raw_size = fields[15:]
    format: Format | None = next((name for name, layout in _LAYOUTS.items() if layout.vk_format == vk_format), None)
    if format is None:
        raise Ktx2Error(f"the texel format {vk_format} is none of {[kind.vk_format for kind in _LAYOUTS.values()]}")
    layout = _LAYOUTS[format]
    if scheme != 0 or sgd_at or sgd_size:
        raise Ktx2Error("the file is supercompressed; write it again without supercompression")
    if (type_size, depth, faces, levels) != (layout.type_size, 0, 1, 1) or not (width and height and layers):
        raise Ktx2Error("not a 2D array texture of one level")
    if width % layout.block or height % layout.block:
        raise Ktx2Error(f"the size {width} x {height} is not made of whole {layout.block} x {layout.block} blocks")
    expected_dfd = descriptor(format)
    if dfd_at != _HEADER.size or bytes(view[dfd_at : dfd_at + dfd_size]) != expected_dfd:
        raise Ktx2Error("the data format descriptor does not match the texel format")
    if kvd_size > _KEY_LIMIT or (kvd_size and kvd_at != dfd_at + dfd_size) or kvd_at + kvd_size > size:
        raise Ktx2Error("the key/value data lies outside the file")
    expected = layer_bytes(format, width, height) * layers
    if data_size != expected or raw_size != data_size or data_at % max(layout.block_bytes, 4):
        raise Ktx2Error(f"the level index does not match {layers} layers of {width} x {height} texels")
    if data_at < kvd_at + kvd_size or data_at < dfd_at + dfd_size or data_at + data_size != size:
        raise Ktx2Error(f"truncated or too long: {size} bytes, {data_at + data_size} expected")
    return Ktx2Image(format, width, height, layers, data_at)


def parse_ktx2(data: bytes | bytearray | memoryview) -> Ktx2Image:
    """Parse a file of `write_ktx2`, without copying the texels. Raises Ktx2Error: as `read_header`."""
    view = memoryview(data)
    header = read_header(view, len(view))
    size = layer_bytes(header.format, header.width, header.height)
    return replace(header, payload=[view[at : at + size] for at in range(header.data_at, len(view), size)])


def _key_values(pairs: Mapping[str, str]) -> bytes:
    data = b""
    for key in sorted(pairs):
        entry = key.encode() + b"\0" + pairs[key].encode() + b"\0"
        data += struct.pack("<I", len(entry)) + entry + bytes(-len(entry) % 4)
    return data
