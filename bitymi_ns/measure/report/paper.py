"""The paper's tables in its own layout: its figures as published, and what was measured here beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml

from bitymi_ns.measure.report.records import Evaluation, Records, psnr_delta
from bitymi_ns.measure.report.tables import MISSING, Row, Table, count, signed, significant

PUBLISHED = "Published, on other hardware"
HERE = "Measured here"
SUITES = {"mipnerf360": ("Mip-NeRF 360", 9), "tanksandtemples": ("Tanks and Temples", 2)}
"""Suites of the paper: title and number of scenes."""
FALLOFF, PLAIN = "bitymi", "bitymi-quality"
"""Our presets with the falloff loss and without."""
VIEW_COLORS = {"bitymi-sh": ("SH", 59), "bitymi": ("SV", 60), "bitymi-sb": ("SB", 26)}
"""Presets whose view colours the paper compares: its name of the colour, and the numbers that a surfel has."""
LOSS = "--pipeline.model.train.loss.falloff-weight"


def published() -> dict[str, Any]:
    """The paper's figures."""
    return yaml.safe_load(Path(__file__).with_name("published.yaml").read_text("utf8"))


def wanted(records: Records) -> bool:
    """Whether the input has scenes of a suite that the paper reports on."""
    return any(row.suite in SUITES for row in records.evaluations)


def _texts(values: Sequence[float | str | None], formats: Sequence[Callable[[float], str]]) -> tuple[str, ...]:
    """Values as texts; what is text already stays as it is."""
    return tuple(
        MISSING if v is None else v if isinstance(v, str) else text(v) for v, text in zip(values, formats, strict=True)
    )


def _fps(row: Evaluation) -> float | None:
    milliseconds = row.get("render_ms")
    return 1000.0 / milliseconds if milliseconds else None


def _mean(values: Sequence[float | None]) -> float | None:
    return None if not values or None in values else sum(v for v in values if v is not None) / len(values)


TWO, THREE = "{:.2f}".format, "{:.3f}".format
QUALITY = (TWO, THREE, THREE, count, significant)
"""Formats of our PSNR, SSIM, LPIPS, N and FPS."""
PRINTED = (TWO, THREE, THREE, count, "{:,.1f}".format)
"""Formats of `QUALITY` with the digits that the paper prints; Tables 2 and 3 print whole frames."""
PRINTED_WHOLE = (*PRINTED[:4], count)


def _quality(row: Evaluation) -> tuple[float | None, ...]:
    return row.get("psnr"), row.get("ssim"), row.get("lpips_vgg"), row.get("surfels"), _fps(row)


def _quality_text(rows: Sequence[Evaluation]) -> tuple[str, ...]:
    """Means over evaluations, as the five quality columns."""
    columns = zip(*map(_quality, rows), strict=True) if rows else [()] * 5
    return _texts([_mean(list(column)) for column in columns], QUALITY)


def one_a_format(rows: Sequence[Evaluation]) -> list[Evaluation]:
    """The trained scenes, and of the bundles of a run in one format the one that is named after it, else the first.

    Other bundles are variants of the bake: the paper's tables have none.
    """
    chosen: dict[tuple[str, ...], Evaluation] = {}
    for row in rows:
        key = (row.scene, row.method, row.atlas_format) if row.baked else (row.scene, row.label)
        if key not in chosen or (row.baked and (row.group or row.label).endswith(f", {row.atlas_format}")):
            chosen[key] = row
    return list(chosen.values())


def _final(rows: Sequence[Evaluation]) -> list[Evaluation]:
    """What would be shipped of each run: its BC7 bundle, else any bundle, else the trained scene."""
    chosen: dict[tuple[str, str], Evaluation] = {}
    for row in rows:
        key, rank = (row.scene, row.method), (row.atlas_format == "bc7", row.baked)
        other = chosen.get(key)
        if other is None or rank > (other.atlas_format == "bc7", other.baked):
            chosen[key] = row
    return list(chosen.values())


def _falloff_weight(row: Evaluation) -> float | None:
    """The weight of the falloff loss that a run was trained with, where it is that of a preset or an only option."""
    if row.preset == PLAIN and not row.options:
        return 0.0
    if row.preset != FALLOFF:
        return None
    if not row.options:
        return 0.005
    if len(row.options) == 2 and row.options[0] == LOSS:
        return float(row.options[1])
    return None


def _empty(width: int) -> Row:
    return Row(("no run of this kind in the input", *[MISSING] * (width - 1)))


def table_1(data: dict[str, Any], rows: list[Evaluation]) -> Table:
    """Atlas storage formats."""
    header = ("Format", "Bytes / texel", "Mean atlas MB", "ΔPSNR vs. trained")
    lines = [Row((f"{PUBLISHED} ({data['hardware']}), 18 Mip-NeRF 360 splits",), section=True)]
    for entry in data["quantization"]:
        cells = (str(entry["bytes_per_texel"]), entry["mean_atlas_mb"], entry["delta_psnr"] or MISSING)
        lines.append(Row((entry["format"], *cells)))
    texel = {"fp16": "8", "uint8": "4", "bc7": "1"}
    baked = [r for r in rows if r.baked and r.atlas_format in texel]
    scenes = len({(r.scene, r.method) for r in baked})
    lines.append(Row((f"{HERE}, mean of {scenes} trained scenes",), section=True))
    for name in [n for n in texel if any(r.atlas_format == n for r in baked)]:
        of_format = [r for r in baked if r.atlas_format == name]
        deltas = [psnr_delta(row, rows) for row in of_format]
        size = _mean([r.get("atlas_bytes") for r in of_format])
        delta = _mean(deltas)
        cells = (MISSING if size is None else significant(size / 1e6), MISSING if delta is None else signed(delta))
        lines.append(Row((name, texel[name], *cells)))
    if not baked:
        lines.append(_empty(4))
    return Table("Table 1: atlas storage formats", header, tuple(lines))


def table_2(data: dict[str, Any], rows: list[Evaluation]) -> Table:
    """Quantitative results of the two suites."""
    suites = list(reversed(SUITES))
    short = {"mipnerf360": "360", "tanksandtemples": "T&T"}
    figures = ("PSNR ↑", "SSIM ↑", "LPIPS ↓", "Points ↓", "FPS ↑")
    header = ("Method", *(f"{short[suite]} {name}" for suite in suites for name in figures))
    where = f"{PUBLISHED}: FPS marked * measured by the paper on an {data['hardware']}, others as their papers say"
    lines = [Row((where,), section=True)]
    for entry in data["comparison"]:
        cells = [text for suite in suites for text in _texts(entry[suite], PRINTED_WHOLE)]
        lines.append(Row((entry["method"] + (" *" if entry["timed"] else ""), *cells)))
    lines.append(Row((f"{HERE}, after baking where it was baked",), section=True))
    final, notes = [r for r in _final(rows) if r.suite in SUITES], []
    for method in sorted({r.method for r in final}):
        cells = []
        for suite in suites:
            of_suite = [r for r in final if r.method == method and r.suite == suite]
            cells += _quality_text(of_suite)
            if of_suite and len(of_suite) < SUITES[suite][1]:
                notes.append(f"{method}: {len(of_suite)} of {SUITES[suite][1]} scenes of {SUITES[suite][0]}.")
        lines.append(Row((method, *cells)))
    if not final:
        lines.append(Row(("no run on these data sets", *[MISSING] * (len(header) - 1))))
    return Table("Table 2: comparison", header, tuple(lines), " ".join(notes))


def _of_one_scene(
    title: str, scene: str, header: tuple[str, ...], shown: list[Row], mine: list[Row], hardware: str
) -> Table:
    lines = [Row((f"{PUBLISHED} ({hardware}), {scene}",), section=True), *shown, Row((HERE,), section=True)]
    return Table(title, header, (*lines, *(mine or [_empty(len(header))])))


def table_3(data: dict[str, Any], rows: list[Evaluation]) -> Table:
    """Ablation of the falloff loss."""
    order, formats = (3, 0, 1, 2, 4), (count, TWO, THREE, THREE, count)
    shown = [Row((e["variant"], *_texts(e["figures"], formats))) for e in data["falloff"]]
    mine = []
    for row in sorted(_preferred(_final(rows), "bicycle"), key=lambda r: (r.scene, _falloff_weight(r) or 0.0)):
        weight = _falloff_weight(row)
        if weight is not None:
            texts = _quality_text([row])
            mine.append(Row((f"{row.scene}: λ = {weight:g}", *(texts[i] for i in order))))
    header = ("Variant", "N", "PSNR ↑", "SSIM ↑", "LPIPS ↓", "FPS ↑")
    return _of_one_scene("Table 3: falloff loss", "bicycle", header, shown, mine, data["hardware"])


def table_4(data: dict[str, Any], rows: list[Evaluation]) -> Table:
    """Ablation of the view colours."""
    formats = (count, TWO, count, significant)
    printed = (count, TWO, count, PRINTED[4])
    shown = [Row((e["variant"], *_texts(e["figures"], printed))) for e in data["view_colors"]]
    mine = []
    chosen = [r for r in _preferred(_final(rows), "bonsai") if r.preset in VIEW_COLORS and not r.options]
    for row in sorted(chosen, key=lambda r: (r.scene, list(VIEW_COLORS).index(r.preset))):
        (name, per_surfel), surfels = VIEW_COLORS[row.preset], row.get("surfels")
        numbers = None if surfels is None else surfels * per_surfel
        texts = _texts((surfels, row.get("psnr"), numbers, _fps(row)), formats)
        mine.append(Row((f"{row.scene}: {name}", *texts)))
    header = ("Variant", "N", "PSNR ↑", "Parameters ↓", "FPS ↑")
    return _of_one_scene("Table 4: view colours", "bonsai", header, shown, mine, data["hardware"])


def table_5(data: dict[str, Any], rows: list[Evaluation], machines: Sequence[str]) -> Table:
    """Baked rendering on several devices."""
    platforms = data["platforms"]
    header = ("Scene", "Resolution", "N", *(f"{device} FPS" for device in platforms["devices"]), "FPS here")
    lines = [Row((PUBLISHED,), section=True)]
    names = {entry["scene"] for entry in platforms["scenes"]}
    for entry in platforms["scenes"]:
        cells = (entry["resolution"], count(entry["points"]), *map(PRINTED[4], entry["fps"]), MISSING)
        lines.append(Row((entry["scene"], *cells)))
    baked = [r for r in _final(rows) if r.baked]
    mine = [r for r in baked if r.scene in names] or baked
    lines.append(Row((HERE,), section=True))
    blank = [MISSING] * len(platforms["devices"])
    for row in sorted(mine, key=lambda r: (r.scene, r.method)):
        texts = _texts((row.get("surfels"), _fps(row)), (count, significant))
        lines.append(Row((f"{row.scene}: {row.label}", MISSING, texts[0], *blank, texts[1])))
    if not mine:
        lines.append(_empty(len(header)))
    note = f"Here: {'; '.join(machines)}." if machines else ""
    return Table("Table 5: devices", header, tuple(lines), note)


def table_6(data: dict[str, Any], rows: list[Evaluation]) -> Table:
    """Every scene before and after baking, with and without the falloff loss."""
    figures = ("PSNR", "SSIM", "LPIPS", "N", "FPS")
    header = ("Scene", *(f"{name} {form}" for form in ("w/", "w/o") for name in figures))
    lines = []
    for baked, title in ((False, "Trained scene"), (True, "Baked bundle")):
        lines.append(Row((f"{title}: {PUBLISHED.lower()} ({data['hardware']})",), section=True))
        for scene, pair in data["per_scene"]["baked" if baked else "trained"].items():
            lines.append(Row((scene, *(text for side in pair for text in _texts(side, PRINTED)))))
        lines.append(Row((f"{title}: {HERE.lower()}",), section=True))
        stage = [r for r in rows if r.baked == baked and (not baked or r.atlas_format in ("bc7", ""))]
        mine = {weight: [r for r in stage if _falloff_weight(r) == weight] for weight in (0.005, 0.0)}
        scenes = sorted({r.scene for side in mine.values() for r in side})
        for scene in scenes:
            sides = [[r for r in mine[weight] if r.scene == scene][:1] for weight in (0.005, 0.0)]
            lines.append(Row((scene, *(text for side in sides for text in _quality_text(side)))))
        for suite, (name, total) in SUITES.items():
            sides = [[r for r in mine[weight] if r.suite == suite] for weight in (0.005, 0.0)]
            if any(len({r.scene for r in side}) == total for side in sides):
                whole = [side if len({r.scene for r in side}) == total else [] for side in sides]
                lines.append(Row((f"{name} mean", *(text for side in whole for text in _quality_text(side)))))
        if not scenes:
            lines.append(_empty(len(header)))
    note = "w/: with the falloff loss of weight 0.005 (bitymi); w/o: without (bitymi-quality). N: surfels."
    return Table("Table 6: every scene, with and without falloff loss", header, tuple(lines), note)


def _preferred(rows: Sequence[Evaluation], scene: str) -> list[Evaluation]:
    """Those of the paper's scene where there are any, else all."""
    return [r for r in rows if r.scene == scene] or list(rows)


def paper_tables(records: Records, rows: list[Evaluation]) -> list[Table]:
    """The paper's Tables 1 to 6.

    Args:
        records: for the machines.
        rows: evaluations, means over seeds.
    """
    data, rows = published(), one_a_format(rows)
    return [
        table_1(data, rows),
        table_2(data, rows),
        table_3(data, rows),
        table_4(data, rows),
        table_5(data, rows, records.machines),
        table_6(data, rows),
    ]
