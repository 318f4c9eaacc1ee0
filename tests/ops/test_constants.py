"""Numbers of the formulas: stated once in csrc, read from there, and the same in the float64 twins."""

import math
import re
from pathlib import Path

import pytest

import bitymi_ns
from bitymi_ns import _cpu
from bitymi_ns.ops import constants
from bitymi_ns.ops.reference import project, trace

CHECKOUT = Path(bitymi_ns.__file__).parent.parent
SOURCES = [
    path
    for folder, kinds in (("csrc", ("*.h", "*.cpp", "*.cu")), ("bitymi_ns", ("*.py",)))
    for kind in kinds
    for path in (CHECKOUT / folder).rglob(kind)
    if "reference" not in path.parts
]
STATED = {
    "relu of f_view + 0.5": (r"relu\(.*\+ S?\(?(0\.5|kColorBias|COLOR_BIAS)", ["shading.h", "view_color.py"]),
    "smallest alpha": (r"1(\.0)? ?/ ?255\b(?!\))", ["surfel.h"]),
    "harmonic of degree 0": (r"= 0\.28209", ["view_kinds.h"]),
    "side of a tile": (r"(TILE|kTile\w*) = 16", ["bounds.h"]),
    "channels of an image": (r"kImageChannels = ", ["blend.h"]),
    "weight of a fragment": (r"sigma \* (p\.)?transmittance", ["blend.h"]),
    "level set": (r"x \* S\(1\.0002\)", ["outline.h"]),
    "outermost points of an ellipse": (r"y_left >= lo - slack", ["outline.h"]),
    "support's square": (r"kSupport \* kSupport", ["surfel.h"]),
    "planes": (r"T\(g\[first\]\) \* dx", ["surfel.h"]),
    "a plane's slope": (r"g\[k[UVW]1\]\) \* dx \+", ["kernel.h"]),
    "a surfel in a camera's frame": (r"rotate\(\w+\.R, (\w+\.)?rot\.tu\)", ["surfel.h"]),
    "a pixel's sums": (r"\[4\] \+= w\w* \*", ["blend.h"]),
    "gradient of a weight": (r"d\[3\] \+ d\[4\] \*", ["blend.h"]),
    "moments of SSIM": (r"\[4\] \+= k\w \*", ["ssim.h"]),
    "mask of a hash": (r"log2_size\) - 1u", ["field.h"]),
    "where a camera stands": (r"-\(double\(\w\[k\]\) \*", ["camera.h"]),
    "reals as sort keys": (r"\? ~bits", ["sort_scan.h"]),
    "temperature": (r"min_\(.*kLogTauMax", ["view_kinds.h"]),
    "golden angle": (r"3\.0 - (math\.sqrt\(5|5\.0)", ["sphere.py"]),
}


def test_the_float64_twins_have_the_same_numbers() -> None:
    assert constants.SUPPORT == trace.SUPPORT
    assert (constants.ALPHA_MIN, constants.ALPHA_MAX) == (trace.ALPHA_MIN, trace.ALPHA_MAX)
    assert constants.TRANSMITTANCE_MIN == trace.TRANSMITTANCE_MIN
    assert constants.BETA_MAX == project.BETA_MAX
    assert constants.SH_C0 == pytest.approx(math.sqrt(1 / (4 * math.pi)), rel=1e-15)


@pytest.mark.skipif(not (CHECKOUT / "csrc").is_dir(), reason="needs a checkout")
@pytest.mark.parametrize("what", STATED)
def test_each_is_stated_in_one_place(what: str) -> None:
    pattern, places = STATED[what]
    code = {path: re.sub(r'//.*|#.*|"""(.|\n)*?"""', "", path.read_text("utf8")) for path in SOURCES}
    assert sorted(path.name for path, text in code.items() if re.search(pattern, text)) == sorted(places)


def test_an_older_compiled_module_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(_cpu, "SUPPORT")
    older = "_cpu does not know SUPPORT: it is older than the package. Install the package again"
    with pytest.raises(RuntimeError, match=older):
        constants._compiled("SUPPORT")
