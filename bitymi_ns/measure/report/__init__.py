"""Reports: one page of tables, plots and pictures from evaluations, training curves and benchmark cells."""

from bitymi_ns.measure.report.page import build
from bitymi_ns.measure.report.records import ReportError

__all__ = ["ReportError", "build"]
