"""Print the summary table of an export."""

import shlex
from collections.abc import Callable
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from rich.table import Table

from bitymi_ns.bake import Coded
from bitymi_ns.bundle.manifest import COMPACT_SURFELS, TEXELS, Manifest
from bitymi_ns.bundle.read import download_bytes
from bitymi_ns.bundle.statistics import FineTuning
from bitymi_ns.bundle.verify import steps_text
from bitymi_ns.codec.quantise import BYTES_PER_TEXEL
from bitymi_ns.ops import VIEW_COLORS
from bitymi_ns.trust import printable
from ..console import say

Add = Callable[[str, str], None]  # adds a row: name and text
_MUCH_SMALLER = 0.9


def decibels(value: float | None) -> str:
    """Format a PSNR; None: equal pictures, or no pixel that counts."""
    return "no number" if value is None else f"{value:.2f} dB"


def print_summary(folder: Path, baked: Coded, info: Manifest, target_mb: float | None = None) -> None:
    """Print what a bake left out, saved and cost; `info`: of the written bundle."""
    statistics = info.statistics
    table = Table("", "", title=escape(printable(f"Bundle {folder}")), show_header=False)
    add = table.add_row
    add("Surfels", f"{baked.trained:,} -> {len(baked.rows):,}")
    left_out = (f"{count:,} {reason.replace('_', ' ')}" for reason, count in (+baked.left_out).items())
    add("Left out", ", ".join(left_out) or "nothing")
    if baked.texel_counts:
        print_savings(add, baked, info)
    print_view_color(add, info)
    if baked.atlas is None or info.atlas is None:
        why = "the scene has no texture" if not baked.texel_counts else "no tile is needed"
        add("Atlas", f"none ({why})")
    else:
        size, atlas = info.files[info.atlas.file].bytes, baked.atlas
        pages = f"{atlas.layers} x {atlas.width} x {atlas.height} texels"
        add("Atlas", f"{size / 1e6:.2f} MB {info.atlas.format}, {pages}")
        add("Occupancy", f"{baked.packing.occupancy:.1%}")
        if atlas.psnr is not None:
            add("Quantisation", f"{atlas.psnr:.2f} dB over the texels")
    for name, learned in (("Polish", statistics.polish), ("Fine-tuning", statistics.finetune)):
        if learned is not None:
            print_tuning(add, name, learned)
    size, held_out = download_bytes(folder, info), statistics.held_out
    add("Files", f"{size / 1e6:.2f} MB in total, bundle.json included")
    alternatives = statistics.rounding and statistics.rounding.alternatives
    if alternatives:
        scene = sum(info.files[name].bytes for name in (COMPACT_SURFELS, TEXELS) if name in info.files)
        totals = ((size + scene * (ratio - 1), gain) for ratio, gain in alternatives if gain is not None)
        stated = ", ".join(f"{total / 1e6:.2g} MB {gain:+.2f} dB" for total, gain in totals)
        add("... with --target-mb, about", stated)
        views = "training" if held_out is None else "held-out"
        add("", f"({views} photographs, before fine-tuning, which makes the differences smaller)")
    if held_out is not None:
        add("Held-out views", f"{held_out.views}")
        add("Bundle against trained scene", decibels(held_out.psnr_baked_against_neural))
        for name, form in (("Trained scene", "neural"), ("Bundle", "baked")):
            plain, fitted = (getattr(held_out, f"{kind}_{form}_against_photos") for kind in ("psnr", "fitted_psnr"))
            fit = f"{decibels(plain)}, {decibels(fitted)} after a fit of the colours"
            add(f"{name} against photographs", fit)
    CONSOLE.print(table)
    if target_mb is not None and size < _MUCH_SMALLER * 1e6 * target_mb:
        say(f"{size / 1e6:.2f} MB suffice, of the {target_mb:g} MB that were asked for: more gain less than 0.01 dB.")
    say(f"Evaluate it with: ns-eval --load-config {shlex.quote(str(folder / 'config.yml'))}")


def print_savings(add: Add, baked: Coded, info: Manifest) -> None:
    """Add rows for tiles, texels, atlas bytes and coding error."""
    add("Tiles", f"{baked.trained:,} -> {int((baked.sizes[:, 0] > 0).sum()):,}")
    voxel = "local voxel" if baked.options.local_voxel else "smallest voxel"
    rules = {
        "learned": "Texels that learned",
        "paper": "Texels by the paper's rule",
        "nyquist": f"... by the {voxel}, extent {baked.options.extent:g}",
        "after_cap_by_views": "... no finer than a view sees",
        "within_visible_part": "... only where they are seen",
        "polished": "... by the pixels that show them: polished",
    }
    stated = [(rule, baked.texel_counts[name]) for name, rule in rules.items() if name in baked.texel_counts]
    for rule, texels in stated:
        add(rule, f"{texels:,}")
    kept, first = baked.packing.texels, stated[0][1]
    add("... within the tolerance: kept", f"{kept:,} ({kept / max(1, first):.1%})")
    rule = first * BYTES_PER_TEXEL["bc7" if baked.codes is not None else baked.options.texel_format]
    stored = info.files[info.atlas.file].bytes if info.atlas else 0
    add("Atlas bytes", f"{rule:,} -> {stored:,} ({stored / max(1, rule):.1%})")
    if (certificate := baked.statistics.certificate) is not None:
        count = certificate.within + certificate.beyond
        add("As stored and seen", f"{certificate.within:,} of {count:,} surfels within the tolerance")
        worst = "no number" if certificate.worst is None else f"at most {certificate.worst:.2f} steps"
        add("", f"({certificate.tolerance:g} steps from the colours before coding; {worst})")


def print_view_color(add: Add, info: Manifest) -> None:
    reduced, stored = info.statistics.view_color, info.files[info.surfels.file].bytes
    if reduced is None:
        add("View colour", "all of it is kept")
        add("Surfel bytes", f"{stored:,}")
        return
    sites, count, error = reduced.sites, info.surfels.count, reduced.error
    if sites.before:
        saved = f"{sites.before:,} -> {sites.after:,} ({sites.after / sites.before:.1%})"
        add(VIEW_COLORS[info.surfels.view_color].kept, saved)
    add("Surfels of one colour", f"{reduced.one_color:,} ({reduced.one_color / count:.1%})")
    if info.surfels.columns is None and reduced.bytes is not None and reduced.bytes.before is not None:
        whole = stored + reduced.bytes.before - reduced.bytes.after
        add("Surfel bytes", f"{whole:,} -> {stored:,} ({stored / whole:.1%})")
    else:
        add("Surfel bytes", f"{stored:,} ({stored / max(1, count):.1f} per surfel)")
    median, high, most = map(steps_text, (error.p50, error.p99, error.p100))
    add("Error of a view colour", f"median {median}, 99 % {high}, at most {most} steps")
    add("", f"(tolerance {reduced.tolerance:g}; weighted, largest over directions and channels)")


def print_tuning(add: Add, name: str, tuned: FineTuning) -> None:
    if not tuned.steps:
        add(name, f"none: {tuned.views} training views are too few for validation views")
        return
    add(name, f"{tuned.steps} steps, {tuned.seconds:.0f} s")
    asked, best = tuned.steps_asked, tuned.best_step
    if asked is not None and best is not None and tuned.steps < asked:
        add("", f"(stopped early at step {tuned.steps} of {asked}: no gain on the")
        add("", f"validation views for {tuned.steps - best} steps)")
    gains = {"... validation views": tuned.psnr_held_in, "... held-out views": tuned.psnr_held_out}
    for views, gain in gains.items():
        if gain is not None:
            add(views, f"{decibels(gain.before)} -> {decibels(gain.after)}")
