"""Sources of truth: the definition (NeRF, Eq. 4) entry by entry, and float64 gradcheck."""

import pytest
import torch

from hyperplanes.fields.encoding import encode, encoded_size


@pytest.mark.parametrize("octaves", [0, 1, 4, 10, 32])
def test_encoding_is_its_definition(octaves):
    values = torch.linspace(-1, 1, 41).reshape(-1, 1) * torch.tensor([[1.0, 0.3, -0.7]])
    exact = values.double()
    angles = [exact * 2**octave for octave in range(octaves)]
    expected = torch.cat([exact, *map(torch.sin, angles), *map(torch.cos, angles)], 1)
    # each doubling of an angle more than doubles its rounding error of 6e-8, to 1e-4 after seven times
    torch.testing.assert_close(encode(values, octaves).double(), expected, atol=2e-4, rtol=0)
    torch.testing.assert_close(encode(exact, octaves), expected, atol=1e-12, rtol=0)


def test_length_and_batches():
    for octaves in (0, 3):
        assert encode(torch.rand(2, 5, 3), octaves).shape == (2, 5, encoded_size(octaves))
    assert encode(torch.rand(7, 2), 4).shape == (7, 2 + 2 * 2 * 4)


def test_the_value_itself_comes_first():
    values = torch.rand(4, 3)
    assert torch.equal(encode(values, 5)[:, :3], values)


def test_gradients():
    values = torch.rand(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: encode(v, 4), values)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_with_many_octaves_has_only_rounding_errors(dtype):
    values = torch.tensor([[1.0, 0.3, -1.0]]).to(dtype)
    expected = encode(values.double(), 32)
    torch.testing.assert_close(encode(values, 32).double(), expected, atol=torch.finfo(dtype).eps, rtol=0)
