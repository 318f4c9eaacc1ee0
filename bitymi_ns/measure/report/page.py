"""The report as one HTML page and as Markdown."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape

from bitymi_ns.measure.report.drawing import Plot
from bitymi_ns.measure.report.gallery import Group, Picture
from bitymi_ns.measure.report.knob_plots import KNOBS
from bitymi_ns.measure.report.plots import CURVES
from bitymi_ns.measure.report.tables import NOTES, Table, to_html, to_markdown
from bitymi_ns.measure.report.views import ERROR_CAPTION, ComparedSet

GENERATOR = '<meta name="generator" content="bitymi report">'
"""Marks a page as ours, so that it may be replaced."""

STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #26292e; --soft: #646a73; --line: #e3e5e8; --band: #f5f6f8;
  --best: #0b62b8; }
@media (prefers-color-scheme: dark) { :root { --paper: #1b1e23; --ink: #dfe2e6; --soft: #9aa1ab; --line: #363b43;
  --band: #23272e; --best: #6db3f2; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 74rem; padding: 2rem 1.25rem 4rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 .25rem; } h2 { font-size: 1.25rem; margin: 2.5rem 0 .75rem; }
h3 { font-size: 1rem; margin: 1.5rem 0 .5rem; overflow-wrap: anywhere; }
p, ul { margin: .5rem 0; } .soft { color: var(--soft); font-size: .875rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; min-width: min(100%, 34rem); }
th, td { padding: .3rem .8rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
th:first-child { text-align: left; padding-left: .5rem; } thead th { font-weight: 600; border-bottom-width: 2px; }
tbody th { font-weight: 400; }
tr.section th { white-space: normal; background: var(--band); font-style: italic; color: var(--soft); }
table.dense { font-size: .8rem; } table.dense th, table.dense td { padding: .25rem .5rem; }
td b { color: var(--best); }
.plots { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 30rem), 1fr)); gap: 1.5rem; }
.plots.full { grid-template-columns: 1fr; }
.views { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(46%, 17rem), 1fr)); gap: .75rem; }
.views figure + figure { margin-top: .75rem; }
@media (max-width: 45rem) { .views { grid-template-columns: 1fr 1fr; } .views > :first-child { grid-column: 1 / -1; } }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 17rem), 1fr)); gap: .75rem; }
.pictures.broad { grid-template-columns: repeat(auto-fill, minmax(min(100%, 30rem), 1fr)); }
figure { margin: 0; } img { display: block; width: 100%; height: auto; border-radius: 4px; }
.pictures img, .views img { background: repeating-conic-gradient(#bbb 0 25%, #ddd 0 50%) 0 0 / 16px 16px; }
figcaption { color: var(--soft); font-size: .85rem; margin-top: .25rem; }
summary { cursor: pointer; color: var(--soft); } details { margin: 2rem 0 0; }
"""


@dataclass(frozen=True)
class Content:
    """What a report says, before it takes a form.

    Attributes:
        title: heading of the page.
        intro: a line on what was read, and the program's version.
        summary: sentences on what baking changed.
        quality: tables of evaluations; training: of runs; everything: every recorded number.
        plots: drawn plots.
        knobs: tables of the quality knobs.
        paper: the paper's tables, with ours.
        views: held-out views, photograph, renders and errors; they come first.
        worst: the worst views with their errors and decomposition.
        gallery: other images.
        notes: what was skipped and why.
    """

    title: str
    intro: str
    summary: list[str]
    quality: list[Table]
    training: Table | None
    everything: Table | None
    plots: list[Plot]
    knobs: list[Table]
    paper: list[Table]
    views: list[ComparedSet]
    worst: list[Group]
    gallery: list[Group]
    notes: list[str]


def _uri(mime: str, data: bytes) -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


def _plot(plot: Plot) -> str:
    dark, light = _uri("image/png", plot.dark), _uri("image/png", plot.light)
    return (
        f'<figure><picture><source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img src="{light}" alt="{escape(plot.title)}"></picture>'
        f"<figcaption>{escape(plot.title)}</figcaption></figure>"
    )


def _figure(p: Picture) -> str:
    return (
        f'<figure><img loading="lazy" width="{p.width}" height="{p.height}" src="{_uri(p.mime, p.data)}" '
        f'alt="{escape(p.caption)}"><figcaption>{escape(p.caption)}</figcaption></figure>'
    )


def _pictures(group: Group) -> str:
    figures = "\n".join(map(_figure, group.pictures))
    broad = " broad" if any(p.width > 2.2 * p.height for p in group.pictures) else ""
    more = f' <span class="soft">and {group.left_out} more</span>' if group.left_out else ""
    return f'<h3>{escape(group.title)}{more}</h3>\n<div class="pictures{broad}">\n{figures}\n</div>'


def _views(compared: ComparedSet, named: bool) -> list[str]:
    """A row per view: the photograph, then the renders with their errors below; with one folder the error beside."""
    name = f"{compared.title}: " if named else ""
    parts = []
    for view in compared.views:
        columns = view.columns if len(view.columns) > 2 else [(p,) for column in view.columns for p in column]
        stacks = "\n".join(f"<div>{''.join(map(_figure, column))}</div>" for column in columns)
        parts.append(f'<h3>{escape(name + view.title)}</h3>\n<div class="views">\n{stacks}\n</div>')
    return parts


def _list(lines: list[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


VIEWS_NOTE = f"The worst, the median and the best view by the PSNR of these pictures, with their {ERROR_CAPTION}."
PAPER_NOTE = (
    "Figures in the published rows are those that the paper prints: of other hardware, other implementations and, for "
    "most methods, other publications. They stand beside ours for orientation; speeds cannot be compared."
)
TRADE_OFF = "The dashed line is the Pareto front: of all points of a scene those that no other beats in both."
KNOB_NOTE = (
    "Errors are against the exact setting, in 8-bit steps of a colour (1/255), over all pixels of the measured views; "
    "the thin line is one step. Milliseconds are per view at full size, of the renderer named."
)


def _sections(plots: list[Plot]) -> list[tuple[str, list[Plot]]]:
    """Plots by section, in order."""
    return [(name, [p for p in plots if p.section == name]) for name in dict.fromkeys(p.section for p in plots)]


def _tables(tables: list[Table]) -> list[str]:
    parts = []
    for table in tables:
        parts += [f"<h3>{escape(table.title)}</h3>", to_html(table)]
        parts += [f'<p class="soft">{escape(table.note)}</p>'] if table.note else []
    return parts


def to_page(content: Content) -> str:
    """The report as a single HTML document that needs no other file."""
    parts = [f"<h1>{escape(content.title)}</h1>", f'<p class="soft">{escape(content.intro)}</p>']
    if content.summary:
        parts.append(_list(content.summary))
    if content.views:
        parts += ["<h2>Held-out views</h2>", f'<p class="soft">{escape(VIEWS_NOTE)}</p>']
    for compared in content.views:
        parts += _views(compared, named=len(content.views) > 1)
    if content.quality:
        parts += ["<h2>Quality and speed</h2>", *_tables(content.quality), f'<p class="soft">{escape(NOTES)}</p>']
    if content.training:
        parts += ["<h2>Training</h2>", to_html(content.training)]
    for name, plots in _sections(content.plots):
        note = KNOB_NOTE if name == KNOBS else TRADE_OFF if any(plot.name not in CURVES for plot in plots) else ""
        full = " full" if any(plot.panels > 1 for plot in plots) else ""
        parts += [f"<h2>{escape(name)}</h2>", *([f'<p class="soft">{escape(note)}</p>'] if note else [])]
        parts += [f'<div class="plots{full}">', *map(_plot, plots), "</div>"]
        parts += _tables(content.knobs) if name == KNOBS else []
    if content.paper:
        parts += [
            "<h2>The paper\u2019s tables</h2>",
            f'<p class="soft">{escape(PAPER_NOTE)}</p>',
            *_tables(content.paper),
        ]
    if content.worst:
        parts += ["<h2>Worst views</h2>", *map(_pictures, content.worst)]
    if content.gallery:
        parts += ["<h2>Other pictures</h2>", *map(_pictures, content.gallery)]
    if content.everything:
        title = escape(content.everything.title)
        parts.append(f"<details><summary>{title}</summary>{to_html(content.everything)}</details>")
    if content.notes:
        parts += ["<h2>Left out</h2>", _list(content.notes)]
    body = "\n".join(parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n{GENERATOR}\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(content.title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _markdown_tables(tables: list[Table]) -> list[str]:
    parts = []
    for table in tables:
        parts += [f"### {table.title}", to_markdown(table)]
        parts += [table.note] if table.note else []
    return parts


def to_report_md(content: Content) -> str:
    """The report as Markdown, its plots as files beside it."""
    parts = [f"# {content.title}", content.intro]
    if content.summary:
        parts.append("\n".join(f"- {line}" for line in content.summary))
    if content.quality:
        parts += ["## Quality and speed", *_markdown_tables(content.quality), NOTES]
    if content.training:
        parts += ["## Training", to_markdown(content.training)]
    for name, plots in _sections(content.plots):
        parts += [f"## {name}", *(f"![{plot.title}]({plot.name}.png)" for plot in plots)]
        parts += [*_markdown_tables(content.knobs), KNOB_NOTE] if name == KNOBS else []
    if content.paper:
        parts += ["## The paper's tables", PAPER_NOTE, *_markdown_tables(content.paper)]
    if content.everything:
        parts += [f"## {content.everything.title}", to_markdown(content.everything)]
    if content.notes:
        parts += ["## Left out", "\n".join(f"- {line}" for line in content.notes)]
    return "\n\n".join(parts) + "\n"
