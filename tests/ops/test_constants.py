"""Constants are stated once in csrc, read from there, and equal in the float64 twins."""

import math

import pytest

from bitymi_ns.ops import constants
from bitymi_ns.ops.backend import load
from bitymi_ns.ops.parameters import GEOMETRY_PARAMETERS
from bitymi_ns.ops.reference import project, trace


def test_the_float64_twins_have_the_same_numbers() -> None:
    assert constants.SUPPORT == trace.SUPPORT
    assert (constants.ALPHA_MIN, constants.ALPHA_MAX) == (trace.ALPHA_MIN, trace.ALPHA_MAX)
    assert constants.ALPHA_MIN == GEOMETRY_PARAMETERS["opacity_logits"].least
    assert constants.TRANSMITTANCE_MIN == trace.TRANSMITTANCE_MIN
    assert constants.BETA_MAX == project.BETA_MAX
    assert constants.SH_C0 == pytest.approx(math.sqrt(1 / (4 * math.pi)), rel=1e-15)


def test_an_older_compiled_module_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(load("_cpu"), "SUPPORT")
    older = "_cpu does not know SUPPORT: it is older than the package. Install the package again"
    with pytest.raises(RuntimeError, match=older):
        constants._compiled("SUPPORT")
