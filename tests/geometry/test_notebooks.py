"""Source of truth: Pillow decodes the pictures in the HTML; one line states their number."""

import base64
import io
import re
from xml.etree import ElementTree

import numpy as np
import torch
from PIL import Image

from hyperplanes.geometry import ImagePlanes
from hyperplanes.views import Task
from tests.reference_rendering import ball_views, ring, small_model


def pictures(html):
    """The decoded pictures of HTML that is well-formed except for its void tags."""
    ElementTree.fromstring(re.sub(r"<(img [^>]*|br)>", r"<\1/>", html))
    found = re.findall(r"data:image/png;base64,([^\"]+)", html)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(each)))) for each in found]


def test_views_show_their_pictures_and_number():
    views = ball_views(ring(3))
    assert repr(views) == "Views(3 of 16x16, masks)"
    shown = pictures(views._repr_html_())
    expected = (views.images * 255).round().byte().permute(0, 2, 3, 1).numpy()
    assert all(np.array_equal(one, other) for one, other in zip(shown, expected, strict=True))
    assert views._repr_html_().count("<line") == 3
    assert "and 3 more" in ball_views(ring(15))._repr_html_()


def test_tasks_planes_and_fields_show_a_line_and_pictures():
    views = ball_views(ring(4))
    task = Task(views, views[:2], "<ball>")
    assert repr(task) == "Task('<ball>', support=Views(4 of 16x16, masks), query=Views(2 of 16x16, masks))"
    assert "&lt;ball&gt;" in task._repr_html_()
    planes = ImagePlanes(views.images, views.cameras)
    assert repr(planes) == "ImagePlanes(4 of 16x16, 3 channels, cpu)"
    assert len(pictures(planes._repr_html_())) == 4
    assert pictures(ImagePlanes(views.images[:, :0], views.cameras)._repr_html_()) == []
    field = small_model().adapt(views)
    assert repr(field).startswith("AdaptedField(MLPField(PointMultiPlaneNeRF, ")
    assert len(repr(field)) < 200
    assert len(pictures(field._repr_html_())) == 4
    assert torch.is_grad_enabled()
