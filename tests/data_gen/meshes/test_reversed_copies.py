"""Source of truth: the same object without the part that should be invisible.

A part that is wound inwards is the inner side of another part where it lies on it, and an outline where it is one-sided
and stands around others.
"""

import numpy as np
import pytest
import trimesh
from mesh_writers import glb_bytes, gltf

from data_gen import rigs
from data_gen.meshes.mesh import load_mesh, mesh_parts
from data_gen.rendering.mesh_renderer import MeshRenderer
from data_gen.rendering.renderers import probe


@pytest.fixture(params=["pyrender-egl", "embree"])
def backend(request):
    if not probe(request.param).works:
        pytest.skip(f"{request.param} does not work here")
    return request.param


def draw(backend, mesh, size=64):
    return MeshRenderer(backend).render(mesh_parts(mesh), rigs.fixed(4, size)).rgba.astype(int)


def write_obj(path, parts):
    """Write an OBJ with one material per part: (corners, faces, colour)."""
    lines, start = ["mtllib a.mtl"], 1
    for name, (points, faces, _) in enumerate(parts):
        lines += [f"v {x} {y} {z}" for x, y, z in points]
        lines += [f"usemtl m{name}", "s 1"] + [f"f {a + start} {b + start} {c + start}" for a, b, c in faces]
        start += len(points)
    path.write_text("\n".join(lines) + "\n")
    (path.parent / "a.mtl").write_text("".join(f"newmtl m{name}\nKd {part[2]}\n" for name, part in enumerate(parts)))


def test_the_reversed_copy_of_a_solid_is_its_inner_side(tmp_path, backend):
    ball = trimesh.creation.icosphere(2)
    outer = (ball.vertices, ball.faces, "0.8 0.1 0.1")
    write_obj(tmp_path / "one.obj", [outer])
    write_obj(tmp_path / "two.obj", [outer, (ball.vertices, ball.faces[:, ::-1], "0.1 0.1 0.8")])
    one, two = load_mesh(tmp_path / "one.obj"), load_mesh(tmp_path / "two.obj")
    assert two.warnings == ()
    wrong = (np.abs(draw(backend, one) - draw(backend, two)) > 25).any(axis=-1)
    assert wrong.mean() < 0.001


def test_a_solid_alone_or_next_to_others_is_oriented_outwards(tmp_path):
    ball = trimesh.creation.icosphere(1)
    inward = (ball.vertices, ball.faces[:, ::-1], "0.1 0.1 0.8")
    write_obj(tmp_path / "a.obj", [inward, (ball.vertices + [5, 0, 0], ball.faces, "1 0 0")])
    assert load_mesh(tmp_path / "a.obj").warnings == ("m0: wound inside out, its faces are turned",)


def outlined(folder, one_sided):
    """A red ball in a black hull with faces that are oriented inwards."""
    ball = trimesh.creation.icosphere(2)
    count = len(ball.vertices)
    header, buffer = gltf(
        positions=np.concatenate((ball.vertices, 1.06 * ball.vertices)),
        faces=np.concatenate((ball.faces, ball.faces[:, ::-1] + count)),
    )
    indices = header["accessors"][1]
    header["accessors"] += [
        indices | {"count": 3 * len(ball.faces), "byteOffset": at * 12 * len(ball.faces)} for at in (0, 1)
    ]
    primitive = header["meshes"][0]["primitives"][0]
    header["meshes"][0]["primitives"] = [primitive | {"indices": 2 + at, "material": at} for at in (0, 1)]
    header["materials"] = [
        {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1], "metallicFactor": 0}},
        {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "doubleSided": not one_sided},
    ]
    (folder / "a.glb").write_bytes(glb_bytes(header, buffer))
    return load_mesh(folder / "a.glb")


def test_a_one_sided_hull_is_an_outline_and_a_double_sided_one_hides_its_inside(tmp_path, backend):
    picture = draw(backend, outlined(tmp_path, True))[0]
    assert picture[32, 32, 0] > 150
    assert picture[32, 32, 2] < 60
    edge = picture[32, np.flatnonzero(picture[32, :, 3] == 255)[0]]
    assert edge[:3].max() < 60
    assert draw(backend, outlined(tmp_path, False))[0, 32, 32, :3].max() < 60


def test_inner_sides_of_one_sided_surfaces_are_drawn_before_the_background(tmp_path, backend):
    """With a hole in the mask of one view, carving would remove the surface that other views show."""
    sheet = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], dtype=np.float32)
    (tmp_path / "a.glb").write_bytes(glb_bytes(*gltf(positions=sheet, faces=[[0, 1, 2]])))
    rig = rigs.orbit(2, 32, elevation=0.0)
    views = MeshRenderer(backend).render(mesh_parts(load_mesh(tmp_path / "a.glb")), rig).rgba
    assert (views[:, 16, 16, 3] == 255).all()
