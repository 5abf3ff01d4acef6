"""Source of truth: the OBJ and MTL formats (Wavefront, appendix B1), for files of a few lines."""

import io

import numpy as np
import PIL.Image
import pytest
import trimesh
from mesh_writers import OBJ_FACES, OBJ_SOLID, picture, write_obj

from data_gen.meshes import model_folder
from data_gen.meshes.formats.mtl import MAX_LIBRARIES
from data_gen.meshes.mesh import MeshError, load_mesh, mesh_parts

PAINT = "newmtl paint\nKd 1 0 0\n"


def only_part(mesh):
    (part,) = mesh_parts(mesh)
    return part


def cube(*, groups, uv=False):
    """A cube of six quadrilaterals, with one smoothing group or six, and with or without texture seams at each edge."""
    box = trimesh.creation.box()
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"vt {u} {v}" for u in (0, 1) for v in (0, 1)]
    lines += ["usemtl paint"]
    for number, (a, b, c) in enumerate(box.faces):
        face = [
            f"{index + 1}/{column + 1 + number % 2}" if uv else f"{index + 1}" for column, index in enumerate((a, b, c))
        ]
        group = int(np.abs(box.face_normals[number]).argmax() * 2 + (box.face_normals[number].sum() > 0))
        lines += [f"s {group + 1 if groups else 1}", "f " + " ".join(face)]
    return "\n".join(lines) + "\n"


def test_errors_name_the_first_line_of_a_continued_statement(tmp_path):
    for body, line in (("f 1 2 \\\n3\nf 1 2 x\n", 3), ("f 1 2 \\\nx\n", 1), ("v 0 \\\n\\\n0 0\nf 1 2 3\nv 0 x 0\n", 5)):
        with pytest.raises(MeshError, match=f"line {len(OBJ_SOLID.splitlines()) + line}: "):
            load_mesh(write_obj(tmp_path, body=OBJ_SOLID + body))


def test_normals_are_not_smoothed_across_smoothing_groups(tmp_path):
    def against_faces(body):
        part = only_part(load_mesh(write_obj(tmp_path, mtl=PAINT, body=body)))
        normals = part.vertex_normals[part.faces]
        return np.einsum("fci,fi->fc", normals, part.face_normals).min()

    assert against_faces(cube(groups=True)) == pytest.approx(1.0)
    assert against_faces(cube(groups=False)) < 0.9
    assert against_faces(cube(groups=True, uv=True)) == pytest.approx(1.0)


def test_normals_are_smoothed_across_texture_seams(tmp_path):
    """A ball with separate texture coordinates for each face is shaded as one without a texture."""
    ball = trimesh.creation.icosphere(2)
    rows = "".join(f"v {x} {y} {z}\n" for x, y, z in ball.vertices)
    rows += "".join(f"vt {index % 7} {index % 5}\n" for index in range(3 * len(ball.faces))) + "usemtl paint\n"
    faces = [
        [f"{v + 1}/{3 * row + column + 1}" for column, v in enumerate(face)] for row, face in enumerate(ball.faces)
    ]
    mesh = load_mesh(write_obj(tmp_path, mtl=PAINT, body=rows + "".join(f"f {' '.join(face)}\n" for face in faces)))
    (part,) = mesh_parts(mesh)
    assert part.metadata["smooth"]
    outward = part.vertices / np.linalg.norm(part.vertices, axis=1, keepdims=True)
    assert (part.vertex_normals * outward).sum(axis=1).min() > 0.999


@pytest.mark.parametrize(
    ("newline", "encoding"), [("\r", "utf-8"), ("\r\n", "utf-16"), ("\n", "utf-16-be"), ("\r", "latin-1")]
)
def test_line_endings_and_encodings_of_any_system_are_read(tmp_path, newline, encoding):
    text = "mtllib mesh.mtl\n# Möbel\n" + OBJ_SOLID + "usemtl größe\n" + OBJ_FACES
    mark = b"\xfe\xff" if encoding == "utf-16-be" else b""
    (tmp_path / "a.obj").write_bytes(mark + text.replace("\n", newline).encode(encoding))
    (tmp_path / "mesh.mtl").write_bytes(mark + f"newmtl größe{newline}Kd 1 0 0{newline}".encode(encoding))
    mesh = load_mesh(tmp_path / "a.obj")
    assert mesh.warnings == ()
    assert only_part(mesh).visual.material.baseColorFactor.tolist() == [255, 0, 0, 255]


def test_options_of_a_texture_move_and_scale_it(tmp_path):
    path = write_obj(tmp_path, mtl=PAINT + "map_Kd -clamp on -s 2 3 1 -o 0.5 0.25 0 wood.png\n", texture=picture())
    part = only_part(load_mesh(path))
    (tmp_path / "plain").mkdir()
    plain = only_part(load_mesh(write_obj(tmp_path / "plain", mtl=PAINT + "map_Kd wood.png\n", texture=picture())))
    assert np.allclose(part.visual.uv, plain.visual.uv * [2, 3] + [0.5, 0.25])
    assert part.visual.material.wrap == ("clamp", "clamp")
    assert plain.visual.material.wrap == ("repeat", "repeat")


def test_an_emission_map_is_used_and_a_missing_one_leaves_no_emission(tmp_path):
    mtl = PAINT + "Ke 1 0.5 0\nmap_Ke glow.png\n"
    mesh = load_mesh(write_obj(tmp_path, mtl=mtl))
    assert mesh.warnings == ("material 'paint': drawn without its glow and its map glow.png (not found)",)
    assert only_part(mesh).visual.material.emissiveFactor is None
    (tmp_path / "glow.png").write_bytes(picture(colour=(9, 8, 7)))
    material = only_part(load_mesh(tmp_path / "mesh.obj")).visual.material
    assert material.emissiveTexture.getpixel((0, 0)) == (9, 8, 7)
    np.testing.assert_allclose(material.emissiveFactor, [1, 0.21404, 0], atol=1e-5)  # 0.5 is sRGB


@pytest.mark.parametrize("name", ["/srv/art/gone.png", "C:\\art\\gone.png"])
def test_an_absolute_path_without_its_file_draws_the_plain_colour(tmp_path, name):
    mesh = load_mesh(write_obj(tmp_path, mtl=PAINT + f"map_Kd {name}\n"))
    assert mesh.warnings == (f"material 'paint': drawn without its texture {name} (absolute path not followed)",)
    assert only_part(mesh).visual.material.baseColorFactor.tolist() == [255, 0, 0, 255]


@pytest.mark.parametrize("page", ["latin-1", "cp437", "cp932"])
def test_textures_are_found_for_names_in_any_code_page(tmp_path, page):
    name = "椅子.png" if page == "cp932" else "Möbel.png"
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / name).write_bytes(picture(colour=(5, 6, 7)))
    path = write_obj(tmp_path, mtl=PAINT)
    (tmp_path / "mesh.mtl").write_bytes(f"newmtl paint\nmap_Kd {name}\n".encode(page))
    mesh = load_mesh(path)
    assert only_part(mesh).visual.material.baseColorTexture.getpixel((0, 0)) == (5, 6, 7)
    assert mesh.lost_files == ()


def test_comments_after_statements_are_ignored(tmp_path):
    body = OBJ_SOLID + "s off # flat\nusemtl paint # red\n" + OBJ_FACES.replace("\n", " # a face\n")
    path = write_obj(tmp_path, body="mtllib mesh.mtl # materials\n" + body, texture=picture(colour=(5, 6, 7)))
    (tmp_path / "mesh.mtl").write_text("newmtl paint # red\nKd 0.5 # grey\nmap_Kd wood.png # oak\n")
    mesh = load_mesh(path)
    assert mesh.warnings == ()
    part = only_part(mesh)
    assert part.visual.material.baseColorTexture.getpixel((0, 0)) == (5, 6, 7)
    assert not part.metadata["smooth"]


@pytest.mark.parametrize(
    ("used", "defined", "red"),
    [
        ("paint # a", "paint", True),
        ("paint", "paint # b", True),
        ("paint # a", "paint # b", True),
        ("Material #25", "Material #26\nnewmtl Material #25\nKd 1 0 0", True),
        ("Material #27", "Material #26\nnewmtl Material #25\nKd 1 0 0", False),
    ],
)
def test_a_name_may_contain_the_sign_of_a_comment(tmp_path, used, defined, red):
    mtl = "newmtl " + defined + ("\nKd 1 0 0\n" if "Kd" not in defined else "\n")
    mesh = load_mesh(write_obj(tmp_path, mtl=mtl, body=OBJ_SOLID + f"usemtl {used}\n" + OBJ_FACES))
    assert (only_part(mesh).visual.material.baseColorFactor.tolist() == [255, 0, 0, 255]) == red
    assert mesh.warnings == (() if red else (f"material {used!r} is defined nowhere; drawn grey",))


def test_vertices_of_lines_are_not_a_sign_of_a_cut_file(tmp_path):
    body = OBJ_SOLID + "v 2 2 2\nv 3 3 3\n" + OBJ_FACES + "l 5 6\n"
    assert load_mesh(write_obj(tmp_path, body=body)).warnings == ("1 lines left out, only faces are drawn",)


def test_a_mesh_that_is_too_large_is_refused_at_once(tmp_path, monkeypatch):
    body = OBJ_SOLID + OBJ_FACES
    libraries = "".join(f"mtllib {index}.mtl\n" for index in range(MAX_LIBRARIES + 1))
    with pytest.raises(MeshError, match=f"at most {MAX_LIBRARIES} material libraries, found {MAX_LIBRARIES + 1}"):
        load_mesh(write_obj(tmp_path, body=libraries + body))
    assert load_mesh(write_obj(tmp_path, body="mtllib gone.mtl\n" * 10**5 + body)).lost_files == ("gone.mtl",)
    monkeypatch.setattr(model_folder, "MAX_REFERENCES", 50)
    mtl = PAINT + "".join(f"newmtl m{index}\nmap_Kd {index}.png\n" for index in range(51))
    with pytest.raises(MeshError, match="at most 50 references"):
        load_mesh(write_obj(tmp_path, mtl=mtl))


def test_emission_maps_may_have_any_mode(tmp_path):
    stream = io.BytesIO()
    PIL.Image.new("P", (2, 2)).save(stream, "PNG")
    (tmp_path / "glow.png").write_bytes(stream.getvalue())
    assert load_mesh(write_obj(tmp_path, mtl=PAINT + "map_Ke glow.png\n")).warnings == ()
