"""Source of truth: the COLLADA 1.4 schema, on files of a tetrahedron."""

import numpy as np
import pytest
from mesh_writers import TETRAHEDRON_FACES, dae_text

from data_gen.meshes.materials import linear_factor
from data_gen.meshes.mesh import MeshError, load_mesh, mesh_parts

CONTROLLER = """<library_controllers><controller id="c"><skin source="#g"></skin></controller></library_controllers>
<library_visual_scenes>"""


def written(folder, text):
    (folder / "a.dae").write_text(text)
    return folder / "a.dae"


def test_geometry_of_controllers_is_drawn_with_a_warning(tmp_path):
    text = dae_text().replace("<library_visual_scenes>", CONTROLLER)
    text = text.replace('<instance_geometry url="#g">', '<instance_controller url="#c"><skeleton>#j</skeleton>')
    mesh = load_mesh(written(tmp_path, text.replace("</instance_geometry>", "</instance_controller>")))
    assert mesh.face_count == 4
    assert mesh.warnings == ("1 controllers: drawn in the pose of their meshes, not of their skeletons",)


def test_emission_is_as_bright_as_diffuse_colour(tmp_path):
    # 0.5 in sRGB is 0.214 in linear light, for reflected and for emitted light
    glow = "<emission><color>0.5 0 1 1</color></emission><diffuse>"
    text = dae_text(diffuse="<color>0.5 0 1 1</color>").replace("<diffuse>", glow)
    (part,) = mesh_parts(load_mesh(written(tmp_path, text)))
    np.testing.assert_allclose(part.visual.material.emissiveFactor, [0.21404, 0, 1], atol=1e-5)
    np.testing.assert_allclose(linear_factor(part.visual.material)[:3], [0.21404, 0, 1], atol=0.003)


def test_features_that_pycollada_omits_are_named(tmp_path):
    text = dae_text()
    lost = '<node id="n2"><instance_geometry url="#gone"/></node></visual_scene>'
    mesh = load_mesh(written(tmp_path, text.replace("</visual_scene>", lost)))
    assert mesh.face_count == 4
    (line,) = mesh.warnings
    assert "left out" in line
    assert "gone" in line


@pytest.mark.parametrize(("tag", "corners"), [("tristrips", "0 2 1 3"), ("trifans", "0 2 1 3")])
def test_strips_and_fans_are_drawn_without_a_warning(tmp_path, tag, corners):
    text = dae_text().replace('<triangles count="4" material="s">', f'<{tag} count="1" material="s">')
    text = text.replace("</triangles>", f"</{tag}>")
    text = text.replace(" ".join(str(index) for index in np.reshape(TETRAHEDRON_FACES, -1)), corners)
    mesh = load_mesh(written(tmp_path, text))
    assert mesh.face_count == 2
    assert mesh.warnings == ()


def test_for_lines_there_is_a_warning(tmp_path):
    line = '</triangles><lines count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1</p></lines>'
    mesh = load_mesh(written(tmp_path, dae_text().replace("</triangles>", line)))
    assert mesh.warnings == ("1 sets of lines or curves left out, only triangles and polygons are drawn",)


def test_a_controller_of_itself_makes_no_endless_loop(tmp_path):
    text = dae_text().replace("<library_visual_scenes>", CONTROLLER.replace('source="#g"', 'source="#c"'))
    text = text.replace('<instance_geometry url="#g">', '<instance_controller url="#c">')
    with pytest.raises(MeshError, match="found none"):
        load_mesh(written(tmp_path, text.replace("</instance_geometry>", "</instance_controller>")))


@pytest.mark.parametrize(
    ("inside", "opacity"),
    [
        ('<transparent opaque="A_ONE"><color>1 1 1 0.25</color></transparent>', 0.25),
        ('<transparent opaque="RGB_ZERO"><color>0.6 0.6 0.6 1</color></transparent><transparency><float>1</float>'
         "</transparency>", 0.4),
        ('<transparent opaque="A_ONE"><color>0 0 0 1</color></transparent><transparency><float>1</float>'
         "</transparency>", 1.0),
    ],
)  # fmt: skip
def test_transparency_is_drawn_opaque_with_a_warning(tmp_path, inside, opacity):
    """ "Determining Transparency" in the specification of COLLADA 1.4.1."""
    mesh = load_mesh(written(tmp_path, dae_text().replace("</diffuse></lambert>", f"</diffuse>{inside}</lambert>")))
    said = (f"effect 'e': drawn opaque, its opacity of {opacity:g} left out",)
    assert mesh.warnings == (said if opacity < 1 else ())
