"""Constants of the shaders equal those of csrc."""

import re
from pathlib import Path

import pytest

import bitymi_ns.ops
from bitymi_ns.ops import constants
from bitymi_ns.ops.webgpu import on_device
from bitymi_ns.ops.webgpu.arrays import KINDS, SURFEL

SHADERS = Path(bitymi_ns.ops.__file__).parent / "shaders"
CORE = Path(__file__).resolve().parents[3] / "csrc" / "core"
TEXT = "\n".join(path.read_text("utf8") for path in sorted(SHADERS.glob("*.wgsl")))
STATED = {name: value for name, value in re.findall(r"const (\w+)(?:: [fu]32)? = ([\d.e+-]+);", TEXT)}


@pytest.mark.parametrize(
    "name", ["SUPPORT", "ALPHA_MAX", "ALPHA_MIN", "TRANSMITTANCE_MIN", "BETA_MAX", "COLOR_BIAS", "SH_C0", "LOG_TAU_MAX"]
)
def test_numbers_that_the_package_knows(name: str) -> None:
    assert float(STATED[name]) == getattr(constants, name)


@pytest.mark.skipif(not CORE.is_dir(), reason="needs the sources")
def test_numbers_of_the_formulas() -> None:
    core = "\n".join(path.read_text("utf8") for path in CORE.glob("*.h"))
    found = dict(re.findall(r"\bk(\w+) = ([\d.e+-]+)[,;]", core))
    names = {"ShC1", "ShC2a", "ShC2b", "ShC2c", "ShC3a", "ShC3b", "ShC3c", "ShC3e", "ShC3f"}
    names |= {"LobeSharpness", "LogPowerMax", "LogScaleMax", "LowPassReach"}
    for name in names:
        ours = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).upper()
        assert float(STATED[ours]) == float(found[name]), name


def test_layouts_and_numbers_of_choices_agree() -> None:
    assert SURFEL.itemsize == 96
    shows = {name.lower(): int(number) for name, number in re.findall(r"const SHOW_(\w+): u32 = (\d+);", TEXT)}
    assert {name: shows[name] for name in on_device.SHOW} == on_device.SHOW
    views = re.findall(r"const VIEW_(\w+): u32 = (\d+);", TEXT)
    assert {name.replace("_", " ").lower(): int(number) for name, number in views} == KINDS
    assert (int(STATED["BLOCK"]), int(STATED["DIGITS"])) == (on_device.BLOCK, on_device.DIGITS)
