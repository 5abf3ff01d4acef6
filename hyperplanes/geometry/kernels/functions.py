"""Elementary functions for the CPU kernels, without a call, so that LLVM vectorises loops over them (numba only).

For single precision, exact to about 1e-7.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.blocks import inlined

__all__ = ["acos", "exp", "sine_and_cosine", "tanh"]

NEAR = 1.6  # radians within which series of eleven and twelve powers are exact


@inlined
@no_type_check
def acos(x):
    """The arc cosine within 1e-7 (Abramowitz and Stegun, 4.4.46)."""
    n = type(x)
    a = abs(x)
    series = n(-0.0012624911)
    series = series * a + n(0.0066700901)
    series = series * a + n(-0.0170881256)
    series = series * a + n(0.0308918810)
    series = series * a + n(-0.0501743046)
    series = series * a + n(0.0889789874)
    series = series * a + n(-0.2145988016)
    series = series * a + n(1.5707963050)
    angle = np.sqrt(max(n(1) - a, n(0))) * series
    return angle if x >= 0 else n(np.pi) - angle


@inlined
@no_type_check
def exp(x):
    """e^x, of x between -87 and 87, others as these: 2^n times the Taylor series of what is left, |r| < 0.35."""
    n = np.float32
    x = min(max(x, n(-87)), n(87))
    power = np.floor(x * n(1.4426950408889634) + n(0.5))
    r = x - power * n(0.6931471805599453)
    series = n(1 / 5040)
    for denominator in (n(1 / 720), n(1 / 120), n(1 / 24), n(1 / 6), n(1 / 2), n(1), n(1)):
        series = series * r + denominator
    # the bits of 2^n: its exponent alone
    return series * np.int32((power + n(127)) * n(1 << 23)).view(np.float32)


@inlined
@no_type_check
def tanh(x):
    """The hyperbolic tangent."""
    one = np.float32(1)
    return one - (one + one) / (exp(x + x) + one)


@inlined
@no_type_check
def sine_and_cosine(x):
    """Both: Taylor series of coordinates within a scene, the C library's beyond."""
    n = type(x)
    if abs(x) > n(NEAR):
        return n(math.sin(x)), n(math.cos(x))
    square = x * x
    sine, cosine = n(-1 / 39916800), n(1 / 479001600)
    for below in (n(1 / 362880), n(-1 / 5040), n(1 / 120), n(-1 / 6), n(1)):
        sine = sine * square + below
    for below in (n(-1 / 3628800), n(1 / 40320), n(-1 / 720), n(1 / 24), n(-1 / 2), n(1)):
        cosine = cosine * square + below
    return sine * x, cosine
