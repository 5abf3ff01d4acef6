"""Source of truth: typical wrong calls; each gives one line that names the argument."""

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation import HullBlend, HyperPlanes
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.export.images import orbit_cameras, save_images
from hyperplanes.geometry import ImagePlanes, cameras
from hyperplanes.rendering.renderer import RayMarching, render
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.views import Views
from tests.reference_rendering import ring

PICTURES = torch.zeros(1, 3, 4, 4)
VIEWS = Views(PICTURES, ring(1, (4, 4)))


def field(points, directions):
    return points, points[:, :1]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: save_images(PICTURES[0], "x"), r"images: expected a tensor \(view 3 height width\), got a tensor of"),
        (lambda: save_images(PICTURES.numpy(), "x"), "images: expected a tensor .*, got a numpy.ndarray"),
        (lambda: save_images(PICTURES, None), "folder: expected str or Path, got None"),
        (lambda: psnr(PICTURES, None), "truth: expected a tensor .*, got None"),
        (lambda: psnr(PICTURES, PICTURES.byte()), "truth: expected a tensor .*, got a tensor of uint8"),
        (lambda: orbit_cameras(None, 3), "views: expected Views, got None"),
        (lambda: orbit_cameras("example-car", 3), "views: expected Views, got 'example-car'"),
        (lambda: TrainingConfig(evaluate_every=0), "evaluate_every: expected a whole number from 1 to .*, got 0"),
        (lambda: RayMarching(steps=2.5), "steps: expected a whole number from 1 to .*, got 2.5"),
        (lambda: cameras.orbit(-1, 2.0), "views: expected a whole number from 1 to .*, got -1"),
        (
            lambda: cameras.look_at(PICTURES[0, :, 0, :3], (0.0, 1.0)),
            "target: expected a tuple of 3 numbers, got a tuple",
        ),
        (
            lambda: ImagePlanes(PICTURES, VIEWS),
            r"cameras: expected PinholeCamera, got a hyperplanes.views.Views; pass its .cameras$",
        ),
        (lambda: ImagePlanes(PICTURES, PICTURES), "cameras: expected PinholeCamera, got a tensor of float32"),
        (lambda: FineTuning(optimiser="lion"), "optimiser: expected one of 'adam', 'muon', 'sgd' or None, got 'lion'"),
        (lambda: HyperPlanes.from_pretrained(3), "name: expected Path or str, got 3"),
        (lambda: cameras.orbit(10**30, 2.0), "views: expected a whole number from 1 to .*, got 1000"),
        (lambda: VIEWS.sample_rays(3, among=np.zeros(3)), "among: expected a tensor .* or None, got a numpy.ndarray"),
        (lambda: render(lambda *_: None, VIEWS.cameras), "field: expected a pair of tensors, .*, got None"),
        (lambda: render(int, VIEWS.cameras), "field: expected Callable, got the class int"),
        (lambda: render(field, ring(1, (4, 4)), proposal=HyperPlanes), "proposal: .*, got the class HyperPlanes"),
        (lambda: orbit_cameras(Views, 3), "views: expected Views, got the class Views"),
        (lambda: cameras.look_at(torch.zeros(5, 5)), r"eyes: expected a tensor \(view 3\), got .*, shape \(5, 5\)"),
        (lambda: cameras.orbit(3, 10**30), "distance: expected float, got 1000"),
        (lambda: VIEWS.to("../a"), "device: expected a device such as 'cpu' or 'cuda:0', got '../a'"),
        (lambda: render(field, None), "target: expected PinholeCamera or Rays, got None"),
        (lambda: render(field, ring(1, (4, 4)), chunk=0), "chunk: expected a whole number from 1 to .* or None, got 0"),
        (lambda: HullBlend(nearest=0), "nearest: expected a whole number from 1 to .*, got 0"),
        (lambda: HullBlend(side=1.5), "side: expected a whole number from 1 to 1024, got 1.5"),
        (lambda: render(field, ring(1, (4, 4)), background="white"), "background: expected float, got 'white'"),
    ],
)
def test_arguments_of_another_type_are_named(call, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


def test_sizes_in_an_annotation_are_checked_with_any_batch_dimensions():
    @checked
    def taken(rows: Float[Tensor, "*batch 4 3"]):
        return rows.shape

    for shape in ((4, 3), (2, 4, 3), (5, 2, 4, 3)):
        assert taken(torch.zeros(shape)) == shape
    for shape in ((3,), (), (3, 4), (4, 3, 2)):
        with pytest.raises(ValueError, match="rows: expected a tensor"):
            taken(torch.zeros(shape))


def test_correct_arguments_are_accepted():
    @checked
    def scaled(value: float, times: int = 1, name: str | None = None):
        return value * times

    assert scaled(2, np.int64(3), name="a") == 6
    assert scaled(np.float32(2.0)) == 2
    with pytest.raises(ValueError, match="times: expected int, got True"):
        scaled(1.0, True)


def test_elements_of_tuples_are_checked():
    @checked
    def drawn(sizes: tuple[int, ...], names: tuple[tuple[str, float], ...] = ()):
        return len(sizes)

    assert drawn(()) == 0
    assert drawn((1, 2), (("a", 1), ("b", 0.5))) == 2
    with pytest.raises(ValueError, match=r"^sizes: expected a tuple of int, got a tuple of 1, 2.5$"):
        drawn((1, 2.5))
    with pytest.raises(
        ValueError, match=r"^names: expected a tuple of a tuple of 2 numbers, got a tuple of a tuple of"
    ):
        drawn((), (("a", "b"),))
