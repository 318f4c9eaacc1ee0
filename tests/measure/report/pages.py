"""Pages of reports that say little."""

from __future__ import annotations

from typing import Any

from bitymi_ns.measure.report.page import Content, to_page

EMPTY: dict[str, Any] = {
    "title": "", "intro": "", "summary": [], "views": [], "quality": [], "training": None, "poses": [], "sections": [],
    "knobs": [], "worst": [], "notes": [],
}  # fmt: skip


def page_of(**said: Any) -> str:
    """The HTML page of a report that says this alone."""
    return to_page(Content(**{**EMPTY, **said}))
