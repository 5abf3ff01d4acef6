"""Source of truth: a ball in closed form, written with correct poses and with poses of wrong conventions."""

import json
import math

import numpy as np
import pytest
from PIL import Image
from rendered_here import rendered_here

from data_gen.datasets import inspect as inspecting
from data_gen.datasets.generate import GenerationConfig, Procedural, generate
from data_gen.datasets.inspect import inspect
from hyperplanes.data import DataError
from hyperplanes.data.inspection import picture
from hyperplanes.geometry import cameras as camera

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
CENTRE, RADIUS, SIZE, ANGLE = np.array([0.2, 0.1, 0.0]), 0.5, 32, 0.8


def write(folder, change=lambda pose: pose, alpha=True):
    """Write views of a ball; `change` maps each OpenGL camera-to-world pose to the written one."""
    (folder / "images").mkdir(parents=True)
    focal = SIZE / 2 / math.tan(ANGLE / 2)
    rows, columns = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    rays = np.stack([columns / focal, rows / focal, np.ones_like(rows)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    frames = []
    for index, pose in enumerate(camera.fibonacci_sphere(12, 3.0, lowest=-0.5).double().numpy()):
        to_centre = pose[:3, :3] @ CENTRE + pose[:3, 3]
        hit = (rays @ to_centre) ** 2 - to_centre @ to_centre + RADIUS**2 > 0
        picture = np.where(hit[..., None], np.array([200, 50, 50, 255]), 0).astype(np.uint8)
        name = f"images/{index:02d}.png"
        Image.fromarray(picture if alpha else picture[..., :3]).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": change(np.linalg.inv(pose) @ FLIP).tolist()})
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))
    return folder


@pytest.fixture
def untried(monkeypatch):
    """Omit the trial, which takes most of the time and does not change the report."""
    monkeypatch.setattr(inspecting, "_trial", lambda _: [])


@pytest.fixture
def undrawn(untried, monkeypatch):
    """Omit the trial and the pictures."""
    monkeypatch.setattr(inspecting, "_cameras", lambda *_: b"")
    monkeypatch.setattr(picture, "draw_coverage", lambda *_: b"")


@pytest.mark.usefixtures("untried")
def test_a_correct_data_set_is_described_and_drawn(tmp_path):
    found = inspect(write(tmp_path / "ball"), tmp_path / "out")
    (one,) = found.description.objects
    assert (one.name, one.support, one.query, one.size) == ("ball", 6, 6, (SIZE, SIZE))
    assert one.field_of_view == pytest.approx(math.degrees(ANGLE), rel=1e-5)
    assert one.distance == (pytest.approx(3.0, abs=0.35), pytest.approx(3.0, abs=0.35))
    assert np.allclose(one.extent, 2 * RADIUS, atol=0.35), "the hull is the ball, voxels and pixels rounded up"
    assert one.conventions.consistent
    assert one.conventions.scores["as declared"] > 0.5
    assert not found.has_problems
    sheet = np.array(Image.open(found.files[0]))
    assert sheet.shape[1] > 6 * SIZE
    assert [path.name for path in found.files] == ["contact_sheet.png", "cameras.png", "coverage.png"]
    text = "\n".join(found.lines())
    assert "objects: 1 (1 test)" in text
    assert "conventions: masks agree with the poses" in text
    assert "coverage: " in text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda pose: pose @ FLIP, "in OpenCV axes (y down, z forward), not OpenGL's"),
        (np.linalg.inv, "camera-from-world in OpenGL axes, not its inverse"),
        (lambda pose: np.linalg.inv(pose @ FLIP), "camera-from-world in OpenCV axes, not OpenGL camera-to-world"),
    ],
)
def test_poses_of_wrong_conventions_are_recognised_and_named(tmp_path, change, name):
    found = inspect(write(tmp_path / "ball", change), tmp_path / "out")
    assert found.has_problems
    assert found.description.objects[0].conventions.best == name
    assert not any(line.startswith("expect: good") for line in found.lines())
    assert f"if the poses are {name}" in "\n".join(found.lines())


@pytest.mark.usefixtures("undrawn")
def test_without_masks_the_report_says_that_nothing_was_checked(tmp_path):
    found = inspect(write(tmp_path / "ball", alpha=False), tmp_path / "out")
    assert not found.has_problems
    assert "conventions: not checked, there are no masks, and only 0 corners could be matched" in found.lines()


@pytest.mark.usefixtures("undrawn")
def test_an_unreadable_object_is_listed_and_the_others_are_inspected(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / "set" / name)
    (tmp_path / "set/a/images/03.png").write_bytes(b"")
    found = inspect(tmp_path / "set", tmp_path / "out")
    assert [one.name for one in found.description.objects] == ["b"]
    assert found.description.broken[0][0] == "a"
    assert found.has_problems
    with pytest.raises(DataError):
        inspect(tmp_path / "nothing", tmp_path / "out")


@pytest.mark.usefixtures("undrawn")
def test_objects_of_all_splits_are_inspected(tmp_path):
    """Each object is one row of the contact sheet, with 3 support views of 32 pixels."""
    for index in range(7):
        folder = write(tmp_path / f"set/o{index}")
        document = json.loads((folder / "transforms.json").read_text())
        document["frames"] = document["frames"][:6]
        (folder / "transforms.json").write_text(json.dumps(document))
    found = inspect(tmp_path / "set", tmp_path / "out", 4)
    assert [one.name for one in found.description.objects] == ["o0", "o2", "o4", "o6"]
    height, width = np.array(Image.open(found.files[0])).shape[:2]
    assert 3 * SIZE < width < 4 * SIZE
    assert 4 * SIZE < height


@pytest.mark.usefixtures("undrawn")
def test_an_empty_hull_is_not_reported_as_missing_masks(tmp_path):
    folder = write(tmp_path / "ball")
    document = json.loads((folder / "transforms.json").read_text())
    document["scene_sphere"] = {"centre": [-0.8, 0.1, 0.0], "radius": 0.1}
    (folder / "transforms.json").write_text(json.dumps(document))
    text = "\n".join(inspect(folder, tmp_path / "out").lines())
    assert "visual hull: empty" in text
    assert "masks: none" not in text


@pytest.mark.usefixtures("undrawn")
def test_checks_that_need_more_than_two_views_report_no_problem(tmp_path):
    """With one support view, no point is nearest to its axis, and hulls at any distance have the mask as silhouette."""
    with rendered_here():
        generate(Procedural("car", 2), tmp_path / "cars", GenerationConfig(views=2, resolution=32, workers=1))
    found = inspect(tmp_path / "cars", tmp_path / "out")
    text = "\n".join(found.lines())
    assert not found.has_problems, text
    assert "look at one place" not in text
    assert "conventions: not checked, fewer than 3 views are too few to compare masks" in text
    assert "there are no masks" not in text


def test_inspecting_no_object_is_refused(tmp_path):
    with pytest.raises(ValueError, match="objects: expected at least 1 to look at, got 0"):
        inspect(write(tmp_path / "ball"), tmp_path / "out", 0)
