"""Report pages with few parts."""

from typing import Any

from bitymi_ns.measure.report.page import compose, to_page
from bitymi_ns.measure.report.records import Records


def page_of(**parts: Any) -> str:
    """Render the HTML page of a report with only these parts."""
    return to_page({**compose(Records(), ""), **parts})
