"""Source of truth: areas of polygons by the shoelace formula. Triangles have the orientation of their polygon."""

import numpy as np
import pytest
from mesh_writers import dae_text

from data_gen.meshes.mesh import MeshError, load_mesh, mesh_parts
from data_gen.meshes.triangulate import triangulate

U = np.array([[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]], dtype=float)
DART = np.array([[0, 0], [2, 1], [0, 2], [0.6, 1]], dtype=float)
KEYHOLE = np.array(  # a square with a square hole, joined by a bridge of two edges
    [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0], [1, 1], [1, 3], [3, 3], [3, 1], [1, 1]], dtype=float
)


def shoelace(polygon):
    x, y = polygon.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


@pytest.mark.parametrize("polygon", [U, DART, KEYHOLE], ids=["U", "dart", "keyhole"])
@pytest.mark.parametrize("plane", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_a_polygon_is_covered_once_for_any_first_corner(polygon, plane):
    if polygon is not KEYHOLE:
        polygon = np.roll(polygon, 3, axis=0)
    for turned in (polygon, polygon[::-1]):
        points = np.zeros((len(turned), 3))
        points[:, plane[:2]] = turned
        triangles = points[triangulate(points)]
        areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, plane[2]] / 2
        sign = 1 if plane in ((0, 1, 2), (2, 0, 1), (1, 2, 0)) else -1
        assert areas.sum() * sign == pytest.approx(shoelace(turned))
        assert np.abs(areas).sum() == pytest.approx(abs(shoelace(turned)))


def area_in_file(mesh):
    scale = np.linalg.det(mesh.world_from_file[:3, :3]) ** (2 / 3)
    return sum(part.area for part in mesh_parts(mesh)) / scale


def write(folder, kind, faces=(range(8),)):
    """Write faces whose corners are those of U, by default U itself. COLLADA files always have U alone."""
    points = "".join(f"{x} {y} 0\n" for x, y in U)
    rows = "".join(" ".join(map(str, (len(face), *face))) + "\n" for face in faces)
    path = folder / f"a.{kind}"
    if kind == "obj":
        lines = [f"v {point}" for point in points.splitlines()]
        lines += [" ".join(["f", *(str(corner + 1) for corner in face)]) for face in faces]
        path.write_text("\n".join(lines) + "\n")
    elif kind == "off":
        path.write_text(f"OFF\n8 {len(faces)} 0\n{points}{rows}")
    elif kind == "ply":
        head = "ply\nformat ascii 1.0\nelement vertex 8\n" + "".join(f"property float {axis}\n" for axis in "xyz")
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        path.write_text(head + points + rows)
    else:
        text = dae_text(positions=[[*point, 0] for point in U]).replace('count="12"', 'count="24"')
        text = text.replace('<accessor source="#pa" count="4"', '<accessor source="#pa" count="8"')
        start, end = text.index("<triangles"), text.index("</triangles>") + len("</triangles>")
        tag = kind.partition(".")[0]
        counts = "<vcount>8</vcount>" if tag == "polylist" else ""
        body = f'<{tag} count="1" material="s"><input semantic="VERTEX" source="#v" offset="0"/>{counts}'
        path = folder / "a.dae"
        path.write_text(text[:start] + body + f"<p>0 1 2 3 4 5 6 7</p></{tag}>" + text[end:])
    return path


@pytest.mark.parametrize("kind", ["obj", "off", "ply", "polylist.dae", "polygons.dae"])
def test_concave_polygons_of_every_format_are_not_filled(tmp_path, kind):
    mesh = load_mesh(write(tmp_path, kind))
    assert mesh.warnings == ()
    assert area_in_file(mesh) == pytest.approx(7.0, rel=1e-5)


@pytest.mark.parametrize("kind", ["obj", "off", "ply"])
@pytest.mark.parametrize("corners", [3, 4])
def test_faces_of_two_corners_are_left_out_with_a_warning(tmp_path, kind, corners):
    mesh = load_mesh(write(tmp_path, kind, [range(corners), (0, 1)]))
    assert mesh.face_count == corners - 2
    assert "1 faces with fewer than 3 corners left out" in mesh.warnings
    with pytest.raises(MeshError, match="found none"):
        load_mesh(write(tmp_path, kind, [(0, 1)]))


def test_quadrilaterals_of_a_ply_keep_their_colours(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 6\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element face 2\nproperty list uchar int vertex_indices\n"
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    points = "0 0 0\n1 0 0\n2 0 0\n0 1 0\n1 1 0\n2 1 0\n"
    (tmp_path / "a.ply").write_text(head + points + "4 0 1 4 3 255 0 0\n4 1 2 5 4 0 0 255\n")
    (part,) = mesh_parts(load_mesh(tmp_path / "a.ply"))
    left = part.triangles_center[:, 0] < 0
    assert part.visual.face_colors[left].tolist() == [[255, 0, 0, 255]] * 2
    assert part.visual.face_colors[~left].tolist() == [[0, 0, 255, 255]] * 2


def test_coordinates_without_a_texture_leave_the_default_colour(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(
        f"property float {axis}\n" for axis in ("x", "y", "z", "s", "t")
    )
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(head + "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n")
    (part,) = mesh_parts(load_mesh(tmp_path / "a.ply"))
    assert part.visual.material.baseColorFactor.tolist() == [153, 153, 153, 255]
