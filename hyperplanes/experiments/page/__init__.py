"""A self-contained web page about one experiment: pictures, curves and the table."""

from hyperplanes.experiments.page.content import Exhibit, QueryView, Report, Row
from hyperplanes.experiments.page.page import render_page

__all__ = ["Exhibit", "QueryView", "Report", "Row", "render_page"]
