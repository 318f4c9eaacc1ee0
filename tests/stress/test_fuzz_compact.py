"""Damaged compact bundles with valid hashes give an error that names the damage, or a scene of bounded numbers.

BITYMI_FUZZ=500 makes 10^5 of them in some minutes; memory is then measured, and bundle.json read as bytes, in every
twentieth only.
"""

import json
import os
import random
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bitymi_ns.bundle import BundleError
from bitymi_ns.bundle.manifest import COMPACT_SURFELS, TEXELS, describe, parse
from bitymi_ns.bundle.read import assemble
from bitymi_ns.bundle.sizes import check_head
from bitymi_ns.codec.limits import beyond
from bitymi_ns.codec.streams import StreamError, compress
from tests.bundle.compact_scene import make_codes, write_compact
from tests.bundle.damage import signed

pytestmark = pytest.mark.slow

MORE = int(os.environ.get("BITYMI_FUZZ", "1"))
EXAMPLES = 200 * MORE
MEMORY = 48 << 20
"""More than the largest scene that so few bytes may claim."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, bytes]]:
    """bundle.json and the other files of a small bundle."""
    folder = write_compact(tmp_path_factory.mktemp("compact") / "b", make_codes(count=6))
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    return json.loads(files.pop("bundle.json")), files


def opened(info: dict[str, Any], files: dict[str, bytes], as_bytes: bool = True) -> bool:
    """Return whether the bundle opens; if so, check that its numbers are within the limits.

    `as_bytes` reads bundle.json from a file with its digest; else only its contents are checked.
    """
    try:
        manifest = parse(signed(info, files)) if as_bytes else describe(info)
        for name, data in files.items():
            check_head(manifest, name, data[:1024], len(data))
        found = assemble(Path("b"), manifest, {name: bytearray(data) for name, data in files.items()}).scene
    except (BundleError, StreamError) as error:
        assert str(error) and "\n" not in str(error)
        return False
    for name, value in found.surfels.items():
        assert value.isfinite().all() and (name == "view_span" or not beyond(name, found.view_color, value).any())
    length = found.surfels["quats"].norm(dim=1)
    assert ((length - 1).abs() < 1e-3).all() and found.extent.isfinite().all() and found.mean_residual.isfinite().all()
    tiles = found.tiles.long()
    assert found.atlas is not None or not tiles.any()
    if found.atlas is not None:
        layers, height, width = found.atlas.shape[:3]
        inside = (tiles[:, 0] + tiles[:, 3] <= width) & (tiles[:, 1] + tiles[:, 4] <= height) & (tiles[:, 2] < layers)
        assert inside.all() and (tiles >= 0).all()
    span = found.surfels["view_span"].long()
    assert (span >= 0).all() and (span.sum(1) <= len(found.surfels["view_terms"])).all()
    return True


def flipped(rng: random.Random, info: dict[str, Any], files: dict[str, bytes]) -> None:
    name = rng.choice(sorted(files))
    data = bytearray(files[name])
    for _ in range(rng.choice((1, 1, 3, 20))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    files[name] = bytes(data)


def columns_of(rng: random.Random, info: dict[str, Any]) -> tuple[str, list[dict[str, Any]]]:
    return rng.choice([(COMPACT_SURFELS, info["surfels"]["columns"]), (TEXELS, info["atlas"]["columns"])])


def replaced(rng: random.Random, info: dict[str, Any], files: dict[str, bytes]) -> None:
    """Replace a number of a column by other integers, or other bytes."""
    name, columns = columns_of(rng, info)
    numbers, at = [], 0
    for column in columns:
        for index, size in enumerate(column["bytes"]):
            numbers.append((column["bytes"], index, at, size))
            at += size
    sizes, index, at, size = rng.choice(numbers)
    rows, reach = rng.choice((6, 6, 0, 1, 24, 48)), 1 << rng.choice((0, 1, 4, 8, 30, 50))
    codes = [rng.randrange(-reach, reach) for _ in range(rows)]
    data = compress(np.array(codes, dtype=np.int64).reshape(rows, 1)).data
    if rng.random() < 0.2:
        length = rng.choice((1, size, size + 1, 1000))  # misstated before, perhaps
        data = rng.randbytes(max(0, min(length, 1000)))
    files[name] = files[name][:at] + data + files[name][at + size :]
    sizes[index] = len(data)


def misstated(rng: random.Random, info: dict[str, Any], files: dict[str, bytes]) -> None:
    """Change a number of bundle.json."""
    places = [(info["surfels"], key) for key in ("count", "terms")]
    places += [(info["surfels"]["frame"], "scale")] + [(info["surfels"]["frame"]["low"], i) for i in range(3)]
    keys = ("texels", "step", "width", "height", "layers", "page_width", "page_rows", "offset", "scale")
    places += [(info["atlas"], key) for key in keys]
    _, columns = columns_of(rng, info)
    for column in columns:
        places += [(column, "step")] * 3 + [(column["bytes"], i) for i in range(len(column["bytes"]))]
    at, key = rng.choice(places)
    values: list[Any] = [0, 1, -1, 2, 5, 255, 1 << 20, 1 << 31, -(1 << 40), 1 << 40, 1e-9, 1e6, 1e300, -99.0, None]
    old = at[key] if isinstance(key, int) else at.get(key)
    at[key] = rng.choice([*values, old * 2, old + 1] if isinstance(old, (int, float)) else values)


def test_damage_past_the_hashes(whole: tuple[dict[str, Any], dict[str, bytes]]) -> None:
    info, files = whole
    assert opened(info, files)
    rng, found = random.Random(0), 0
    for number in range(EXAMPLES):
        whole_way = MORE == 1 or number % 20 == 0
        changed, data = json.loads(json.dumps(info)), dict(files)
        for _ in range(rng.choice((1, 1, 1, 2, 5))):
            try:
                rng.choice((flipped, replaced, replaced, misstated))(rng, changed, data)
            except TypeError:
                pass  # a size misstated before
        if not whole_way:
            found += opened(changed, data, as_bytes=False)
            continue
        tracemalloc.start()
        found += opened(changed, data)
        assert tracemalloc.get_traced_memory()[1] < MEMORY
        tracemalloc.stop()
    print(f"{EXAMPLES} damaged bundles: {found} opened, {EXAMPLES - found} refused")
    assert 0.05 * EXAMPLES < found < 0.95 * EXAMPLES
