"""The loop of a worker process: `python -m data_gen.datasets.worker_process MODULE:FUNCTION`.

Standard input has one JSON value per line: first the settings, then items. Standard output answers each item with one
line: {"ok": result}, {"skip": reason} if the item is at fault, {"fatal": reason} if no item can be processed. Output of
libraries goes to standard error. The process ends with its input, also when the parent has died.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any

from hyperplanes.utilities.files.reading import DataError

__all__ = ["main", "process_item"]


def main() -> int:
    """Serve until the input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    settings = json.loads(sys.stdin.readline() or "{}")
    try:
        process = resolve_name(sys.argv[1])(settings)
        answers.write(json.dumps({"ready": True}) + "\n")
        for line in iter(sys.stdin.readline, ""):
            answers.write(json.dumps(process_item(process, json.loads(line))) + "\n")
    except BrokenPipeError:
        return 1
    except Exception as error:  # without a renderer no item can be processed
        answers.write(json.dumps({"fatal": _one_line(error)}) + "\n")
        return 1
    return 0


def process_item(process: Callable[[Any], dict[str, Any]], item: Any) -> dict[str, Any]:
    """Process one item and catch exceptions.

    Returns:
        {"ok": result}, {"skip": reason} or {"fatal": reason}.
    """
    try:
        return {"ok": process(item)}
    except DataError as error:
        return {"fatal": str(error)}
    except Exception as error:
        return {"skip": _one_line(error)}


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split()) or "no message"
    return text if isinstance(error, ValueError) else f"{type(error).__name__}: {text}"


if __name__ == "__main__":
    sys.exit(main())
