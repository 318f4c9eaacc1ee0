"""Reports: tables and plots of error against run time, from evaluations and training curves."""

from bitymi_ns.report.assemble import build
from bitymi_ns.report.records import ReportError

__all__ = ["ReportError", "build"]
