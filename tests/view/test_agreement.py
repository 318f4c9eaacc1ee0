"""The page and Python's reader agree on damaged bundles with valid hashes: a table."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bitymi_ns.bundle import BundleError, read_bundle
from bitymi_ns.codec.streams import compress
from bitymi_ns.view import site_of
from tests.bundle.damage import amend, change_columns, change_texel
from tests.view.conftest import write
from tests.view.test_browser import page_of

Damage = Callable[[Path], None]
COUNT = 120  # surfels of the bundles


def column(name: str, value: float, element: str = "vertex") -> Damage:
    """Change a number in the second row of surfels.ply."""
    return lambda bundle: change_columns(bundle, lambda columns: columns[name].__setitem__(1, value), element)


def rotation(length: float) -> Damage:
    """Change the length of the second surfel's rotation."""

    def damage(bundle: Path) -> None:
        for k in range(4):
            column(f"rot_{k}", length if k == 0 else 0.0)(bundle)

    return damage


def texel(value: float, channel: int = 0) -> Damage:
    return lambda bundle: change_texel(bundle, channel, value)


def numbers(data: bytes) -> Damage:
    """Replace the first column of surfels.bin."""

    def damage(bundle: Path) -> None:
        surfels = (bundle / "surfels.bin").read_bytes()
        info = json.loads((bundle / "bundle.json").read_text())
        size = info["surfels"]["columns"][0]["bytes"][0]
        (bundle / "surfels.bin").write_bytes(data + surfels[size:])
        amend(bundle, lambda info: info["surfels"]["columns"][0].update(bytes=[len(data)]))

    return damage


def flipped(name: str) -> Damage:
    """Flip a bit in the header of a file's first frame."""

    def damage(bundle: Path) -> None:
        data = bytearray((bundle / name).read_bytes())
        data[4] ^= 8
        (bundle / name).write_bytes(data)

    return damage


def positions(rows: int, first: int = 0) -> bytes:
    """Encode differences of positions."""
    return compress(np.array([first, *range(rows - 1)])[:, None]).data


NAN = float("nan")
TABLE: list[tuple[str, str, Damage, bool]] = [
    ("nothing", "fp16", lambda bundle: None, True),
    ("a texel of NaN", "fp16", texel(NAN), False),
    ("a texel of infinity", "fp16", texel(float("-inf")), False),
    ("a texel at the limit", "fp16", texel(-256.0), True),
    ("a texel beyond it", "fp16", texel(257.0), False),
    ("an alpha of NaN", "fp16 alpha", texel(NAN, 3), False),
    ("an alpha at the limit", "fp16 alpha", texel(2.0, 3), True),
    ("an alpha beyond it", "fp16 alpha", texel(2.01, 3), False),
    ("an alpha of -0", "fp16 alpha", texel(-0.0, 3), True),
    ("a negative alpha", "fp16 alpha", texel(-0.5, 3), False),
    ("a rotation of zeros", "bc7", rotation(0.0), False),
    ("a rotation of length 1.1", "bc7", rotation(1.1), False),
    ("a rotation of length 1.005", "bc7", rotation(1.005), True),
    ("a position of NaN", "bc7", column("x", NAN), False),
    ("a position beyond its limit", "bc7", column("x", 1.1e9), False),
    ("a scale beyond its limit", "bc7", column("scale_0", 105.0), False),
    ("an opacity beyond its limit", "bc7", column("opacity", -1.1e4), False),
    ("an extent of 0", "bc7", column("tile_extent", 0.0), False),
    ("a residual beyond its limit", "bc7", column("residual_1", 300.0), False),
    ("a colour beyond its limit", "bc7", column("view_base_2", 300.0), False),
    ("a term beyond its limit", "bc7", column("term_0", 3e7, "view_term"), False),
    ("a colour of a term of NaN", "bc7", column("term_4", NAN, "view_term"), False),
    ("a column of other numbers", "compact", numbers(positions(COUNT)), True),
    ("a column of more rows", "compact", numbers(positions(COUNT + 5)), False),
    ("a column of fewer rows", "compact", numbers(positions(COUNT - 5)), False),
    ("a column that descends", "compact", numbers(positions(COUNT, -5)), False),
    ("a column that a byte follows", "compact", numbers(positions(COUNT) + b"\0"), False),
    ("a column without bytes", "compact", numbers(b""), False),
    ("a column with a long head", "compact", numbers(b"\xff" * 40), False),
    ("a bit of the surfels", "compact", flipped("surfels.bin"), False),
    ("a bit of the texels", "compact", flipped("texels.bin"), False),
]


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("agreement")
    return {
        "bc7": write(folder / "bc7", "bc7", COUNT),
        "fp16": write(folder / "fp16", "fp16", COUNT),
        "fp16 alpha": write(folder / "alpha", "fp16", COUNT, alpha=True),
        "compact": write(folder / "compact", "uint8", COUNT, compact=True),
    }


@pytest.mark.parametrize(("name", "form", "damage", "good"), TABLE, ids=[row[0] for row in TABLE])
def test_the_page_and_python_agree(
    bundles: dict[str, Path], tmp_path: Path, name: str, form: str, damage: Damage, good: bool
) -> None:
    bundle = shutil.copytree(bundles[form], tmp_path / "b")
    damage(bundle)
    amend(bundle)
    try:
        read_bundle(bundle)
        opened = True
    except BundleError as error:
        opened, refusal = False, str(error)
    state, text = page_of(site_of(bundle))
    assert (opened, state != "error") == (good, good), (name, opened or refusal, state, text)
    assert good or "damaged" in text
