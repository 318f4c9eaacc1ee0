#!/usr/bin/env python
"""Write the page's copy of the package's tables, web/src/bundle/tables.ts: the layout of a surfel in the shaders, kinds
of view colour, limits."""

import math
import re
from collections.abc import Mapping
from pathlib import Path

from bitymi_ns.codec import packing, surfel_codes
from bitymi_ns.codec.limits import EXTENTS, LIMITS, UNIT_SLACK, limit_of
from bitymi_ns.ops.constants import ALPHA_MIN, MAX_TERMS, SUPPORT
from bitymi_ns.ops.parameters import GEOMETRY, Limit
from bitymi_ns.ops.view_kinds import COLOR_LIMIT, VIEW_COLORS
from bitymi_ns.ops.webgpu.arrays import KINDS, SURFEL, WHOLE

FILE = Path(__file__).resolve().parents[1] / "web" / "src" / "bundle" / "tables.ts"
STORED = {**{name: name.removesuffix("s") for name in GEOMETRY}, "mean_residual": "residual", "view_base": "base"}
"""Fields of `SURFEL` by parameter."""


def text_of(value: object) -> str:
    """Write a value as TypeScript, as prettier formats it."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key_of(key)}: {text_of(item)}" for key, item in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(text_of(item) for item in value) + "]"
    if isinstance(value, float):
        rounded = round(math.log10(value))
        return f"1e{rounded}" if value == 10.0**rounded and abs(rounded) > 3 else repr(value).removesuffix(".0")
    return "null" if value is None else f"'{value}'" if isinstance(value, str) else str(value)


def key_of(key: object) -> str:
    """Write a key."""
    return str(key) if str(key).isidentifier() else f"'{key}'"


def of_width(limit: Limit, width: int) -> list[float]:
    """Repeat one limit for every number."""
    return list(limit) if len(limit) > 1 else list(limit) * width


def tables() -> str:
    """Write the module."""
    fields = {name: offset // 4 for name, (_, offset) in SURFEL.fields.items()}
    words = {re.sub(r"_(\w)", lambda part: part[1].upper(), name): at for name, at in fields.items()}
    kinds = VIEW_COLORS.items()
    terms = {name: of_width(kind.lean_limit, kind.lean_width) for name, kind in kinds}
    shapes = {name: surfel_codes.term_numbers(name)[1] for name in VIEW_COLORS}
    whole = {}
    for name, kind in kinds:
        parts = [each for each in kind.parameters if -1 in each.shape]
        base = [each.name for each in kind.parameters if -1 not in each.shape]
        form = f"{name}{WHOLE}" if kind.sites else name
        terms[form] = [most for each in parts for most in of_width(each.limit, each.width)]
        whole[name] = {
            "parts": {p.name: p.width for p in parts},
            "base": base[0] if base else None,
            "kind": KINDS[form],
        }
    stored = {
        name: [fields[field], math.prod(SURFEL[field].shape), LIMITS[name][0]]
        for name, field in STORED.items()
        if math.isfinite(LIMITS[name][0])
    }
    constants = {
        "SURFEL_WORDS": SURFEL.itemsize // 4,
        "WORD": words,
        "KINDS": KINDS,
        "LEAN_WIDTH": {name: kind.lean_width for name, kind in kinds},
        "TERM_LIMITS": terms,
        "SHAPES": {
            name: {"at": min(at, default=0), "limits": [of_width(limit_of("view_terms", name), 9)[i] for i in at]}
            for name, at in shapes.items()
        },
        "WHOLE": whole,
        "LIMITS": stored,
        "COLOR_LIMIT": COLOR_LIMIT,
        "EXTENTS": EXTENTS,
        "EXTENT": SUPPORT,
        "UNIT_SLACK": UNIT_SLACK,
        "ALPHA_MIN": ALPHA_MIN,
        "MAX_TERMS": MAX_TERMS,
        "POSITION_BITS": surfel_codes.POSITION_BITS,
        "SMALLEST_SHARE": surfel_codes.SMALLEST_SHARE,
        "GRID": packing.GRID,
        "ROWS": packing.ROWS,
    }
    lines = ["// Written by scripts/page_tables.py."]
    for name, value in constants.items():
        if isinstance(value, Mapping):
            lines += [f"export const {name} = {{", *(f"  {key_of(k)}: {text_of(v)}," for k, v in value.items())]
            lines.append("} as const;")
        else:
            lines.append(f"export const {name} = {text_of(value)}{' as const' if isinstance(value, tuple) else ''};")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    FILE.write_text(tables(), "utf8")
