"""Sources of truth: trimesh's colours at texture coordinates, pixels by hand, and unit normals."""

from __future__ import annotations

import numpy as np
import pytest
from solid_checks import bare_mesh

from data_gen.shapes import patterns
from data_gen.shapes.materials import Material, brighten, plain, tint
from data_gen.shapes.parts import Part, atlas, build_scene, corner_normals
from data_gen.shapes.primitives import ball, box, cylinder


def _pixel(image, uv):
    """The pixel nearest to texture coordinates, with v up."""
    height, width = image.shape[:2]
    return image[int((1 - uv[1]) * height), int(uv[0] * width)]


def test_the_atlas_has_each_colour_at_the_mapped_coordinates():
    """By hand: corners of a pattern and the centre of a plain block, read through the affine maps."""
    rng = np.random.default_rng(0)
    noise = [
        Material("noise", rng.integers(0, 255, (h, w, 3), dtype=np.uint8)) for h, w in ((64, 64), (56, 224), (112, 112))
    ]
    colours = [plain((int(r), int(g), int(b))) for r, g, b in rng.integers(0, 255, (20, 3))]
    image, maps = atlas([*noise, *colours])
    assert image.shape[1] == 256
    for material, mapping in zip([*noise, *colours], maps, strict=True):
        for uv in ((0, 0), (1, 0), (0, 1), (1, 1)):
            place = np.array(uv) * mapping[:, 0] + mapping[:, 1]
            expected = material.image[-1 if uv[1] == 0 else 0, -1 if uv[0] == 1 else 0]
            np.testing.assert_array_equal(_pixel(image, place), expected)


def test_plain_colours_cannot_bleed():
    """Property: a plain colour has a margin of seven pixels, and all corners of a face have the same coordinates."""
    image, maps = atlas([plain((200, 10, 10)), plain((10, 200, 10))])
    for mapping, colour in zip(maps, ((200, 10, 10), (10, 200, 10)), strict=True):
        assert (mapping[:, 0] == 0).all()
        x, y = int(mapping[0, 1] * image.shape[1]), int((1 - mapping[1, 1]) * image.shape[0])
        assert (image[y - 7 : y + 7, x - 7 : x + 7] == colour).all()


def test_each_part_of_a_scene_has_the_colours_of_its_material():
    """Other implementation: trimesh's conversion of the texture to vertex colours."""
    red, green, blue = plain((200, 20, 20)), plain((20, 200, 20)), plain((20, 20, 200))
    parts = [
        Part.of("left_box", box(1, 1, 1), red).capped(green, first=False),
        Part.of("left_ball", ball(1, 1, 1).moved(3), blue).mirrored(),
        Part.of("cloth", cylinder(1, 1).moved(6), patterns.wood(np.random.default_rng(1), (120, 80, 40))),
    ]
    scene = build_scene("thing", parts)
    mesh = scene.geometry["thing"]
    colours = mesh.visual.to_color().vertex_colors[mesh.faces][:, 0, :3]
    names = [name for name, _, _ in mesh.metadata["parts"]]
    assert names == ["left_box", "right_ball", "cloth"]
    first, count = mesh.metadata["parts"][0][1:]
    up = mesh.face_normals[first : first + count, 1] > 0.5
    assert (colours[:count][up] == (20, 200, 20)).all()
    assert (colours[:count][~up] == (200, 20, 20)).all()
    first, count = mesh.metadata["parts"][1][1:]
    assert (colours[first : first + count] == (20, 20, 200)).all()
    assert mesh.vertices[mesh.faces[first : first + count]][..., 0].max() < -1.9
    first, count = mesh.metadata["parts"][2][1:]
    assert len(np.unique(colours[first : first + count], axis=0)) > 10
    assert mesh.visual.uv.min() >= 0
    assert mesh.visual.uv.max() <= 1
    assert mesh.volume == pytest.approx(sum(part.solid.volume for part in parts), rel=1e-5)


def test_normals_are_flat_across_creases_and_smooth_within():
    """Closed forms: corners of a box have the normals of its faces; normals of a ball point away from its centre."""
    cube = box(1, 1, 1)
    np.testing.assert_allclose(
        corner_normals([cube]), np.repeat(bare_mesh(cube).face_normals[:, None], 3, 1), atol=1e-12
    )
    sphere = ball(1, 1, 1, 32, 16)
    outward = sphere.vertices[sphere.faces]
    assert ((corner_normals([sphere]) * outward).sum(-1) > 0.99).all()


@pytest.mark.parametrize("pattern", [*patterns.PRINTS, patterns.print_of])
def test_prints_repeat_seamlessly_and_depend_only_on_the_generator(pattern):
    """Property: along u, the last and the first column differ as any two neighbouring columns do."""
    for seed in range(6):
        first, second = (pattern(np.random.default_rng(seed), (200, 30, 30), (30, 30, 200)) for _ in range(2))
        np.testing.assert_array_equal(first.image, second.image)
        assert first.image.dtype == np.uint8
        assert first.image.shape == (112, 112, 3)
        steps = np.abs(np.diff(first.image.astype(int), axis=1)).mean((0, 2))
        seam = np.abs(first.image[:, 0].astype(int) - first.image[:, -1]).mean()
        assert seam <= steps.max() + 1


def test_textures_vary_around_their_colour():
    """Statistics: the means of wood and weave are within the stated shades of the colour, and pixels vary."""
    colour = (160, 100, 60)
    for texture in (
        patterns.wood(np.random.default_rng(2), colour, 3),
        patterns.weave(np.random.default_rng(2), colour),
    ):
        mean = texture.image.reshape(-1, 3).mean(0)
        assert (mean > 0.6 * np.array(colour)).all()
        assert (mean < 1.2 * np.array(colour)).all()
        assert texture.image.std() > 5


def test_colours():
    """By hand."""
    assert brighten((100, 50, 250), 1.5) == (150, 75, 255)
    assert tint(np.random.default_rng(0), 0.0, 1.0, 1.0, spread=0.0) == (255, 0, 0)
    assert tint(np.random.default_rng(0), 1 / 3, 1.0, 0.5, spread=0.0) == (0, 128, 0)
