"""Source of truth: files written byte by byte with one difficulty each, and the stated outcome.

Each file is drawn correctly, drawn with a warning that names what was lost, or refused with a reason.
"""

import base64
import io
import os
import struct

import numpy as np
import PIL.Image
import pytest
import trimesh
from mesh_writers import (
    OBJ_FACES,
    OBJ_SOLID,
    SQUARE_UV,
    TETRAHEDRON,
    TETRAHEDRON_FACES,
    dae_text,
    glb_bytes,
    gltf,
    off_text,
    picture,
    ply_bytes,
    stl_bytes,
    write_glb,
    write_gltf,
    write_obj,
)

from data_gen.meshes import files, model_folder
from data_gen.meshes.materials import LINEAR_COLOUR
from data_gen.meshes.mesh import MeshError, load_mesh, mesh_parts, prepare_scene
from data_gen.rendering.mesh_renderer import MeshRenderer
from data_gen.rigs import fixed

PAINT = "newmtl paint\nKd 1 0 0\n"
WOOD = PAINT + "map_Kd wood.png\n"


def only_part(mesh):
    (part,) = mesh_parts(mesh)
    return part


def warning(mesh):
    """The only warning of a mesh."""
    (line,) = mesh.warnings
    return line


def refusal(path, **keywords):
    """The error message for a mesh: one line that begins with the name of the file."""
    with pytest.raises(MeshError) as caught:
        load_mesh(path, **keywords)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert "expected" in message
    assert "found" in message
    return message


def outwards(part):
    """The volume by the divergence theorem, which is positive if the faces are oriented outwards."""
    return float(np.einsum("ij,ij->", part.triangles[:, 0], np.cross(part.triangles[:, 1], part.triangles[:, 2])) / 6)


# --- transforms ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [[-1, 1, 1], [1, -2, 1], [-1, -1, -1]])
def test_faces_and_normals_of_mirrored_nodes_stay_oriented_outwards(tmp_path, scale):
    away = TETRAHEDRON - 0.25
    path = write_glb(tmp_path / "a.glb", positions=TETRAHEDRON, normals=away, nodes=[{"mesh": 0, "scale": scale}])
    mesh = load_mesh(path)
    part = only_part(mesh)
    assert mesh.warnings == ()
    assert outwards(part) > 0
    assert ((part.vertex_normals * (part.vertices - part.vertices.mean(axis=0))).sum(axis=1) > 0).all()
    assert np.linalg.det(mesh.world_from_file[:3, :3]) > 0


def test_nodes_with_zero_scale_or_values_that_are_not_finite(tmp_path):
    nodes = [{"mesh": 0}, {"mesh": 0, "scale": [0, 0, 0]}]
    mesh = load_mesh(write_glb(tmp_path / "a.glb", nodes=nodes))
    assert mesh.face_count == 4
    assert "4 of 4 faces without area left out" in warning(mesh)
    nodes[1] = {"mesh": 0, "matrix": [float("nan")] * 16}
    assert "transform is not finite" in warning(load_mesh(write_glb(tmp_path / "b.glb", nodes=nodes)))


# --- textures -----------------------------------------------------------------------------------------------------


def test_grey_textures_with_alpha_become_rgba(tmp_path):
    path = write_obj(tmp_path, mtl=WOOD + "map_d wood.png\n", texture=picture("LA", colour=(50, 200)))
    image = only_part(load_mesh(path)).visual.material.baseColorTexture
    assert (image.mode, image.getpixel((0, 0))) == ("RGBA", (50, 50, 50, 200))


def test_the_opacity_of_an_obj_comes_only_from_map_d_and_d(tmp_path):
    """As in Blender, since alpha channels of textures often have another meaning."""
    (tmp_path / "mask.png").write_bytes(picture("L", size=(8, 8), colour=64))

    def texel(mtl):
        mesh = load_mesh(write_obj(tmp_path, mtl=mtl, texture=picture("RGBA", colour=(50, 60, 70, 0))))
        material = only_part(mesh).visual.material
        return material.baseColorTexture.getpixel((0, 0)), material.baseColorFactor.tolist(), mesh.warnings

    white, red = [255, 255, 255, 255], [255, 0, 0, 255]
    assert texel(WOOD) == ((50, 60, 70), white, ())
    assert texel(WOOD + "map_d mask.png\n") == ((50, 60, 70, 64), white, ())
    assert texel(WOOD + "map_d mask.png\nd 0.6\n")[1] == [255, 255, 255, 153]
    assert texel(PAINT + "map_d mask.png\n") == ((255, 255, 255, 64), red, ())
    lines = load_mesh(write_obj(tmp_path, mtl=WOOD + "map_d gone.png\n", texture=picture())).warnings
    assert lines == ("material 'paint': drawn without its opacity map gone.png (not found)",)


@pytest.mark.parametrize(
    ("mode", "colour", "expected"),
    [
        ("L", 7, (7, 7, 7)),
        ("1", 1, (255, 255, 255)),
        ("P", 0, (0, 0, 0)),
        ("I;16", 65535, (255, 255, 255)),
        ("RGBA", (1, 2, 3, 4), (1, 2, 3)),
    ],
)
def test_textures_of_every_kind_become_8_bit_colours(tmp_path, mode, colour, expected):
    path = write_obj(tmp_path, mtl=WOOD, texture=picture(mode, colour=colour))
    mesh = load_mesh(path)
    assert mesh.warnings == ()
    assert only_part(mesh).visual.material.baseColorTexture.getpixel((0, 0)) == expected


def test_a_texture_without_coordinates_is_drawn_in_its_mean_colour(tmp_path):
    path = write_obj(
        tmp_path, mtl=WOOD, texture=picture(colour=(188, 0, 255)), body=OBJ_SOLID + "usemtl paint\nf 1 2 3\n"
    )
    mesh = load_mesh(path)
    assert "texture without texture coordinates; its mean colour taken" in "; ".join(mesh.warnings)
    material = only_part(mesh).visual.material
    assert material.baseColorTexture is None
    assert material.baseColorFactor.tolist() == [128, 0, 255, 255]
    glb = load_mesh(write_glb(tmp_path / "a.glb", image=picture(colour=(188, 0, 255))))
    assert "its mean colour taken" in warning(glb)


def test_texture_coordinates_that_are_missing_or_not_finite_are_counted(tmp_path):
    body = OBJ_SOLID + "usemtl paint\nf 1/1 3/3 2/2\nf 1 2 4\n"
    mesh = load_mesh(write_obj(tmp_path, mtl=WOOD, texture=picture(), body=body))
    assert warning(mesh) == "paint: 3 of 6 corners have no texture coordinates; (0, 0) taken"
    uv = SQUARE_UV.copy()
    uv[1] = np.nan
    mesh = load_mesh(write_glb(tmp_path / "a.glb", uv=uv, image=picture()))
    assert warning(mesh) == "solid: 1 texture coordinates are not finite; set to 0"


def test_alpha_is_used_only_with_an_alpha_mode_of_the_material(tmp_path):
    clear = picture("RGBA", colour=(9, 9, 9, 0))
    opaque = only_part(load_mesh(write_glb(tmp_path / "a.glb", uv=SQUARE_UV, image=clear))).visual.material
    assert (opaque.baseColorTexture.mode, opaque.baseColorFactor[3]) == ("RGB", 255)
    half = picture("RGBA", colour=(9, 9, 9, 128))
    path = write_glb(tmp_path / "b.glb", uv=SQUARE_UV, image=half, material={"alphaMode": "BLEND"})
    assert only_part(load_mesh(path)).visual.material.baseColorTexture.getpixel((0, 0)) == (9, 9, 9, 128)


@pytest.mark.parametrize(
    ("mode", "factor", "alpha"), [("BLEND", 0.0, None), ("BLEND", 1.0, 0), ("MASK", 0.4, None), ("MASK", 1.0, 100)]
)
def test_fully_transparent_parts_are_omitted_by_name_and_refused_if_alone(tmp_path, mode, factor, alpha):
    material = {"alphaMode": mode, "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, factor]}}
    image = None if alpha is None else picture("RGBA", colour=(9, 9, 9, alpha))
    path = write_glb(tmp_path / "a.glb", uv=SQUARE_UV, material=material, image=image)
    assert "solid: fully transparent, left out" in refusal(path)


def test_an_invisible_material_of_an_obj_is_named(tmp_path):
    body = OBJ_SOLID + "usemtl air\nf 1 3 2\nusemtl paint\nf 1 2 4\n"
    mesh = load_mesh(write_obj(tmp_path, mtl=PAINT + "newmtl air\nd 0\n", body=body))
    assert "air: fully transparent, left out" in mesh.warnings
    assert mesh.face_count == 1


def test_vertex_colours_of_alpha_0_are_drawn_opaque(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply_bytes(colours=np.array([[1, 2, 3, 0]] * 4, dtype=np.uint8)))
    mesh = load_mesh(tmp_path / "a.ply")
    assert "every colour has alpha 0; taken as opaque" in warning(mesh)
    assert only_part(mesh).visual.vertex_colors[0].tolist() == [1, 2, 3, 255]


def test_translucency_of_an_mtl_file(tmp_path):
    def alpha(lines):
        mesh = load_mesh(write_obj(tmp_path, mtl=PAINT + lines))
        return only_part(mesh).visual.material.baseColorFactor[3], mesh.warnings

    assert alpha("d 0.6\nTr 1\n") == (153, ())
    assert alpha("Tr 0.4\n") == (153, ())
    assert alpha("Tr 1\n") == (255, ("material 'paint': Tr 1 without d taken as opaque",))


@pytest.mark.parametrize(
    "name",
    [
        "wood.png",
        ".\\textures\\..\\wood.png",
        "WOOD.PNG",
        "-s 1 1 1 -o 0 0 0 wood.png",
        "model://chair/wood.png",
        "model://chair/materials/wood.png",
    ],
)
def test_names_of_an_existing_texture_may_be_written_in_several_ways(tmp_path, name):
    (tmp_path / "textures").mkdir()
    mesh = load_mesh(write_obj(tmp_path, mtl=PAINT + f"map_Kd {name}\n", texture=picture(colour=(5, 6, 7))))
    assert mesh.warnings == ()
    assert only_part(mesh).visual.material.baseColorTexture.getpixel((0, 0)) == (5, 6, 7)


@pytest.mark.parametrize("name", ["gone.png", "model://suv/materials/gone.png", "textures\\gone.png", "maps"])
def test_a_missing_texture_is_named_with_its_material(tmp_path, name):
    (tmp_path / "maps").mkdir()
    mesh = load_mesh(write_obj(tmp_path, mtl=PAINT + f"map_Kd {name}\n"))
    assert warning(mesh) == f"material 'paint': drawn without its texture {name} (not found)"
    assert only_part(mesh).visual.material.baseColorFactor.tolist() == [255, 0, 0, 255]


@pytest.mark.parametrize("name", ["/srv/art/wood.png", "C:\\art\\wood.png", "\\\\server\\art\\wood.png"])
def test_for_an_absolute_path_the_file_of_that_name_next_to_the_mesh_is_read(tmp_path, name):
    mesh = load_mesh(write_obj(tmp_path, mtl=PAINT + f"map_Kd {name}\n", texture=picture(colour=(5, 6, 7))))
    assert warning(mesh) == f"{name}: absolute path not followed, wood.png taken"
    assert only_part(mesh).visual.material.baseColorTexture.getpixel((0, 0)) == (5, 6, 7)


@pytest.mark.parametrize(
    ("mesh_at", "name", "texture_at"),
    [
        ("suv/meshes", "../materials/textures/wood.png", "suv/materials/textures"),
        ("suv/meshes", "wood.png", "suv/materials/textures"),
        ("suv/meshes", "model://suv/materials/textures/wood.png", "suv/materials/textures"),
        ("suv/meshes", "model://wheels/materials/textures/wood.png", "wheels/materials/textures"),
        ("suv", "C:\\art\\wood.png", "suv/textures"),
        ("suv", "maps/WOOD.PNG", "suv"),
        ("suv", "../shared/wood.png", "shared"),
        ("suv/meshes", "../../../art/wood.png", "suv/materials/textures"),  # outside, but its base name is found
    ],
)
def test_textures_are_found_where_models_of_gazebo_and_others_keep_them(tmp_path, mesh_at, name, texture_at):
    for folder in (mesh_at, texture_at, "suv/materials"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / texture_at / "wood.png").write_bytes(picture(colour=(5, 6, 7)))
    path = write_obj(tmp_path / mesh_at, mtl=PAINT + f"map_Kd {name}\n")
    mesh = load_mesh(path, within=tmp_path)
    assert only_part(mesh).visual.material.baseColorTexture.getpixel((0, 0)) == (5, 6, 7)
    assert mesh.lost_files == ()
    assert all(line.endswith("wood.png taken") for line in mesh.warnings)


def test_no_file_outside_the_given_folder_is_read(tmp_path):
    (tmp_path / "suv/meshes").mkdir(parents=True)
    (tmp_path / "suv/materials/textures").mkdir(parents=True)
    (tmp_path / "suv/materials/textures/wood.png").write_bytes(picture())
    path = write_obj(tmp_path / "suv/meshes", mtl=WOOD)
    assert load_mesh(path).lost_files == ()
    assert load_mesh(path, within=tmp_path / "suv/meshes").lost_files == ("wood.png",)
    write_obj(tmp_path / "suv/meshes", mtl=PAINT + "map_Kd ../materials/textures/wood.png\n")
    assert "which leaves it" in refusal(path, within=tmp_path / "suv/meshes")


@pytest.mark.parametrize("data", [b"", b"no image", picture(size=(64, 64), mode="RGB", colour=(3, 2, 1))[:-40]])
def test_a_broken_texture_is_named(tmp_path, data):
    message = "; ".join(load_mesh(write_obj(tmp_path, mtl=WOOD, texture=data or None)).warnings)
    assert "material 'paint': drawn without its texture wood.png" in message
    path = write_glb(tmp_path / "a.glb", uv=SQUARE_UV, image=data or b"\0")
    mesh = load_mesh(path)
    assert "material 'paint': drawn without its baseColorTexture wood (not a whole image" in "; ".join(mesh.warnings)
    assert only_part(mesh).visual.material.baseColorTexture is None


def test_a_program_is_never_run_to_decode_a_texture(tmp_path):
    script = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n"
    mesh = load_mesh(write_glb(tmp_path / "a.glb", uv=SQUARE_UV, image=script))
    assert "not a whole image" in "; ".join(mesh.warnings)
    assert only_part(mesh).visual.material.baseColorTexture is None


def test_textures_of_collada_and_ply_are_found_or_named(tmp_path):
    image = '<library_images><image id="i"><init_from>wood.png</init_from></image></library_images>'
    sampled = '<texture texture="s" texcoord="t"/>'
    text = dae_text(images=image, diffuse=sampled).replace(
        '<technique sid="t">',
        '<newparam sid="f"><surface type="2D"><init_from>i</init_from></surface></newparam>'
        '<newparam sid="s"><sampler2D><source>f</source></sampler2D></newparam><technique sid="t">',
    )
    (tmp_path / "a.dae").write_text(text)
    assert warning(load_mesh(tmp_path / "a.dae")) == "wood.png: not found"
    data = ply_bytes().replace(b"ply\n", b"ply\ncomment TextureFile wood.png\n", 1)
    data = data.replace(b"format binary_little_endian 1.0\n", b"", 1).replace(
        b"ply\n", b"ply\nformat binary_little_endian 1.0\n", 1
    )
    (tmp_path / "a.ply").write_bytes(data)
    assert "wood.png" in "; ".join(load_mesh(tmp_path / "a.ply").warnings)


def test_a_missing_or_empty_mtl_and_an_undefined_material_are_named(tmp_path):
    body = "mtllib gone.mtl\n" + OBJ_SOLID + "usemtl paint\n" + OBJ_FACES
    lines = load_mesh(write_obj(tmp_path, body=body)).warnings
    assert lines == ("gone.mtl: not found", "material 'paint' is defined nowhere; drawn grey")
    lines = load_mesh(write_obj(tmp_path, mtl="Kd 1 0 0\n")).warnings
    assert lines[0] == "mesh.mtl: expected materials, found 1 statements before the first newmtl"
    lines = load_mesh(write_obj(tmp_path, mtl="newmtl paint\nKd red\n")).warnings
    assert lines[0].startswith("material 'paint': Kd: expected 3 numbers, found 'red'")


def test_unicode_names(tmp_path):
    folder = tmp_path / "Möbel 椅子"
    folder.mkdir()
    (folder / "Holz ä.png").write_bytes(picture(colour=(5, 6, 7)))
    body = "mtllib stühle.mtl\n" + OBJ_SOLID + "usemtl größe\n" + OBJ_FACES
    (folder / "stühle.mtl").write_text("newmtl größe\nmap_Kd Holz ä.png\n", encoding="utf-8")
    mesh = load_mesh(write_obj(folder, body=body, name="Stühle.obj"))
    assert mesh.warnings == ()
    assert mesh.name == "Stuhle"
    path = write_gltf(
        folder,
        uv=SQUARE_UV,
        image=picture(),
        change=lambda header: header.update(images=[{"uri": "Holz%20%C3%A4.png"}]),
    )
    mesh = load_mesh(path)
    assert mesh.warnings == ()
    assert only_part(mesh).visual.material.baseColorTexture.getpixel((0, 0)) == (5, 6, 7)


# --- geometry -----------------------------------------------------------------------------------------------------


def test_a_solid_with_faces_oriented_inwards_is_reversed(tmp_path):
    path = write_glb(tmp_path / "a.glb", faces=TETRAHEDRON_FACES[:, ::-1])
    mesh = load_mesh(path)
    assert warning(mesh) == "solid: wound inside out, its faces are turned"
    assert outwards(only_part(mesh)) > 0


def test_a_face_with_a_missing_vertex_is_named_in_any_part():
    """Each part is compared with the others, so that all parts must be checked before."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.Trimesh(TETRAHEDRON, TETRAHEDRON_FACES[:, ::-1], process=False), geom_name="whole")
    wrong = TETRAHEDRON_FACES.copy()
    wrong[0, 0] = 1027
    scene.add_geometry(trimesh.Trimesh(TETRAHEDRON, wrong, process=False), geom_name="broken")
    with pytest.raises(MeshError, match="broken: expected faces on its 4 vertices, found one on vertex 1027; the file"):
        prepare_scene(scene, "it")


def test_normals_that_are_missing_zero_not_finite_or_inverted(tmp_path):
    outward = TETRAHEDRON - 0.25
    mesh = load_mesh(write_glb(tmp_path / "a.glb", normals=-outward))
    assert warning(mesh) == "solid: 4 of 4 normals point into the surface; turned"
    assert ((only_part(mesh).vertex_normals * outward).sum(axis=1) > 0).all()
    broken = outward.copy()
    broken[0], broken[1] = 0, np.nan
    mesh = load_mesh(write_glb(tmp_path / "b.glb", normals=broken))
    assert warning(mesh) == "solid: 2 of 4 normals missing; those of its faces taken"
    normals = only_part(mesh).vertex_normals
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert ((normals * outward).sum(axis=1) > 0).all()
    assert load_mesh(write_glb(tmp_path / "c.glb")).warnings == ()


def test_faces_without_area_are_omitted(tmp_path):
    faces = np.concatenate([TETRAHEDRON_FACES, [[0, 0, 1], [2, 2, 2]]])
    mesh = load_mesh(write_glb(tmp_path / "a.glb", faces=faces))
    assert mesh.face_count == 4
    assert warning(mesh) == "solid: 2 of 6 faces without area left out"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_faces_on_vertices_that_are_not_finite_are_counted(tmp_path, value):
    positions = TETRAHEDRON.copy()
    positions[3, 1] = value
    expected = "3 of 4 faces left out, on vertices that are not finite"
    for path in [write_glb(tmp_path / "a.glb", positions=positions), *written(tmp_path, positions)]:
        if path.suffix == ".dae" and np.isnan(value):
            assert "found 1 times NaN" in refusal(path)
            continue
        mesh = load_mesh(path)
        assert any(expected in line for line in mesh.warnings), mesh.warnings
        assert mesh.face_count == 1


def written(folder, positions):
    (folder / "a.ply").write_bytes(ply_bytes(positions=positions))
    (folder / "a.stl").write_bytes(stl_bytes(positions=positions))
    (folder / "a.off").write_text(off_text(positions=positions))
    (folder / "a.dae").write_text(dae_text(positions=positions))
    rows = "".join("v " + " ".join(str(float(value)) for value in row) + "\n" for row in positions)
    (folder / "a.obj").write_text(rows + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in TETRAHEDRON_FACES))
    return [folder / f"a.{kind}" for kind in ("ply", "stl", "off", "dae", "obj")]


@pytest.mark.parametrize("positions", [TETRAHEDRON * 0, TETRAHEDRON * 0 + 5, TETRAHEDRON * np.float32(1e38)])
def test_no_extent_and_absurd_coordinates_are_refused(tmp_path, positions):
    for path in [write_glb(tmp_path / "a.glb", positions=positions), *written(tmp_path, positions)]:
        refusal(path)


def test_meshes_of_any_reasonable_scale_are_normalised(tmp_path):
    for scale in (1e-7, 1e-3, 1e6, 1e20):
        path = write_glb(tmp_path / "a.glb", positions=TETRAHEDRON * np.float32(scale))
        assert only_part(load_mesh(path)).extents.tolist() == pytest.approx([2 / np.sqrt(3)] * 3, rel=1e-5)


@pytest.mark.parametrize("scale", [2.0**-24, 2.0**-40, 2.0**24])
def test_the_repair_of_a_mesh_does_not_depend_on_its_size(scale):
    ball, rod = trimesh.creation.icosphere(2), trimesh.creation.cylinder(0.01, 3.0)
    ball.invert()
    scene = trimesh.Scene([ball, rod])
    whole, scaled = prepare_scene(scene, "it"), prepare_scene(scene.scaled(scale), "it")
    assert scaled.warnings == whole.warnings == ("geometry_0: wound inside out, its faces are turned",)
    for one, other in zip(mesh_parts(whole), mesh_parts(scaled), strict=True):
        assert other.metadata["smooth"] == one.metadata["smooth"]
        assert np.array_equal(other.vertices, one.vertices)
        assert np.array_equal(other.faces, one.faces)
        assert np.array_equal(other.vertex_normals, one.vertex_normals)
    assert np.array_equal(scaled.world_from_file[:3, :3] * scale, whole.world_from_file[:3, :3])


def test_for_a_distant_vertex_there_is_a_warning(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1)
    points = np.concatenate([ball.vertices, [[1e4, 0, 0]]])
    faces = np.concatenate([ball.faces, [[0, 1, len(ball.vertices)]]])
    mesh = load_mesh(write_glb(tmp_path / "a.glb", positions=points, faces=faces))
    assert "a few vertices lie far from all others" in warning(mesh)


def test_points_only_and_lines_only_are_refused(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "a.ply").write_text(head + "0 0 0\n1 1 1\n")
    assert "2 points only" in refusal(tmp_path / "a.ply")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 1 1\nl 1 2\n")
    assert "found none in 2 vertices" in refusal(tmp_path / "a.obj")
    for mode, what in ((0, "points"), (1, "lines")):
        path = write_glb(tmp_path / "a.glb", mode=mode, faces=None)
        assert f"solid: {what} left out" in refusal(path)


def test_for_lines_in_a_mesh_with_faces_there_is_a_warning(tmp_path):
    mesh = load_mesh(write_obj(tmp_path, body=OBJ_SOLID + OBJ_FACES + "l 1 2\nf 1 2\nwhat is this\n"))
    assert mesh.warnings == (
        "1 lines left out, only faces are drawn",
        "1 faces with fewer than 3 corners left out",
        "1 lines not understood",
    )


@pytest.mark.parametrize("kind", ["glb", "gltf", "obj", "ply", "stl", "off", "dae"])
@pytest.mark.parametrize(
    "data", [b"", b"\0" * 300, b"hello\n", bytes(range(256)) * 4, b"\xff\xfe{\x00", b"{}", b"[1, 2]", b"solid\n"]
)
def test_empty_files_and_garbage_are_refused(tmp_path, kind, data):
    path = tmp_path / f"a.{kind}"
    path.write_bytes(data)
    refusal(path)


def test_other_files_are_refused(tmp_path):
    assert "found nothing" in refusal(tmp_path / "gone.glb")
    (tmp_path / "folder.glb").mkdir()
    assert "found a folder" in refusal(tmp_path / "folder.glb")
    (tmp_path / "a.fbx").write_text("x")
    assert "found '.fbx'" in refusal(tmp_path / "a.fbx")


def test_an_empty_stl_and_an_empty_gltf_are_refused(tmp_path):
    (tmp_path / "a.stl").write_bytes(b"\0" * 84)
    assert "an STL with none" in refusal(tmp_path / "a.stl")
    refusal(write_glb(tmp_path / "a.glb", nodes=[{"name": "empty"}]))
    header, buffer = gltf()
    header["scenes"] = [{"nodes": []}]
    (tmp_path / "b.glb").write_bytes(glb_bytes(header, buffer))
    refusal(tmp_path / "b.glb")


@pytest.mark.parametrize("head", [b"\0", b"solid"])
def test_for_bytes_after_the_last_triangle_of_an_stl_there_is_a_warning(tmp_path, head):
    path = tmp_path / "a.stl"
    path.write_bytes(head + stl_bytes()[len(head) :] + b"padding")
    mesh = load_mesh(path)
    assert mesh.face_count == 4
    assert mesh.warnings == ("7 bytes behind its last triangle left out",)


@pytest.mark.parametrize("face", ["f 1 2 9", "f 0 1 2", "f 1 2 -9", "f 1 2 x", "f 1/1/1/1 2 3"])
def test_obj_faces_with_missing_vertices_are_refused(tmp_path, face):
    assert "expected" in refusal(write_obj(tmp_path, body=OBJ_SOLID + face + "\n"))


def test_faces_with_missing_vertices_are_refused_in_every_format(tmp_path):
    faces = TETRAHEDRON_FACES.copy()
    faces[2, 1] = 9
    refusal(write_glb(tmp_path / "a.glb", faces=faces))
    (tmp_path / "a.ply").write_bytes(ply_bytes(faces=faces))
    refusal(tmp_path / "a.ply")
    (tmp_path / "a.off").write_text(off_text(faces=faces))
    refusal(tmp_path / "a.off")


def test_too_many_faces_are_decimated_where_the_appearance_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr("data_gen.meshes.mesh.MAX_FACES", 2000)
    ball = trimesh.creation.icosphere(subdivisions=4)
    mesh = prepare_scene(trimesh.Scene(ball.copy()), "ball")
    assert warning(mesh) == f"decimated from {len(ball.faces)} to {mesh.face_count} triangles"
    assert 1000 < mesh.face_count <= 2000
    part = mesh_parts(mesh)[0]
    assert part.metadata["smooth"]
    assert np.isclose(outwards(part), 4 / 3 * np.pi, rtol=0.02)

    ball.visual.vertex_colors = np.where(ball.vertices[:, 2:] > 0, [[255, 0, 0, 255]], [[0, 0, 255, 255]])
    part = only_part(prepare_scene(trimesh.Scene(ball), "ball"))
    red = part.visual.vertex_colors[:, 0] == 255
    assert (red == (part.vertices[:, 2] > 0))[np.abs(part.vertices[:, 2]) > 0.1].all()
    linear = ball.visual.vertex_colors / 255.0
    path = write_glb(tmp_path / "a.glb", positions=ball.vertices, faces=ball.faces, colours=linear)
    part = only_part(load_mesh(path))
    red = part.visual.vertex_attributes[LINEAR_COLOUR][:, 0] == 1
    assert (red == (part.vertices[:, 2] > 0))[np.abs(part.vertices[:, 2]) > 0.1].all()


def test_meshes_that_cannot_be_decimated_are_drawn_up_to_a_limit_of_faces(monkeypatch):
    monkeypatch.setattr("data_gen.meshes.mesh.MAX_FACES", 1000)
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.visual.face_colors = np.random.default_rng(0).integers(0, 255, (len(ball.faces), 4), dtype=np.uint8)
    mesh = prepare_scene(trimesh.Scene(ball), "ball")
    assert warning(mesh) == "1280 triangles drawn as they are: textures or face colours would not survive decimation"
    assert mesh.face_count == 1280
    monkeypatch.setattr("data_gen.meshes.mesh.MAX_FACES", 100)
    with pytest.raises(MeshError, match="before decimation, found 1280"):
        prepare_scene(trimesh.Scene(ball), "ball")


def test_a_quarter_of_a_million_faces_are_drawn_unchanged(tmp_path):
    """Source of truth: the silhouette of a sphere in closed form."""
    rows, columns = 257, 512
    polar, around = np.meshgrid(np.linspace(1e-3, np.pi - 1e-3, rows), np.arange(columns) * 2 * np.pi / columns)
    points = np.stack([np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)], -1)
    corner = np.arange(columns)[:, None] * rows + np.arange(rows - 1)
    beside = (corner + rows) % (rows * columns)
    faces = np.stack([corner, beside, corner + 1, beside, beside + 1, corner + 1], -1).reshape(-1, 3)
    path = tmp_path / "ball.ply"
    path.write_bytes(trimesh.Trimesh(points.reshape(-1, 3), faces, process=False).export(file_type="ply"))
    mesh = load_mesh(path)
    assert (mesh.face_count, mesh.warnings) == (2**18, ())
    rig = fixed(1, 64)
    alpha = MeshRenderer().render(mesh_parts(mesh), rig).rgba[0, ..., 3] / 255
    radius = rig.intrinsics[0, 0, 0] * np.tan(np.arcsin(1 / 3.0))
    assert alpha.sum() == pytest.approx(np.pi * radius**2, rel=0.01)


# --- what a glTF may ask for ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "name", "remedy"),
    [
        ("extensionsRequired", "EXT_meshopt_compression", "without meshopt"),
        ("extensionsUsed", "KHR_meshopt_compression", "without meshopt"),
        ("extensionsRequired", "ACME_rays", "export it without"),
    ],
)
def test_compressions_and_unknown_required_extensions_are_refused_with_a_remedy(tmp_path, key, name, remedy):
    message = refusal(write_gltf(tmp_path, change=lambda header: header.update({key: [name]})))
    assert name in message
    assert remedy in message


def test_unsupported_features_of_a_gltf_are_named(tmp_path):
    def change(header):
        header["extensionsUsed"] = ["KHR_materials_clearcoat", "KHR_materials_transmission"]
        header["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] = 0
        header["materials"][0]["extensions"] = {"KHR_materials_transmission": {"transmissionFactor": 0.5}}
        header["meshes"][0]["primitives"].append(header["meshes"][0]["primitives"][0] | {"mode": 3})

    lines = load_mesh(write_gltf(tmp_path, uv=SQUARE_UV, image=picture(colour="white"), change=change)).warnings
    assert lines == (
        "KHR_materials_clearcoat: drawn without it",
        "material 'paint': KHR_materials_transmission drawn as opacity 0.50",
        "solid: lines left out, only triangles are drawn",
    )


def test_a_material_with_a_missing_texture_is_grey_and_not_white(tmp_path):
    path = write_gltf(
        tmp_path,
        uv=SQUARE_UV,
        image=picture(),
        change=lambda header: header.update(images=[{"uri": "gone.png"}]),
    )
    mesh = load_mesh(path)
    assert warning(mesh) == "material 'paint': drawn without its baseColorTexture gone.png (not found)"
    assert only_part(mesh).visual.material.baseColorFactor[0] == 153


@pytest.mark.parametrize(
    "change",
    [
        lambda header: header["accessors"][0].update(count=10**12),
        lambda header: header["accessors"][0].update(count=5),
        lambda header: header["accessors"][0].update(count=-1),
        lambda header: header["accessors"][0].update(count="4"),
        lambda header: header["accessors"][0].update(byteOffset=-4),
        lambda header: header["accessors"][0].update(componentType=1),
        lambda header: header["accessors"][0].update(sparse={}),
        lambda header: header["accessors"][0].pop("bufferView"),
        lambda header: header["accessors"][1].update(count=11),
        lambda header: header["bufferViews"][0].update(byteLength=10**9),
        lambda header: header["bufferViews"][0].update(byteOffset=-1),
        lambda header: header["bufferViews"][0].update(byteStride=0),
        lambda header: header["bufferViews"][0].update(buffer=3),
        lambda header: header["buffers"][0].update(byteLength=10**9),
        lambda header: header["buffers"][0].update(uri="gone.bin"),
        lambda header: header["buffers"][0].update(uri="https://example.org/mesh.bin"),
        lambda header: header["buffers"][0].update(uri="data:application/octet-stream;base64,????"),
        lambda header: header["nodes"][0].update(mesh=7),
        lambda header: header["nodes"][0].update(children=[99]),
        lambda header: header["meshes"][0]["primitives"][0].update(material=4),
        lambda header: header["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"),
        lambda header: header["asset"].update(version="1.0"),
        lambda header: header.update(scene=5),
        lambda header: header.update(accessors=3),
        lambda header: header.update(meshes=[None]),
    ],
)
def test_an_inconsistent_gltf_is_refused(tmp_path, change):
    refusal(write_gltf(tmp_path, change=change))


def test_a_buffer_inside_the_json_is_read(tmp_path):
    header, buffer = gltf()
    header["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
    import json

    (tmp_path / "a.gltf").write_text(json.dumps(header))
    assert load_mesh(tmp_path / "a.gltf").face_count == 4


def test_cyclic_nodes_and_deep_json_are_refused(tmp_path):
    nodes = [{"children": [1]}, {"mesh": 0, "children": [0]}]
    path = write_glb(tmp_path / "a.glb", nodes=nodes)
    try:
        assert load_mesh(path).face_count >= 4
    except MeshError:
        pass
    (tmp_path / "deep.gltf").write_text("[" * 100_000)
    refusal(tmp_path / "deep.gltf")


# --- trust ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def model(tmp_path):
    """The folder of a model, next to which is a file that must not be read."""
    (tmp_path / "secret.png").write_bytes(picture(colour=(1, 2, 3)))
    (tmp_path / "secret.mtl").write_text(PAINT)
    (tmp_path / "secret.bin").write_bytes(gltf()[1])
    folder = tmp_path / "model"
    folder.mkdir()
    return folder


@pytest.mark.parametrize("name", ["../secret.png", "x/../../secret.png", "..\\secret.png", "%2e%2e/secret.png"])
def test_references_that_leave_the_folder_are_refused_by_name(model, name):
    message = refusal(write_obj(model, mtl=PAINT + f"map_Kd {name}\n"))
    assert f"expected references inside model/, found {name!r}" in message
    path = write_gltf(model, uv=SQUARE_UV, image=picture(), change=lambda header: header.update(images=[{"uri": name}]))
    assert repr(name) in refusal(path)


def test_the_folder_is_named_if_the_mesh_is_given_without_one(model, monkeypatch):
    write_obj(model, mtl=PAINT + "map_Kd ../secret.png\n")
    monkeypatch.chdir(model)
    assert "mesh.obj: expected references inside model/, found '../secret.png'" in refusal("mesh.obj")


def test_files_of_absolute_paths_are_not_read(model):
    name = str(model.parent / "secret.png")
    mesh = load_mesh(write_obj(model, mtl=PAINT + f"map_Kd {name}\n"))
    assert warning(mesh) == f"material 'paint': drawn without its texture {name} (absolute path not followed)"
    assert only_part(mesh).visual.material.baseColorTexture is None


@pytest.mark.parametrize("name", ["../secret.mtl", "../secret.bin", "model://x/../../secret.png"])
def test_materials_buffers_and_uris_that_leave_the_folder_are_refused(model, name):
    if name.endswith(".bin"):
        path = write_gltf(model, change=lambda header: header["buffers"][0].update(uri=name))
    elif name.endswith(".mtl"):
        path = write_obj(model, body=f"mtllib {name}\n" + OBJ_SOLID + OBJ_FACES)
    else:
        path = write_obj(model, mtl=PAINT + f"map_Kd {name}\n")
    assert name in refusal(path)


def test_symbolic_links_that_leave_the_folder_are_refused(model):
    os.symlink(model.parent / "secret.png", model / "wood.png")
    assert "'wood.png', which leaves it" in refusal(write_obj(model, mtl=WOOD))
    (model / "wood.png").unlink()
    (model / "real.png").write_bytes(picture())
    os.symlink(model / "real.png", model / "wood.png")
    assert load_mesh(write_obj(model, mtl=WOOD)).warnings == ()


def png_that_claims(width, height):
    data = bytearray(picture())
    data[16:24] = struct.pack(">2I", width, height)
    import zlib

    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


@pytest.mark.parametrize("size", [(10_000, 10_000), (100_000, 100_000)])
def test_decompression_bombs_are_refused_before_they_are_decoded(tmp_path, size):
    bomb = png_that_claims(*size)
    message = refusal(write_obj(tmp_path, mtl=WOOD, texture=bomb))
    assert "wood.png" in message
    assert "wood" in refusal(write_glb(tmp_path / "a.glb", uv=SQUARE_UV, image=bomb))


def test_the_limit_of_pixels_is_for_all_textures_together(tmp_path, monkeypatch):
    mtl = "".join(f"newmtl m{index}\nmap_Kd {index}.png\n" for index in range(3))
    body = OBJ_SOLID + "".join(f"usemtl m{index}\nf 1/1 2/2 {3 + index % 2}/3\n" for index in range(3))
    for index in range(3):
        (tmp_path / f"{index}.png").write_bytes(picture(size=(10, 10)))
    path = write_obj(tmp_path, mtl=mtl, body=body)
    assert len(mesh_parts(load_mesh(path))) == 3
    monkeypatch.setattr(model_folder, "MAX_PIXELS", 250)
    assert "2.png: expected textures of at most 50 pixels" in refusal(path)


def test_files_are_measured_before_they_are_read(tmp_path):
    path = tmp_path / "huge.obj"
    with path.open("wb") as file:
        file.truncate(files.MAX_TEXT_BYTES + 1)
    assert "expected at most" in refusal(path)
    (tmp_path / "bomb").mkdir()
    with (tmp_path / "bomb" / "wood.png").open("wb") as file:
        file.truncate(files.MAX_FILE_BYTES + 1)
    assert "wood.png: expected at most" in str(
        pytest.raises(MeshError, load_mesh, write_obj(tmp_path / "bomb", mtl=WOOD)).value
    )


def test_entities_of_xml_are_refused(tmp_path):
    path = tmp_path / "a.dae"
    path.write_text(dae_text(extra='<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'))
    assert "document type or entity" in refusal(path)


# --- files that were cut ----------------------------------------------------------------------------------------------


def outcome(path, data):
    """The mesh of a file with this content, or None if it is refused. Any other error fails the test."""
    path.write_bytes(data)
    try:
        return load_mesh(path)
    except MeshError:
        return None


def test_a_glb_cut_anywhere_is_refused(tmp_path):
    image = picture("RGBA", size=(8, 8), colour=(1, 2, 3, 4))
    data = glb_bytes(*gltf(uv=SQUARE_UV, image=image, normals=TETRAHEDRON - 0.25))
    for length in range(0, len(data), 7):
        assert outcome(tmp_path / "a.glb", data[:length]) is None, length
    assert outcome(tmp_path / "a.glb", data).warnings == ()


def test_a_gltf_or_its_buffer_cut_anywhere_is_refused(tmp_path):
    path = write_gltf(tmp_path)
    text, buffer = path.read_bytes(), (tmp_path / "mesh.bin").read_bytes()
    for length in range(0, len(text), 29):
        assert outcome(path, text[:length]) is None, length
    for length in range(0, len(buffer), 11):
        (tmp_path / "mesh.bin").write_bytes(buffer[:length])
        assert outcome(path, text) is None, length


@pytest.mark.parametrize(("kind", "binary"), [("ply", True), ("stl", True), ("ply", False), ("stl", False)])
def test_a_ply_or_stl_cut_anywhere_is_refused_or_has_a_warning(tmp_path, kind, binary):
    data = {"ply": ply_bytes, "stl": stl_bytes}[kind](binary=binary)
    step = 1 if kind == "ply" else 3
    for length in range(0, len(data), step):
        mesh = outcome(tmp_path / f"a.{kind}", data[:length])
        whole = data[length:].strip() in (b"", b"mesh", b"h", b"sh", b"esh")  # only the name after endsolid is cut
        assert mesh is None or mesh.warnings or whole, length


def test_an_off_or_dae_cut_anywhere_is_refused_or_has_a_warning(tmp_path):
    for kind, data in (("off", off_text().encode()), ("dae", dae_text().encode())):
        for length in range(0, len(data), 1 if kind == "off" else 97):
            mesh = outcome(tmp_path / f"a.{kind}", data[:length])
            assert mesh is None or mesh.warnings or not data[length:].strip(), (kind, length)


def test_an_obj_cut_before_its_last_lines_is_refused_or_has_a_warning(tmp_path):
    write_obj(tmp_path, mtl=WOOD, texture=picture())
    path = tmp_path / "mesh.obj"
    data = path.read_bytes()
    silent = [length for length in range(len(data)) if (mesh := outcome(path, data[:length])) and not mesh.warnings]
    # Known limit: after the second face all four vertices are used, so that a file cut after a line is valid.
    ends = [index + 1 for index, byte in enumerate(data) if byte == 10]
    assert silent == ends[-3:-1]


def test_an_mtl_cut_anywhere_raises_no_other_error(tmp_path):
    path = write_obj(tmp_path, mtl=WOOD, texture=picture())
    for length in range(len(WOOD)):
        (tmp_path / "mesh.mtl").write_text(WOOD[:length])
        assert outcome(path, path.read_bytes()) is not None


def test_random_bytes_raise_no_other_error(tmp_path):
    generator = np.random.default_rng(0)
    files = {
        "a.glb": glb_bytes(*gltf(uv=SQUARE_UV, image=picture())),
        "a.ply": ply_bytes(),
        "b.ply": ply_bytes(binary=False),
        "a.stl": stl_bytes(),
        "b.stl": stl_bytes(binary=False),
        "a.obj": (OBJ_SOLID + OBJ_FACES).encode(),
        "a.off": off_text().encode(),
        "a.dae": dae_text().encode(),
    }
    for name, data in files.items():
        for _ in range(40):
            changed = np.frombuffer(data, dtype=np.uint8).copy()
            places = generator.integers(0, len(changed), 3)
            changed[places] = generator.integers(0, 256, 3, dtype=np.uint8)
            outcome(tmp_path / name, changed.tobytes())


def test_a_texture_cut_anywhere_is_named(tmp_path):
    stream = io.BytesIO()
    PIL.Image.fromarray(np.random.default_rng(0).integers(0, 255, (16, 16, 3), dtype=np.uint8)).save(stream, "JPEG")
    data = stream.getvalue()
    for length in range(0, len(data) - 2, 60):
        mesh = load_mesh(write_obj(tmp_path, mtl=WOOD, texture=data[:length]))
        assert "wood.png" in "; ".join(mesh.warnings), length
