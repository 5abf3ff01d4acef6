"""Source of truth: files written byte by byte (mesh_writers.py), with known geometry and colours."""

import subprocess
import sys
from pathlib import Path

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

from data_gen.meshes.find import find_meshes, safe_name
from data_gen.meshes.materials import LINEAR_COLOUR, convert_image, linear_factor
from data_gen.meshes.mesh import MeshError, load_mesh, mesh_parts, prepare_scene
from data_gen.rendering.surfaces import shaded_surfaces

SHARED = Path(__file__).parents[3] / ".." / "shared" / "meshes"

# The bounding box of the tetrahedron is the unit cube. All four vertices are sqrt(3) / 2 from its centre.
RADIUS = np.sqrt(3) / 2


def write_any(folder, kind):
    path = folder / f"mesh.{kind}"
    if kind == "glb":
        path.write_bytes(glb_bytes(*gltf()))
    elif kind == "gltf":
        return write_gltf(folder)
    elif kind == "obj":
        return write_obj(folder, mtl="newmtl paint\nKd 1 0 0\n")
    elif kind in ("ply", "stl"):
        path.write_bytes({"ply": ply_bytes, "stl": stl_bytes}[kind]())
    else:
        path.write_text(off_text() if kind == "off" else dae_text())
    return path


def corners(mesh):
    """The corners of all faces in world coordinates, in the order of the file."""
    return np.concatenate([part.vertices[part.faces] for part in mesh_parts(mesh)])


def colour(part):
    """The base colour of a part, as linear RGBA from 0 to 255."""
    return np.asarray(part.visual.material.baseColorFactor).tolist()


@pytest.mark.parametrize("kind", ["glb", "gltf", "obj", "ply", "stl", "off", "dae"])
def test_each_format_gives_the_same_normalised_solid(tmp_path, kind):
    mesh = load_mesh(write_any(tmp_path, kind))
    expected = (TETRAHEDRON[TETRAHEDRON_FACES] - 0.5) / RADIUS
    assert mesh.warnings == ()
    assert mesh.name == "mesh"
    assert mesh.face_count == 4
    assert np.allclose(corners(mesh), expected, atol=1e-6)
    assert np.isclose(np.linalg.norm(corners(mesh), axis=-1).max(), 1.0)


def test_both_encodings_of_ply_and_stl_agree(tmp_path):
    for kind, writer in (("ply", ply_bytes), ("stl", stl_bytes)):
        (tmp_path / f"a.{kind}").write_bytes(writer(binary=True))
        (tmp_path / f"b.{kind}").write_bytes(writer(binary=False))
        first, second = load_mesh(tmp_path / f"a.{kind}"), load_mesh(tmp_path / f"b.{kind}")
        assert first.warnings == second.warnings == ()
        assert np.allclose(corners(first), corners(second))


def test_the_normalising_transform_is_recorded(tmp_path):
    moved = TETRAHEDRON * 250 + np.array([1e4, -3.0, 7.0], dtype=np.float32)
    mesh = load_mesh(write_glb(tmp_path / "a.glb", positions=moved))
    again = trimesh.transform_points(moved[TETRAHEDRON_FACES].reshape(-1, 3), mesh.world_from_file)
    assert np.allclose(again, corners(mesh).reshape(-1, 3), atol=1e-6)
    linear = mesh.world_from_file[:3, :3] * 250 * RADIUS
    assert np.allclose(linear @ linear.T, np.eye(3), atol=1e-6)


def test_z_up_is_rotated_to_y_up(tmp_path):
    tall = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 9]], dtype=np.float32)
    path = write_glb(tmp_path / "a.glb", positions=tall)
    upright = load_mesh(path, up="z")
    assert np.argmax(np.ptp(corners(load_mesh(path)).reshape(-1, 3), axis=0)) == 2
    assert np.argmax(np.ptp(corners(upright).reshape(-1, 3), axis=0)) == 1
    assert np.linalg.det(upright.world_from_file[:3, :3]) > 0
    turned = upright.world_from_file[:3, :3] @ [0, 0, 1]
    assert turned[1] > 0
    assert np.allclose(turned[[0, 2]], 0)
    with pytest.raises(ValueError, match="up: expected 'y' or 'z', got 'x'"):
        load_mesh(path, up="x")


def test_node_transforms_are_applied_to_vertices_also_of_instances(tmp_path):
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0], "scale": [2, 2, 2]}]
    mesh = load_mesh(write_glb(tmp_path / "a.glb", nodes=nodes))
    parts = sorted(mesh_parts(mesh), key=lambda part: part.scale)
    assert [len(part.faces) for part in parts] == [4, 4]
    assert all(np.array_equal(mesh.scene.graph[node][0], np.eye(4)) for node in mesh.scene.graph.nodes_geometry)
    in_file = trimesh.transform_points(parts[1].vertices, np.linalg.inv(mesh.world_from_file))
    assert np.allclose(in_file, TETRAHEDRON * 2 + [3, 0, 0], atol=1e-5)


def test_normals_follow_a_stretching_transform(tmp_path):
    # A plane x + y = const that is stretched by 4 along x has the normal (1/4, 1, 0).
    points = [[1, 0, 0], [0, 1, 0], [0, 1, 1], [1, 0, 1]]
    normal = np.array([[np.sqrt(0.5), np.sqrt(0.5), 0]] * 4)
    nodes = [{"mesh": 0, "scale": [4, 1, 1]}]
    path = write_glb(tmp_path / "a.glb", positions=points, faces=[[0, 1, 2], [0, 2, 3]], normals=normal, nodes=nodes)
    part = mesh_parts(load_mesh(path))[0]
    assert part.metadata["smooth"]
    assert np.allclose(part.vertex_normals, np.array([0.25, 1, 0]) / np.hypot(0.25, 1), atol=1e-6)


def test_obj_colours_are_converted_to_linear_and_replaced_by_a_texture(tmp_path):
    # sRGB 188 / 255 is linear 128 / 255.
    # sRGB 0.1 is linear ((0.1 + 0.055) / 1.055)^2.4; in 8 bits it would be rounded to 3 / 255.
    plain = mesh_parts(load_mesh(write_obj(tmp_path, mtl="newmtl paint\nKd 0.737255 0 0.1\n")))[0]
    assert colour(plain) == [128, 0, 3, 255]
    assert plain.copy().visual.material.exact[2] == pytest.approx(((0.1 + 0.055) / 1.055) ** 2.4, abs=1e-9)
    path = write_obj(tmp_path, mtl="newmtl paint\nKd 0 0 0\nmap_Kd wood.png\n", texture=picture(colour=(9, 8, 7)))
    part = mesh_parts(load_mesh(path))[0]
    assert colour(part) == [255] * 4
    assert part.visual.material.baseColorTexture.getpixel((0, 0)) == (9, 8, 7)
    assert np.allclose(part.visual.uv[part.faces[3]], [[1, 0], [0, 1], [1, 1]])


def test_obj_polygons_relative_indices_tabs_and_several_libraries(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "b c.mtl").write_text("newmtl blue\nKd 0 0 1\nd 0.5\n")
    body = (
        "mtllib a.mtl\nmtllib b c.mtl\n# a square and a pentagon\n"
        "v 0 0 0 # a corner\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl red\nf\t-4 -3 -2 -1\n"
        "v 0 0 1\nv 1 0 1\nv 2 1 1\nv 1 2 1\nv 0 1 1\nusemtl blue\n  f 5 6 \\\n 7 8 9\r\n"
    )
    mesh = load_mesh(write_obj(tmp_path, body=body))
    assert mesh.warnings == ()
    red, blue = mesh_parts(mesh)
    assert (len(red.faces), len(blue.faces)) == (2, 3)
    assert colour(red) == [255, 0, 0, 255]
    assert colour(blue) == [0, 0, 255, 128]


def test_obj_smoothing_groups_are_used_without_normals(tmp_path):
    solid = OBJ_SOLID + "{}\n" + OBJ_FACES
    parts = [mesh_parts(load_mesh(write_obj(tmp_path, body=solid.format(line))))[0] for line in ("s 1", "s off")]
    assert [part.metadata["smooth"] for part in parts] == [True, False]


def test_without_normals_round_objects_are_smooth_and_angular_ones_flat():
    shapes = {"ball": trimesh.creation.icosphere(subdivisions=3), "box": trimesh.creation.box()}
    parts = {name: mesh_parts(prepare_scene(trimesh.Scene(shape), name))[0] for name, shape in shapes.items()}
    assert {name: part.metadata["smooth"] for name, part in parts.items()} == {"ball": True, "box": False}


def test_vertex_colours_stay_srgb(tmp_path):
    seen = np.array([[255, 0, 0, 255], [0, 128, 0, 255], [0, 0, 64, 255], [7, 7, 7, 255]], dtype=np.uint8)
    (tmp_path / "a.ply").write_bytes(ply_bytes(colours=seen))
    (tmp_path / "a.off").write_text(off_text(head="COFF", vertex_tail=" 0.5 0 1 1"))
    ply, off = (mesh_parts(load_mesh(tmp_path / name))[0] for name in ("a.ply", "a.off"))
    assert np.array_equal(ply.visual.vertex_colors, seen)
    assert np.array_equal(off.visual.vertex_colors, [[128, 0, 255, 255]] * 4)
    obj = write_obj(tmp_path, body="v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 0 0 1\nf 1 2 3\n")
    part = mesh_parts(load_mesh(obj))[0]
    assert np.array_equal(part.visual.vertex_colors[:, :3], [[255, 0, 0], [255, 0, 0], [0, 0, 255]])


def test_gltf_vertex_colours_are_linear_and_multiplied_by_the_material(tmp_path):
    # "an additional linear multiplier to base color" (glTF 2.0, 3.9.2), of a material that stays as it is
    painted = np.array([[0.50196, 0.50196, 1, 1]] * 4)
    material = {"pbrMetallicRoughness": {"baseColorFactor": [0.0018, 0, 1, 1], "roughnessFactor": 0.25}}
    mesh = load_mesh(write_glb(tmp_path / "a.glb", colours=painted, material=material))
    part = mesh_parts(mesh)[0]
    assert mesh.warnings == ()
    np.testing.assert_allclose(part.visual.vertex_attributes[LINEAR_COLOUR], painted, atol=0.002)
    np.testing.assert_allclose(linear_factor(part.visual.material), [0.0018, 0, 1, 1])
    assert part.visual.material.roughnessFactor == 0.25


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_gltf_vertex_colours_without_a_material_are_opaque_in_every_type_of_number(tmp_path, kind):
    # the alpha of an opaque material is ignored (glTF 2.0, 3.9.4)
    top = 1.0 if kind == np.float32 else np.iinfo(kind).max
    painted = (np.array([[0.50196, 0, 1, 0.5]] * 4) * top + 0.5 * (top > 1)).astype(kind)
    part = mesh_parts(load_mesh(write_glb(tmp_path / "a.glb", colours=painted)))[0]
    found = part.visual.vertex_attributes[LINEAR_COLOUR]
    np.testing.assert_allclose(found, [[0.50196, 0, 1, 1]] * 4, atol=0.6 / 65535)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
@pytest.mark.parametrize("material", [None, {"doubleSided": True}])
def test_dark_gltf_vertex_colours_are_as_exact_as_the_file(tmp_path, kind, material):
    # 0.0018 of linear light is 5.9 of 255 in sRGB, 0.0024 is 7.9; in 8 bits both would be 0 or 13
    dark = np.array([[0.0018, 0.0024, 0.0018, 1]] * 4)
    path = write_glb(
        tmp_path / "a.glb",
        colours=(dark * 65535).round().astype(kind) if kind == np.uint16 else dark,
        material=material,
    )
    (surface,) = shaded_surfaces(mesh_parts(load_mesh(path)))
    np.testing.assert_allclose(surface.base_colour * surface.colours, [dark[0]] * len(surface.colours), atol=1e-5)


def test_the_alpha_of_gltf_vertex_colours_is_used_with_an_alpha_cutoff(tmp_path):
    painted = np.array([[1, 1, 1, 0.6]] * 4)
    for cutoff in (0.5, 0.7):
        material = {"alphaMode": "MASK", "alphaCutoff": cutoff}
        mesh = load_mesh(write_glb(tmp_path / "a.glb", colours=painted, material=material))
        visual = mesh_parts(mesh)[0].visual
        assert (visual.material.alphaMode, visual.material.alphaCutoff) == ("MASK", cutoff)
        np.testing.assert_allclose(visual.vertex_attributes[LINEAR_COLOUR][:, 3], 0.6, atol=0.002)


def test_gltf_without_normals_is_flat(tmp_path):
    """ "When normals are not specified, client implementations MUST calculate flat normals" (glTF 2.0, 3.7.2.1)."""
    ball = trimesh.creation.icosphere(3)
    for normals, smooth in ((None, False), (ball.vertex_normals, True)):
        path = write_glb(tmp_path / "a.glb", positions=ball.vertices, faces=ball.faces, normals=normals)
        assert mesh_parts(load_mesh(path))[0].metadata["smooth"] == smooth


def test_the_vertex_colours_of_an_obj_have_one_range(tmp_path):
    """Three of the six are at most 1, but the range is 0 to 255, as in the others."""
    points = [(0, 0, 0, 255, 0, 0), (1, 0, 0, 0, 200, 0), (0, 1, 0, 0, 0, 9), (0, 0, 1, 0, 0, 1), (1, 0, 1, 1, 0, 0)]
    body = "".join(f"v {' '.join(map(str, each))}\n" for each in [*points, (0, 1, 1, 0, 1, 0)])
    parts = mesh_parts(load_mesh(write_obj(tmp_path, body=body + "o a\nf 1 2 3\no b\nusemtl none\nf 4 5 6\n")))
    assert {int(part.visual.vertex_colors[:, :3].max()) for part in parts} == {255, 1}


def test_colours_of_ply_faces_are_kept(tmp_path):
    head, _, _ = ply_bytes(binary=False).partition(b"end_header")
    head += b"".join(b"property uchar " + name + b"\n" for name in (b"red", b"green", b"blue")) + b"end_header\n"
    points = "".join(" ".join(str(float(value)) for value in point) + "\n" for point in TETRAHEDRON)
    faces = "".join(f"3 {a} {b} {c} {10 * a} {10 * b} {10 * c}\n" for a, b, c in TETRAHEDRON_FACES)
    (tmp_path / "a.ply").write_bytes(head + (points + faces).encode())
    part = mesh_parts(load_mesh(tmp_path / "a.ply"))[0]
    assert not part.metadata["smooth"]
    assert np.array_equal(part.visual.face_colors[:, :3], 10 * TETRAHEDRON_FACES)


@pytest.mark.parametrize("element", ["vertex", "face"])
@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    ("kind", "dtype", "half", "white"),
    [("uchar", "<u1", 128, 255), ("ushort", "<u2", 32900, 65535), ("ushort", "<u2", 128, 255), ("int", "<i4", 128, 255)]
    + [("float", "<f4", 0.502, 1.0), ("float", "<f4", 128.0, 255.0), ("double", "<f8", 128.0, 255.0)],
)
def test_colours_of_ply_files_have_the_range_of_their_type(tmp_path, element, binary, kind, dtype, half, white):
    # 128 of 255, 0.502 of 1 and 32900 of 65535 are the same colour
    dtypes = {"vertex": [("at", "<f4", 3)], "face": [("count", "u1"), ("corners", "<i4", 3)]}
    dtypes[element] = [*dtypes[element], ("colour", dtype, 3)]
    vertices, faces = (np.zeros(4, dtype=dtypes[name]) for name in ("vertex", "face"))
    vertices["at"], faces["count"], faces["corners"] = TETRAHEDRON, 3, TETRAHEDRON_FACES
    rows = {"vertex": vertices, "face": faces}
    rows[element]["colour"] = [half, 0, white]
    colours = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    head = f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\nelement vertex 4\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + colours * (element == "vertex")
    head += "element face 4\nproperty list uchar int vertex_indices\n" + colours * (element == "face")
    if binary:
        body = vertices.tobytes() + faces.tobytes()
    else:
        numbers = [[each for part in row.tolist() for each in np.ravel(part).tolist()] for row in [*vertices, *faces]]
        body = "".join(" ".join(map(str, row)) + "\n" for row in numbers).encode()
    (tmp_path / "a.ply").write_bytes(head.encode() + b"end_header\n" + body)
    mesh = load_mesh(tmp_path / "a.ply")
    assert mesh.warnings == ()
    visual = mesh_parts(mesh)[0].visual
    assert np.array_equal(getattr(visual, f"{element}_colors"), [[128, 0, 255, 255]] * 4)


def test_colours_of_off_files_are_ignored_with_a_warning(tmp_path):
    path = tmp_path / "a.off"
    path.write_text(off_text(vertex_tail=" 255 0 0"))
    assert load_mesh(path).warnings == ("3 numbers behind each vertex left out: colours need COFF on the first line",)
    path.write_text(off_text(face_tails=(" 255 0 0", "", " 0 0 255", "")))
    assert load_mesh(path).warnings == (
        "colours of its faces left out: expected 3 or 4 numbers behind every one, found 0 and 3",
    )


def test_a_prepared_scene_is_the_same_after_export_and_import(tmp_path):
    mesh = load_mesh(write_glb(tmp_path / "a.glb", nodes=[{"mesh": 0}, {"mesh": 0, "scale": [-2, 2, 2]}]))
    mesh.scene.export(tmp_path / "b.glb")
    again = load_mesh(tmp_path / "b.glb")
    assert again.warnings == ()
    assert np.allclose(again.world_from_file, np.eye(4), atol=1e-6)
    before, after = (sorted(mesh_parts(each), key=lambda part: part.scale) for each in (mesh, again))
    for first, second in zip(before, after, strict=True):
        assert np.allclose(first.vertices[first.faces], second.vertices[second.faces], atol=1e-6)


def test_face_colours_are_shaded_flat(tmp_path):
    tails = (" 255 0 0", " 0 255 0", " 0 0 255", " 9 9 9")
    (tmp_path / "a.off").write_text(off_text(face_tails=tails))
    part = mesh_parts(load_mesh(tmp_path / "a.off"))[0]
    assert not part.metadata["smooth"]
    assert np.array_equal(part.visual.face_colors[:, :3], [[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9]])


def test_gltf_materials_keep_their_factors_textures_and_alpha_mode(tmp_path):
    material = {
        "alphaMode": "MASK",
        "alphaCutoff": 0.25,
        "doubleSided": True,
        "emissiveFactor": [0, 0.5, 0],
        "pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1], "metallicFactor": 0.25, "roughnessFactor": 0.75},
    }
    image = picture("RGBA", colour=(1, 2, 3, 200))
    mesh = load_mesh(write_glb(tmp_path / "a.glb", uv=SQUARE_UV, material=material, image=image))
    kept = mesh_parts(mesh)[0].visual.material
    assert mesh.warnings == ()
    assert (kept.alphaMode, kept.alphaCutoff, kept.doubleSided) == ("MASK", 0.25, True)
    assert (kept.metallicFactor, kept.roughnessFactor) == (0.25, 0.75)
    assert np.allclose(kept.emissiveFactor, [0, 0.5, 0])
    assert kept.baseColorTexture.getpixel((0, 0)) == (1, 2, 3, 200)


def test_collada_has_its_declared_up_axis_and_finds_its_texture(tmp_path):
    path = tmp_path / "a.dae"
    path.write_text(dae_text(up="Z_UP"))
    mesh = load_mesh(path)
    assert mesh.warnings == ()
    assert np.allclose(mesh.world_from_file[:3, :3] @ [0, 0, 1] * RADIUS, [0, 1, 0])
    # 0.5 is 128 in sRGB and 55 in linear light.
    assert colour(mesh_parts(mesh)[0]) == [255, 55, 0, 255]


def test_preparing_a_scene_does_not_change_the_given_one():
    box = trimesh.creation.box(extents=(4, 4, 4))
    box.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[10, 20, 30, 255], metallicFactor=0.0)
    )
    scene = trimesh.Scene(box)
    mesh = prepare_scene(scene, "box")
    assert np.allclose(box.extents, 4)
    assert np.allclose(mesh.scene.extents, 2 / np.sqrt(3))
    assert colour(mesh_parts(mesh)[0]) == [10, 20, 30, 255]
    assert mesh.world_from_file[0, 0] == pytest.approx(1 / np.sqrt(12))


def test_loading_twice_gives_the_same_bytes(tmp_path):
    path = write_glb(tmp_path / "a.glb", nodes=[{"mesh": 0}, {"mesh": 0, "translation": [2, 0, 0]}])
    first, second = load_mesh(path), load_mesh(path)
    assert corners(first).tobytes() == corners(second).tobytes()
    assert first.world_from_file.tobytes() == second.world_from_file.tobytes()


def test_find_meshes_names_are_unique_sorted_and_safe(tmp_path):
    for name in ("b/Stuhl Nr. 1.glb", "B/stuhl nr. 1.obj", "a.ply", "a+.stl", ".hidden.glb", "notes.txt", "日本.off"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    found = find_meshes(tmp_path).meshes
    names = [mesh.name for mesh in found]
    assert names == sorted(names)
    assert sorted(names) == ["B_stuhl_nr._1", "a", "a_2", "b_Stuhl_Nr._1_2", safe_name("日本")]
    assert {mesh.class_name for mesh in found} == {None}
    for folder in (tmp_path / "absent", tmp_path / "a.ply", tmp_path / "empty"):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(MeshError, match="expected"):
            find_meshes(folder)


def test_safe_names_are_never_empty_or_long():
    assert safe_name("../../etc/passwd") == "etc_passwd"
    assert safe_name("椅子").startswith("mesh_")
    assert len(safe_name("x" * 500)) == len(safe_name("x" * 500 + "ж")) == 100


def test_importing_the_package_loads_no_mesh_library():
    code = "import sys, data_gen; sys.exit(int(bool({'trimesh', 'PIL', 'pyrender', 'torch'} & set(sys.modules))))"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=Path(__file__).parents[3]).returncode == 0


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real meshes of ../shared/meshes are not here")
def test_all_real_meshes_load_with_warnings_about_losses():
    outcomes = {}
    for file in find_meshes(SHARED).meshes:
        try:
            mesh = load_mesh(file.path, name=file.name)
        except MeshError as error:
            outcomes[file.name] = str(error)
            continue
        assert np.isclose(np.linalg.norm(corners(mesh), axis=-1).max(), 1.0)
        for part in mesh_parts(mesh):
            assert isinstance(part.visual, trimesh.visual.ColorVisuals) or isinstance(
                part.visual.material.baseColorTexture, PIL.Image.Image | None
            )
        if "messy" in file.name:
            outcomes[file.name] = "; ".join(mesh.warnings)
    assert len([name for name in outcomes if "messy" in name]) == len(outcomes) == 4
    assert "wheels_01.png (not found)" in outcomes["messy_gazebo_ambulance_model_uri_ambulance"]
    assert "Textures/colormap.png (not found)" in outcomes["messy_kenney_truck_missing_texture"]
    assert outcomes["messy_teapot_quads_no_mtl"] == ""


def test_a_jpeg_with_several_pictures_is_a_texture(tmp_path):
    """Phones write CIPA's multi-picture format, in which the first picture is a common JPEG."""
    one, other = (PIL.Image.new("RGB", (8, 8), colour) for colour in ("red", "blue"))
    one.save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[other])
    with PIL.Image.open(tmp_path / "a.jpg") as image:
        assert image.format == "MPO"
        found = convert_image(image, "RGB")
    assert found is not None
    assert found.getpixel((4, 4))[0] > 250
