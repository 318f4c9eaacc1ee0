"""Pages of reports with few parts."""

from typing import Any

from bitymi_ns.measure.report.page import compose, to_page
from bitymi_ns.measure.report.records import Records


def page_of(**parts: Any) -> str:
    """The HTML page of a report that shows these parts alone."""
    return to_page({**compose(Records(), ""), **parts})
