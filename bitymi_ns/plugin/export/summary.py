"""Print the summary table of an export."""

import shlex
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from rich.table import Table

from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.manifest import COMPACT_SURFELS, TEXELS, Manifest
from bitymi_ns.bundle.read import download_bytes
from bitymi_ns.bundle.statistics import FineTuning, KeptSurfels, KeptTexels
from bitymi_ns.codec.quantise import BYTES_PER_TEXEL
from bitymi_ns.ops import VIEW_COLORS
from bitymi_ns.plugin.console import say
from bitymi_ns.trust import printable


def decibels(value: float | None) -> str:
    """Format a PSNR; None: equal pictures, or no pixel that counts."""
    return "no number" if value is None else f"{value:.2f} dB"


def print_summary(folder: Path, info: Manifest) -> None:
    statistics = info.statistics
    surfels = statistics.surfels or KeptSurfels()
    table = Table("", "", title=escape(printable(f"Bundle {folder}")), show_header=False)
    table.add_row("Surfels", f"{surfels.trained:,} -> {info.surfels.count:,}")
    left_out = {name: count for name, count in surfels.left_out or () if count}
    table.add_row("Left out", ", ".join(f"{v:,} {k.replace('_', ' ')}" for k, v in left_out.items()) or "nothing")
    if statistics.texels is not None:
        print_savings(table, info)
    print_view_color(table, info)
    atlas = statistics.atlas
    if atlas is None or atlas.pages is None or info.atlas is None:
        why = "the scene has no texture" if statistics.texels is None else "no tile is needed"
        table.add_row("Atlas", f"none ({why})")
    else:
        layers, height, width = atlas.pages
        size = info.files[info.atlas.file].bytes
        table.add_row("Atlas", f"{size / 1e6:.2f} MB {info.atlas.format}, {layers} x {width} x {height} texels")
        table.add_row("Occupancy", f"{100 * (atlas.occupancy or 0.0):.1f} %")
        if atlas.psnr is not None:
            table.add_row("Quantisation", f"{atlas.psnr:.2f} dB over the texels")
    for name, learned in (("Polish", statistics.polish), ("Fine-tuning", statistics.finetune)):
        if learned is not None:
            print_tuning(table, name, learned)
    size, held_out = download_bytes(folder, info), statistics.held_out
    table.add_row("Files", f"{size / 1e6:.2f} MB in total, bundle.json included")
    others = statistics.rounding and statistics.rounding.alternatives
    if others:
        scene = sum(info.files[name].bytes for name in (COMPACT_SURFELS, TEXELS) if name in info.files)
        sizes = ((size + scene * (ratio - 1)) / 1e6 for ratio, _ in others)
        found = (f"{mb:.2g} MB {gain:+.2f} dB" for mb, (_, gain) in zip(sizes, others, strict=True) if gain is not None)
        table.add_row("... with --target-mb, about", ", ".join(found))
        views = "training" if held_out is None else "held-out"
        table.add_row("", f"({views} photographs, before fine-tuning, which makes the differences smaller)")
    if held_out is not None:
        table.add_row("Held-out views", f"{held_out.views}")
        table.add_row("Bundle against trained scene", decibels(held_out.psnr_baked_against_neural))
        for name, form in (("Trained scene", "neural"), ("Bundle", "baked")):
            plain, fitted = (getattr(held_out, f"{kind}_{form}_against_photos") for kind in ("psnr", "fitted_psnr"))
            fit = f"{decibels(plain)}, {decibels(fitted)} after a fit of the colours"
            table.add_row(f"{name} against photographs", fit)
    CONSOLE.print(table)
    say(f"Evaluate it with: ns-eval --load-config {shlex.quote(str(folder / 'config.yml'))}")


def print_savings(table: Table, info: Manifest) -> None:
    """Add rows for tiles, texels, atlas bytes (by rule, in the bundle) and coding error."""
    statistics, options = info.statistics, info.statistics.options or BakeOptions()
    texels, surfels = statistics.texels or KeptTexels(), statistics.surfels or KeptSurfels()
    kept, count = texels.kept or 0, info.surfels.count
    table.add_row("Tiles", f"{surfels.trained:,} -> {count - (surfels.without_tile or 0):,}")
    if texels.paper is not None:
        table.add_row("Texels by the paper's rule", f"{texels.paper:,}")
        voxel = "local voxel" if options.local_voxel else "smallest voxel"
        table.add_row(f"... by the {voxel}, extent {options.extent:g}", f"{texels.nyquist:,}")
    if texels.learned is not None:
        table.add_row("Texels that learned", f"{texels.learned:,}")
    else:
        table.add_row("... no finer than a view sees", f"{texels.after_cap_by_views:,}")
        table.add_row("... only where they are seen", f"{texels.within_visible_part:,}")
    if texels.polished is not None:
        table.add_row("... by the pixels that show them: polished", f"{texels.polished:,}")
    first = texels.paper or texels.learned or texels.within_visible_part or 0
    table.add_row("... within the tolerance: kept", f"{kept:,} ({100 * kept / max(1, first):.1f} %)")
    rule = first * BYTES_PER_TEXEL["bc7" if info.surfels.columns else options.format or "bc7"]
    stored = info.files[info.atlas.file].bytes if info.atlas else 0
    table.add_row("Atlas bytes", f"{rule:,} -> {stored:,} ({100 * stored / max(1, rule):.1f} %)")
    certificate = statistics.certificate
    if certificate is not None:
        count = certificate.within + certificate.beyond
        table.add_row("As stored and seen", f"{certificate.within:,} of {count:,} surfels within the tolerance")
        worst = "no number" if certificate.worst is None else f"at most {certificate.worst:.2f} steps"
        table.add_row("", f"({certificate.tolerance:g} steps from the colours before coding; {worst})")


def print_view_color(table: Table, info: Manifest) -> None:
    lean, stored = info.statistics.view_color, info.files[info.surfels.file].bytes
    if lean is None:
        table.add_row("View colour", "all of it is kept")
        table.add_row("Surfel bytes", f"{stored:,}")
        return
    sites, count, error = lean.sites, info.surfels.count, lean.error
    share = 100 * sites.after / (sites.before or 1)
    kept = VIEW_COLORS[lean.kind or info.surfels.view_color].kept
    table.add_row(kept, f"{sites.before:,} -> {sites.after:,} ({share:.1f} %)")
    table.add_row("Surfels of one colour", f"{lean.one_color:,} ({100 * lean.one_color / count:.1f} %)")
    if info.surfels.columns is None and lean.bytes is not None:
        whole = stored + (lean.bytes.before or 0) - lean.bytes.after
        table.add_row("Surfel bytes", f"{whole:,} -> {stored:,} ({100 * stored / whole:.1f} %)")
    else:
        table.add_row("Surfel bytes", f"{stored:,} ({stored / max(1, count):.1f} per surfel)")
    table.add_row(
        "Error of a view colour", f"median {error.p50:.2f}, 99 % {error.p99:.2f}, at most {error.p100:.2f} steps"
    )
    table.add_row("", f"(tolerance {lean.tolerance:g}; weighted, largest over directions and channels)")


def print_tuning(table: Table, name: str, tuned: FineTuning) -> None:
    if not tuned.steps:
        table.add_row(name, f"none: {tuned.views} training views are too few for validation views")
        return
    table.add_row(name, f"{tuned.steps} steps, {tuned.seconds:.0f} s")
    if tuned.steps < (tuned.steps_asked or 0):
        table.add_row("", f"(stopped early at step {tuned.steps} of {tuned.steps_asked}: no gain on the")
        table.add_row("", f"validation views for {tuned.steps - (tuned.best_step or 0)} steps)")
    gains = {"... validation views": tuned.psnr_held_in, "... held-out views": tuned.psnr_held_out}
    for views, gain in gains.items():
        if gain is not None:
            table.add_row(views, f"{gain.before:.2f} -> {gain.after:.2f} dB")
