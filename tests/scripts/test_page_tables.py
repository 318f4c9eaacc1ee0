"""The page's tables are those of the package."""

import re

import numpy as np

from bitymi_ns.ops.webgpu.arrays import SURFEL
from scripts.page_tables import FILE, tables

SHADER = FILE.parents[3] / "bitymi_ns" / "ops" / "shaders" / "scene.wgsl"
TYPES = {"f": "<f4", "u": "<u4"}


def test_they_are_current() -> None:
    assert FILE.read_text("utf8") == tables(), "run python -m scripts.page_tables"


def test_the_shaders_have_the_same_surfel() -> None:
    body = SHADER.read_text("utf8").split("struct Surfel {")[1].split("}")[0]
    fields = re.findall(r"(\w+): (?:(f|u)32|vec(\d)(f|u))", body)
    described = [(name, TYPES[a or b], int(n)) if n else (name, TYPES[a]) for name, a, n, b in fields]
    assert np.dtype(described) == SURFEL
