"""Source of truth: jaxtyping and beartype on every call; checking one call of each kind must give the same results."""

import jaxtyping
import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from typechecker import check, checked_once

CALLS = []
wrap = jaxtyping.jaxtyped(typechecker=check)


def rows(points: Float[Tensor, "point 3"], weights: Float[Tensor, " point"], given=None) -> Float[Tensor, "point 3"]:
    CALLS.append(len(points))
    return points * weights[:, None] if given is None else given


def outcome(function, *given):
    try:
        return function(*given)
    except jaxtyping.TypeCheckError as error:
        return type(error)


def test_the_same_calls_are_refused_as_with_a_check_of_every_call():
    once, always = checked_once(rows, wrap), wrap(rows)
    sizes = (5, 100, 5, 20, 100, 3, 16, 15)
    calls = [(torch.ones(size, 3), torch.ones(size)) for size in sizes]
    calls += [
        (torch.ones(30, 3), torch.ones(31)),
        (torch.ones(30, 4), torch.ones(30)),
        (torch.ones(4, 3), torch.ones(5)),
    ]
    calls += [(torch.ones(30, 3).long(), torch.ones(30)), (np.ones((30, 3)), torch.ones(30))]
    calls += [(torch.ones(30, 3), torch.ones(30), torch.ones(size, 3)) for size in (30, 29, 3)]
    calls += [(torch.ones(30, 3), torch.ones(30), torch.ones(30, 2)), (torch.ones(30, 3), torch.ones(30), 7)]
    for given in calls + calls[::-1]:
        found, expected = outcome(once, *given), outcome(always, *given)
        assert torch.equal(found, expected) if isinstance(expected, Tensor) else found is expected
    assert outcome(always, *calls[8]) is jaxtyping.TypeCheckError


def test_a_wrong_result_of_a_known_call_is_refused_and_nothing_is_called_twice():
    once = checked_once(rows, wrap)
    points, weights = torch.ones(30, 3), torch.ones(30)
    once(points, weights, torch.ones(30, 3))
    CALLS.clear()
    once(points, weights, torch.zeros(30, 3))
    with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
        once(points, weights, torch.ones(31, 3))
    with pytest.raises(jaxtyping.TypeCheckError, match="parameters"):
        once(torch.ones(30, 2), weights, torch.ones(30, 3))
    assert CALLS == [30, 30]


def test_fields_of_dataclasses_of_the_package_are_checked():
    from hyperplanes.geometry.rays import Rays

    for count in (20, 30):
        near, far = torch.zeros(2, count)
        Rays(torch.zeros(count, 3), torch.ones(count, 3), near, far)
        with pytest.raises(jaxtyping.TypeCheckError):
            Rays(torch.zeros(count, 3), torch.ones(count + 1, 3), near, far)
