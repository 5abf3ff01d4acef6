"""Tables as text files: Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

__all__ = ["csv_table", "markdown_table"]


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    r"""A table in Markdown, all columns but the first aligned to the right.

    >>> print(markdown_table(["method", "PSNR"], [["a|b", "1.0"]]), end="")
    | method | PSNR |
    |---|---:|
    | a\|b | 1.0 |
    """
    lines = [list(headings), ["---", *["---:"] * (len(headings) - 1)], *map(list, rows)]
    shown = (
        "|" + "|".join(cells) + "|" if number == 1 else "| " + " | ".join(c.replace("|", "\\|") for c in cells) + " |"
        for number, cells in enumerate(lines)
    )
    return "\n".join(shown) + "\n"


def csv_table(headings: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table as comma-separated values, numbers in full precision.

    >>> print(csv_table(["method", "psnr"], [["a,b", 1.5]]), end="")
    method,psnr
    "a,b",1.5
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(headings)
    writer.writerows(rows)
    return buffer.getvalue()
