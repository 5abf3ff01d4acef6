"""The commands that data_gen adds to `hyperplanes`, one a module, by entry points in pyproject.toml."""

from __future__ import annotations

from hyperplanes.commands import Verb

__all__ = ["GENERATE", "INSPECT"]

GENERATE = Verb(
    "data_gen.commands.generate", "render meshes, your own or procedural ones, into a data set of posed images"
)
INSPECT = Verb("data_gen.commands.inspect", "say what is in a data set or a checkpoint")
