"""Source of truth: the same object, drawn without the faces that face away from the camera (culled).

Nearly all faces of ShapeNet's models exist twice; the second one is reversed and has another colour.
"""

import numpy as np
import pytest
import trimesh

from data_gen import rigs
from data_gen.meshes.mesh import load_mesh, mesh_parts
from data_gen.rendering.mesh_renderer import MeshRenderer
from data_gen.rendering.renderers import probe
from data_gen.rigs import Rig
from data_gen.shapes import make


@pytest.fixture(params=["pyrender-egl", "embree"])
def backend(request):
    if not probe(request.param).works:
        pytest.skip(f"{request.param} does not work here")
    return request.param


def _painted(corners, colour):
    """A mesh of triangles (face, 3, 3) in one colour."""
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=np.tile(colour, (3 * len(corners), 1)))
    return mesh


def _chair():
    scene = make("chair", 3)
    return np.concatenate([part.vertices[part.faces] for part in scene.geometry.values()])


def _grid():
    """A slanted sheet: (its triangles, the same quadrilaterals divided along the other diagonal)."""
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.8, 0.8, 9))
    points = np.stack((x, y, 0.3 * x + 0.1 * y), -1)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    return tuple(np.stack(cut, -2).reshape(-1, 3, 3) for cut in ((a, b, c, a, c, d), (a, b, d, b, c, d)))


def _doubled(kind):
    """Front and back triangles of an object."""
    if kind == "other diagonals":
        one, other = _grid()
        return one, other[:, ::-1]
    front = _chair()
    back = front[:, ::-1].copy()
    if kind == "nearly":
        back += np.random.default_rng(0).uniform(-2e-6, 2e-6, (len(back), 1, 3))
    return front, back


def _culled(corners, eye):
    facets = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners[np.einsum("fi,fi->f", facets, eye - corners[:, 0]) > 0]


@pytest.mark.parametrize("kind", ["exactly", "nearly", "other diagonals"])
def test_of_coincident_faces_the_one_that_faces_the_camera_is_visible(backend, kind):
    colours = [(200, 40, 40, 255), (40, 60, 220, 255)]
    sides = _doubled(kind)
    rig = rigs.fixed(6, 64)
    renderer = MeshRenderer(backend)
    parts = [_painted(side, colour) for side, colour in zip(sides, colours, strict=True)]
    found = renderer.render(parts, rig).rgba.astype(int)
    off = 0.0
    for view, pose in enumerate(rig.world_from_camera):
        one = Rig(pose[None], rig.intrinsics[view], 64, 64, rig.near, rig.far)
        kept = [(_culled(side, pose[:3, 3]), colour) for side, colour in zip(sides, colours, strict=True)]
        parts = [_painted(corners, colour) for corners, colour in kept if len(corners)]
        expected = renderer.render(parts, one).rgba[0].astype(int)
        seen = (expected[..., 3] > 0) | (found[view, ..., 3] > 0)
        wrong = (np.abs(expected - found[view]) > 25).any(axis=-1)
        off = max(off, wrong.sum() / seen.sum())
    assert off < 0.002


def test_doubled_glass_is_blended_once(backend):
    pane = np.array([[[-1, -1, 0], [1, -1, 0], [0, 1, 0]]], dtype=float)
    rig = rigs.orbit(2, 16, elevation=0.0)
    parts = [_painted(side, (250, 250, 250, 102)) for side in (pane, pane[:, ::-1])]
    alpha = MeshRenderer(backend).render(parts, rig).rgba[:, 8, 8, 3]
    np.testing.assert_allclose(alpha, 102, atol=1)


def test_a_smooth_ball_with_doubled_faces_is_shaded_as_one_without(tmp_path):
    """The vertex normals of a face and its reversed copy cancel if they share their vertices."""
    ball = trimesh.creation.icosphere(2)
    rows = "".join(f"v {x} {y} {z}\n" for x, y, z in ball.vertices) + "s 1\n"
    pictures = []
    for name, faces in (("one.obj", ball.faces), ("two.obj", np.concatenate((ball.faces, ball.faces[:, ::-1])))):
        (tmp_path / name).write_text(rows + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces))
        pictures.append(MeshRenderer("embree").render(mesh_parts(load_mesh(tmp_path / name)), rigs.fixed(1, 48)).rgba)
    assert np.array_equal(*pictures)


def test_a_face_without_a_copy_is_visible_from_both_sides(backend):
    """A red sheet is 1/500 of the radius behind a blue wall. From the back, the sheet is in front."""
    sheet = np.array([[[-0.5, -0.5, 0], [0.5, -0.5, 0], [0, 0.5, 0]]])
    wall = 2 * sheet + [0, 0, 0.002]
    rig = rigs.orbit(2, 32, elevation=0.0)
    parts = [_painted(sheet, (220, 30, 30, 255)), _painted(wall, (30, 30, 220, 255))]
    front, back = MeshRenderer(backend).render(parts, rig).rgba[:, 15, 16]
    assert front[2] > front[0]
    assert back[0] > back[2]
