"""Damaged bundles give an error that names the damage, or render; they never crash."""

import json
import math
import os
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns.bundle import BundleError, check_files, read_bundle
from bitymi_ns.bundle.manifest import parse
from bitymi_ns.codec.limits import BRIGHTEST
from bitymi_ns.measure.stability.scenes import random_scene
from bitymi_ns.ply import parse_ply, write_ply
from bitymi_ns.scene import Camera
from tests.bundle.damage import amend, signed
from tests.bundle.made import make
from tests.hostile import ODD_VALUES, mutated

pytestmark = pytest.mark.slow

MORE = int(os.environ.get("BITYMI_FUZZ", "1"))
EXAMPLES = 60 * MORE
FORMATS = ("bc7", "uint8", "fp16", "reduced")
N, SIDE = 12, 16
FINITE = [value for value in ODD_VALUES if not isinstance(value, float) or math.isfinite(value)]


@pytest.fixture(scope="module", params=FORMATS)
def bundle(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    def surfels(count: int, kind: str) -> dict[str, torch.Tensor]:
        return {key: value.float() for key, value in random_scene(count, 0).params.items()}

    folder = tmp_path_factory.mktemp("bundles") / request.param
    reduced = request.param == "reduced"
    make(surfels, folder, format="uint8" if reduced else request.param, count=N, reduced=reduced)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def load_and_draw(folder: Path, verify: bool) -> bool:
    """Return whether the bundle opens; if so, check that it renders in finite, bounded colours."""
    try:
        loaded = read_bundle(folder, verify=verify)
    except BundleError as error:
        assert str(error) and "\n" not in str(error)
        return False
    K = torch.tensor([[20.0, 0, SIDE / 2], [0, 20.0, SIDE / 2], [0, 0, 1]])
    output = loaded.scene.render(Camera(torch.eye(4), K, SIDE, SIDE), torch.zeros(3), maps=True)
    assert output.rgb.shape == (SIDE, SIDE, 3)
    for image in (output.rgb, output.alpha, output.beta, output.depth, output.normal):
        assert image.isfinite().all()
    assert 0 <= float(output.rgb.min()) and float(output.rgb.max()) <= BRIGHTEST
    return True


def put(folder: Path, files: dict[str, bytes]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize("name", ["bundle.json", "surfels.ply", "atlas.ktx2"])
def test_bit_flips(bundle: dict[str, bytes], name: str, tmp_path: Path) -> None:
    """With hashes, every flip in a file is detected. Without, or with hashes made after the damage, what is read is
    valid enough to be drawn."""
    rng = random.Random(f"flip {name}")
    folder = put(tmp_path / "b", bundle)
    for example in range(EXAMPLES):
        data = bytearray(bundle[name])
        # half of the flips in the header
        end = len(data) if example % 2 else min(len(data), 600)
        for _ in range(rng.choice((1, 1, 3, 20))):
            data[rng.randrange(end)] ^= 1 << rng.randrange(8)
        (folder / name).write_bytes(data)
        opened = load_and_draw(folder, verify=True)
        same = parse if name == "bundle.json" else bytes  # white space in JSON may differ
        assert not opened or same(data) == same(bundle[name])
        if name != "bundle.json":
            load_and_draw(folder, verify=False)
            amend(folder)
            load_and_draw(folder, verify=True)
            (folder / "bundle.json").write_bytes(bundle["bundle.json"])


@pytest.mark.parametrize("name", ["bundle.json", "surfels.ply", "atlas.ktx2"])
def test_truncation_and_growth(bundle: dict[str, bytes], name: str, tmp_path: Path) -> None:
    rng = random.Random(f"cut {name}")
    folder = put(tmp_path / "b", bundle)
    whole = bundle[name]
    lengths = [0, 1, len(whole) - 1, *(rng.randrange(len(whole)) for _ in range(EXAMPLES // 2))]
    for data in [whole[:length] for length in lengths] + [whole + b"\0", whole + whole, whole * 3]:
        (folder / name).write_bytes(data)
        # JSON may be followed by white space only
        assert not load_and_draw(folder, verify=False) or (name == "bundle.json" and data.strip() == whole.strip())
        if name != "bundle.json":
            amend(folder)
            load_and_draw(folder, verify=True)
            (folder / "bundle.json").write_bytes(bundle["bundle.json"])


def flips(manifest: bytes) -> Iterator[bytes]:
    """Yield the manifest with one bit of each byte flipped in turn; with BITYMI_FUZZ above 1, each bit."""
    for at, byte in enumerate(manifest):
        for bit in range(8) if MORE > 1 else (at % 8,):
            yield manifest[:at] + bytes([byte ^ 1 << bit]) + manifest[at + 1 :]


def test_every_flip_of_the_manifest_is_refused_or_changes_nothing(bundle: dict[str, bytes]) -> None:
    whole, opened = parse(bundle["bundle.json"]), 0
    for data in flips(bundle["bundle.json"]):
        try:
            assert parse(data) == whole
            opened += 1
        except BundleError as error:
            assert "\n" not in str(error)
    assert opened < len(bundle["bundle.json"]) * (8 if MORE > 1 else 1) // 20  # white space, e or E in a number


def test_changed_structures_of_the_manifest(bundle: dict[str, bytes], tmp_path: Path) -> None:
    """Values of bundle.json with other types, sizes or positions, signed again: refused or drawn."""
    folder = put(tmp_path / "b", bundle)
    whole, rng = json.loads(bundle["bundle.json"]), random.Random("manifest")
    opened = 0
    for _ in range(2 * EXAMPLES):
        info = mutated(whole, rng, FINITE)
        if not isinstance(info, dict):
            continue
        (folder / "bundle.json").write_bytes(signed(info))
        opened += load_and_draw(folder, verify=True)
        assert all(check.detail for check in check_files(folder)[1])
    assert opened  # names and notes may be anything


def test_columns_of_extreme_values(bundle: dict[str, bytes], tmp_path: Path) -> None:
    """NaN, infinite or huge numbers in surfels.ply: refused, or drawn in bounded colours."""
    elements = parse_ply(bundle["surfels.ply"])
    rng = random.Random("columns")
    for element, name in [(element, name) for element, columns in elements.items() for name in columns]:
        for value in rng.sample((math.nan, math.inf, 3e38, -1e4, 250.0, -1.0, 0.0, 1e-40, 2.0**31 - 1), min(9, MORE)):
            spoiled = {key: column.copy() for key, column in elements[element].items()}
            row = rng.randrange(len(spoiled[name]))
            if spoiled[name].dtype == np.int32:
                spoiled[name][row] = int(np.clip(np.nan_to_num(value), -(2**31), 2**31 - 1))
            else:
                spoiled[name][row] = value
            folder = put(tmp_path / "b", bundle)
            every = {**elements, element: spoiled}
            write_ply(folder / "surfels.ply", every.pop("vertex"), more=every)
            amend(folder)
            load_and_draw(folder, verify=True)
