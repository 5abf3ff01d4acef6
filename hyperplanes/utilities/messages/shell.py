"""Commands to copy into a shell."""

from __future__ import annotations

import shlex

__all__ = ["command_line"]


def command_line(*words: object) -> str:
    """The words of a command, quoted where a shell needs it.

    >>> from pathlib import Path
    >>> command_line("hyperplanes", "view", Path("my scene"))
    "hyperplanes view 'my scene'"
    >>> command_line("hyperplanes", "view", "scene", ["--steps", 100])
    'hyperplanes view scene --steps 100'

    Args:
        words: in order; lists and tuples are flattened.
    """
    parts = (word if isinstance(word, list | tuple) else [word] for word in words)
    return shlex.join(str(word) for part in parts for word in part)
