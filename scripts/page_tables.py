#!/usr/bin/env python
"""Write the page's copy of the package's tables, web/src/bundle/tables.ts."""

import math
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bitymi_ns.bundle import compact, manifest
from bitymi_ns.bundle.surfel_table import COLUMNS
from bitymi_ns.bundle.world import WorldEntry
from bitymi_ns.codec import limits, packing, surfel_codes, texel_codes
from bitymi_ns.codec.limits import LIMITS, limit_of
from bitymi_ns.ops import constants, view_kinds
from bitymi_ns.ops.constants import MAX_TERMS, SUPPORT
from bitymi_ns.ops.parameters import GEOMETRY_PARAMETERS, Limit
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.ops.webgpu import on_device
from bitymi_ns.ops.webgpu.arrays import FIELDS, FRAME, KINDS, SEEN, SURFEL, WHOLE

WIDTH = 120  # of lines
FILE = Path(__file__).resolve().parents[1] / "web" / "src" / "bundle" / "tables.ts"
PARTS = {
    "surfels": manifest.Surfels,
    "frame": manifest.PositionFrame,
    "columns": manifest.ColumnEntry,
    "atlas": manifest.AtlasEntry,
    "render": manifest.RenderEntry,
    "bounds": manifest.Bounds,
    "world": WorldEntry,
    "files": manifest.FileEntry,
}
"""Parts of bundle.json that the page reads."""
TYPES = {
    "EARLIER": "Record<string, readonly string[]>",
    "LATER": "readonly string[]",
    "REDUCED_COUNTS": "Record<string, readonly number[] | null>",
    "LINEAR": "Record<string, { words: readonly number[]; limit: number } & Record<'least' | 'absent', number | null>>",
    "PLY": "Record<string, readonly [number, number | null]>",
    "RANGES": "Record<string, readonly [number, number]>",
    "STEPPED": "readonly string[]",
}
"""Types of tables that are indexed by what a file holds."""
NUMBERS = {
    constants: "MAX_TERMS",
    view_kinds: "COLOR_LIMIT",
    limits: "EXTENTS UNIT_SLACK",
    surfel_codes: "POSITION_BITS SMALLEST_SHARE",
    packing: "GRID ROWS",
    compact: "SURFELS_PER_BYTE SPARE_SURFELS TEXELS_PER_BYTE SPARE_TEXELS MOST_EXPONENT MOST_COEFFICIENT",
    texel_codes: "GRADES",
    on_device: "BLOCK DIGITS ROUNDS MOST_LAYERS",
}
"""Numbers with the same name on the page."""


def text_of(value: object) -> str:
    """Format a value as TypeScript."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key_of(key)}: {text_of(item)}" for key, item in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(text_of(item) for item in value) + "]"
    if isinstance(value, float):
        return (
            re.sub(r"^(-?1)(0{4,})\.0$", lambda part: f"{part[1]}e{len(part[2])}", repr(value))
            .replace("e-0", "e-")
            .removesuffix(".0")
        )
    return "null" if value is None else f"'{value}'" if isinstance(value, str) else str(value)


def key_of(key: object) -> str:
    return str(key) if str(key).isidentifier() else f"'{key}'"


def of_width(limit: Limit, width: int) -> list[float]:
    """Repeat one limit for every number."""
    return list(limit) if len(limit) > 1 else list(limit) * width


def ranges() -> dict[str, list[float]]:
    """List the ranges of bundle.json's numbers by part and key, those of a list's items by the list's."""
    by_name = {}
    for part, model in PARTS.items():
        for key, schema in model.model_json_schema()["properties"].items():
            while (
                inner := schema.get("anyOf")
                or schema.get("prefixItems")
                or ([schema["items"]] if "items" in schema else ())
            ):
                schema = inner[0]
            if "maximum" in schema:
                low = schema.get("minimum", math.ulp(schema.get("exclusiveMinimum", 0.0)))
                by_name[f"{part}.{key}"] = [low, schema["maximum"]]
    return by_name


def words_of(struct: np.dtype) -> dict[str, int]:
    """List the offsets of a struct's fields in words, by name."""
    return {
        re.sub(r"_(\w)", lambda part: part[1].upper(), name): offset // 4
        for name, (_, offset, *_) in (struct.fields or {}).items()
    }


def at_word(parameter: str) -> tuple[int, int]:
    """Return a parameter's first word, and their number."""
    field = FIELDS[parameter]
    return (SURFEL.fields or {})[field][1] // 4, math.prod(SURFEL[field].shape)


def tables() -> str:
    """Compose the module."""
    kinds = VIEW_COLORS.items()
    terms = {name: of_width(kind.reduced_limit, kind.reduced_width) for name, kind in kinds}
    shapes = {name: surfel_codes.term_numbers(name)[1] for name in VIEW_COLORS}
    whole = {}
    for name, kind in kinds:
        parts = [parameter for parameter in kind.parameters if -1 in parameter.shape]
        base = [parameter.name for parameter in kind.parameters if -1 not in parameter.shape]
        form = f"{name}{WHOLE}" if kind.sites else name
        terms[form] = [most for part in parts for most in of_width(part.limit, part.width)]
        whole[name] = {
            "parts": {p.name: p.width for p in parts},
            "base": base[0] if base else None,
            "kind": KINDS[form],
        }
    stored = {name: [*at_word(name), LIMITS[name][0]] for name in FIELDS if math.isfinite(LIMITS[name][0])}
    values = {
        "FORMAT": manifest.FORMAT,
        "NEWEST_MAJOR": int(manifest.VERSION.split(".")[0]),
        "EARLIER": manifest.EARLIER,
        "RANGES": ranges(),
        "SURFEL_WORDS": SURFEL.itemsize // 4,
        "WORD": words_of(SURFEL),
        "SEEN_BYTES": SEEN.itemsize,
        "FRAME_BYTES": FRAME.itemsize,
        "FRAME": words_of(FRAME),
        "PLY": {
            column: [at_word(name)[0] + i, parameter.absent]
            for name, parameter in GEOMETRY_PARAMETERS.items()
            for i, column in enumerate(COLUMNS[name])
        },
        "COLUMNS": {k: n for k, n in surfel_codes.columns_of("sv", True).items() if not k.startswith("term_")},
        "STEPPED": [*surfel_codes.REFERENCE, "residual"],
        "LATER": sorted(surfel_codes.LATER),
        "LINEAR": {
            column: {
                "words": [at_word(p.name)[0] + i for i in range(p.width)],
                "limit": p.limit[0],
                "least": p.least,
                "absent": p.absent,
            }
            for column, p in surfel_codes.LINEAR.items()
        },
        "KINDS": KINDS,
        "REDUCED_WIDTH": {name: kind.reduced_width for name, kind in kinds},
        "REDUCED_COUNTS": {
            name: None if kind.reduced_counts == range(MAX_TERMS + 1) else list(kind.reduced_counts)
            for name, kind in kinds
        },
        "TERM_LIMITS": terms,
        "SHAPES": {
            name: {"at": min(rows, default=0), "limits": [of_width(limit_of("view_terms", name), 9)[i] for i in rows]}
            for name, rows in shapes.items()
        },
        "WHOLE": whole,
        "LIMITS": stored,
        "EXTENT": SUPPORT,
        **{name: getattr(module, name) for module, names in NUMBERS.items() for name in names.split()},
    }
    lines = ["// Written by scripts/page_tables.py."]
    for name, value in values.items():
        named = f"{name}: {TYPES[name]}" if name in TYPES else name
        end = "" if name in TYPES or isinstance(value, (str, int, float)) else " as const"
        text = f"export const {named} = {text_of(value)}{end};"
        if len(text) > WIDTH and isinstance(value, Mapping):
            nested = any(isinstance(item, Mapping) for item in value.values())
            entries = [f"{key_of(key)}: {text_of(item)},".replace(" ", "\0") for key, item in value.items()]
            rows = entries if nested else textwrap.wrap(" ".join(entries), WIDTH - 2)
            text = "\n  ".join([f"export const {named} = {{", *rows]).replace("\0", " ") + f"\n}}{end};"
        lines.append(text)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    FILE.write_text(tables(), "utf8")
