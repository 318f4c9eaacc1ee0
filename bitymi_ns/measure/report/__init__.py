"""Reports: tables and plots of error against run time, from evaluations and training curves."""

from bitymi_ns.measure.report.assemble import build
from bitymi_ns.measure.report.records import ReportError

__all__ = ["ReportError", "build"]
