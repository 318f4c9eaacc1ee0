"""The report as one HTML page and as Markdown."""

from __future__ import annotations

from dataclasses import dataclass

from bitymi_ns.measure.report.drawing import Plot
from bitymi_ns.measure.report.gallery import Group
from bitymi_ns.measure.report.knob_plots import KNOBS
from bitymi_ns.measure.report.plots import CURVES
from bitymi_ns.measure.report.poses import PosesShown
from bitymi_ns.measure.report.tables import NOTES, Table, to_markdown
from bitymi_ns.measure.report.views import ERROR_CAPTION, ComparedSet
from bitymi_ns.measure.templates import rendered

GENERATOR = '<meta name="generator" content="bitymi report">'
"""Marks a page as ours, so that it may be replaced."""


@dataclass(frozen=True)
class Content:
    """What a report says, before it takes a form.

    Attributes:
        title: heading of the page.
        intro: a line on what was read, and the program's version.
        summary: sentences on what baking changed.
        quality: tables of evaluations; training: of runs; everything: every recorded number.
        poses: how the camera poses of captures were found.
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
    poses: list[PosesShown]
    plots: list[Plot]
    knobs: list[Table]
    paper: list[Table]
    views: list[ComparedSet]
    worst: list[Group]
    gallery: list[Group]
    notes: list[str]


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


@dataclass(frozen=True)
class Section:
    """Plots under one heading."""

    name: str
    plots: list[Plot]

    @property
    def note(self) -> str:
        """What a reader of the plots has to know; "" = nothing."""
        if self.name == KNOBS:
            return KNOB_NOTE
        return TRADE_OFF if any(plot.name not in CURVES for plot in self.plots) else ""

    @property
    def full(self) -> bool:
        """Whether a plot needs the whole width of the page."""
        return any(plot.panels > 1 for plot in self.plots)


def _sections(plots: list[Plot]) -> list[Section]:
    """Plots by section, in order."""
    names = dict.fromkeys(plot.section for plot in plots)
    return [Section(name, [plot for plot in plots if plot.section == name]) for name in names]


def to_page(content: Content) -> str:
    """The report as a single HTML document that needs no other file."""
    return rendered(
        "report.html.j2",
        content=content,
        sections=_sections(content.plots),
        knobs=KNOBS,
        generator=GENERATOR,
        notes={"views": VIEWS_NOTE, "tables": NOTES, "paper": PAPER_NOTE},
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
    for each in content.poses:
        parts += ["## Camera poses", *_markdown_tables(list(each.tables))]
    for section in _sections(content.plots):
        parts += [f"## {section.name}", *(f"![{plot.title}]({plot.name}.png)" for plot in section.plots)]
        parts += [*_markdown_tables(content.knobs), KNOB_NOTE] if section.name == KNOBS else []
    if content.paper:
        parts += ["## The paper's tables", PAPER_NOTE, *_markdown_tables(content.paper)]
    if content.everything:
        parts += [f"## {content.everything.title}", to_markdown(content.everything)]
    if content.notes:
        parts += ["## Left out", "\n".join(f"- {line}" for line in content.notes)]
    return "\n\n".join(parts) + "\n"
