"""The symmetric field of one object, optimised on its support views from random weights."""

from __future__ import annotations

from hyperplanes.adaptation import Adapter, FieldFromScratch
from hyperplanes.methods import Method, Request

__all__ = ["SYMMETRIC_SCRATCH"]


def make(request: Request) -> Adapter:
    """An adapter: its `adapt` turns the support views of an object into a field."""
    return FieldFromScratch(request.configured("symmetric"), request.needed_steps, request.settings, request.device)


SYMMETRIC_SCRATCH = Method("a symmetric NeRF of one object from random weights", make, steps="required")
