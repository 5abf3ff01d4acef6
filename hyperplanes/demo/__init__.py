"""A self-contained web page about one experiment: pictures, curves and the table."""

from hyperplanes.demo.content import Exhibit, Look, Report, Row
from hyperplanes.demo.page import render_page

__all__ = ["Exhibit", "Look", "Report", "Row", "render_page"]
