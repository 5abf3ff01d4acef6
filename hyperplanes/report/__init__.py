"""A self-contained web page about one experiment: pictures, curves and the table."""

from hyperplanes.report.content import Exhibit, Look, Report, Row
from hyperplanes.report.page import render_page

__all__ = ["Exhibit", "Look", "Report", "Row", "render_page"]
