"""Properties of the objects of all classes except `random`, which has its own tests.

Sources of truth: trimesh's topology and volume, solid_checks' brute force, hashes.
"""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from data_gen.shapes import CLASSES, assemble, make

sys.path.insert(0, str(Path(__file__).parent))
from solid_checks import bare_mesh, digest, fighting, islands, touch

SEEDS = range(5)
KINDS = tuple(name for name in CLASSES if name != "random")
assemble, make = cache(assemble), cache(make)


@pytest.mark.parametrize("class_name", KINDS)
def test_every_part_is_watertight_oriented_outwards_and_has_its_volume(class_name):
    for seed in range(15):
        parts = assemble(class_name, seed)
        assert len({part.name for part in parts}) == len(parts)
        for part in parts:
            mesh = bare_mesh(part.solid)
            assert mesh.is_watertight, (seed, part.name)
            assert mesh.is_winding_consistent, (seed, part.name)
            assert mesh.volume == pytest.approx(part.solid.volume, rel=1e-6), (seed, part.name)
            assert part.solid.volume > 0, (seed, part.name)


@pytest.mark.parametrize("class_name", KINDS)
def test_all_parts_are_connected_and_no_faces_coincide(class_name):
    """Brute force: intersections connect all parts; faces of different colours are 1/5000 of the size apart."""
    for seed in SEEDS:
        parts = assemble(class_name, seed)
        groups = islands(parts)
        assert len(groups) == 1, (seed, groups[1:])
        size = np.ptp(np.concatenate([part.solid.vertices for part in parts]), axis=0).max()
        assert not fighting(parts, 2e-4 * size), seed


def test_the_brute_force_finds_gaps_nesting_and_coincident_faces():
    """By hand: boxes with a gap between them, one box inside another, and a plate level with a face."""
    from data_gen.shapes.materials import plain
    from data_gen.shapes.parts import Part
    from data_gen.shapes.primitives import box

    red, blue = plain((255, 0, 0)), plain((0, 0, 255))
    cube = Part.of("cube", box(1, 1, 1), red)
    apart, inside = Part.of("apart", box(1, 1, 1).moved(1.01), blue), Part.of("inside", box(0.2, 0.2, 0.2), blue)
    assert not touch(cube, apart)
    assert touch(cube, inside)
    assert islands([cube, apart, inside]) == [["cube", "inside"], ["apart"]]
    flush = Part.of("flush", box(0.5, 0.2, 0.5).moved(0, 0.4), blue)
    assert {tuple(sorted(pair)) for pair in fighting([cube, flush], 1e-4)} == {("cube", "flush")}
    assert not fighting([cube, Part.of("proud", box(0.5, 0.2, 0.5).moved(0, 0.41), blue)], 1e-4)


@pytest.mark.parametrize("class_name", KINDS)
def test_a_scene_is_one_textured_mesh_of_limited_size(class_name):
    for seed in SEEDS:
        scene = make(class_name, seed)
        assert list(scene.geometry) == [class_name]
        mesh = scene.geometry[class_name]
        assert 150 < len(mesh.faces) < 3500
        assert np.isfinite(mesh.vertices).all()
        assert mesh.visual.uv.shape == (len(mesh.vertices), 2)
        assert mesh.visual.material.baseColorTexture.mode == "RGB"
        assert max(mesh.visual.material.baseColorTexture.size) <= 1024
        np.testing.assert_allclose(np.linalg.norm(mesh.vertex_normals, axis=1), 1, atol=1e-5)
        assert ((mesh.vertex_normals[mesh.faces] * mesh.face_normals[:, None]).sum(-1) > 0).mean() > 0.97
        assert sum(count for _, _, count in mesh.metadata["parts"]) == len(mesh.faces)
        assert mesh.volume == pytest.approx(sum(p.solid.volume for p in assemble(class_name, seed)), rel=1e-3)


def test_no_two_objects_are_equal():
    """By hashes of vertices, faces, normals, texture coordinates and pixels."""
    digests = [digest(make(class_name, seed)) for class_name in CLASSES for seed in (*SEEDS, 8, 256, 65536)]
    assert len(set(digests)) == len(digests)


def test_random_objects_did_not_change_objects_of_the_other_classes():
    """Hashes of objects from before there were random ones. Another numpy may draw other numbers."""
    expected = {"car": "b1bfc036", "chair": "c041a84d", "plane": "e1c27eb6", "lamp": "5317c6c7"}
    assert {name: digest(make(name, 3))[:8] for name in KINDS} == expected


def test_two_processes_make_the_same_bytes():
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from solid_checks import digest; from data_gen.shapes import CLASSES, make\n"
        "sys.stdout.write(' '.join(digest(make(name, 3)) for name in CLASSES))"
    )
    root = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.split() == [digest(make(name, 3)) for name in CLASSES]


def test_y_is_up_and_the_front_is_along_z():
    """By names of parts: lamps of cars, backs and seats of chairs, fins of planes. Feet and tyres are at y = 0."""
    for seed in SEEDS:
        car = {part.name: part.solid.vertices for part in assemble("car", seed)}
        assert car["left_headlamp"][:, 2].mean() > 1 > -1 > car["left_tail_lamp"][:, 2].mean()
        assert car["left_headlamp"][:, 0].mean() > 0 > car["right_headlamp"][:, 0].mean()
        assert min(vertices[:, 1].min() for vertices in car.values()) == pytest.approx(0, abs=0.01)
        chair = assemble("chair", seed)
        assert min(part.solid.vertices[:, 1].min() for part in chair) == pytest.approx(0, abs=0.025)
        for part in chair:
            if part.name.startswith(("back", "slat", "spindle")):
                assert part.solid.vertices[:, 2].mean() < -0.1
        plane = {part.name: part.solid.vertices for part in assemble("plane", seed)}
        fin = plane["fin"] if "fin" in plane else plane["left_fin"]
        assert fin[:, 2].mean() < plane["fuselage"][:, 2].mean()
        assert fin[:, 1].max() > plane["fuselage"][:, 1].max()


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match="class: expected one of car, chair, plane, lamp, random, got 'boat'"):
        make("boat", 0)
    with pytest.raises(ValueError, match="seed: expected a non-negative integer, got -1"):
        make("car", -1)


def test_importing_the_package_loads_little():
    code = "import sys, data_gen; sys.exit('trimesh' in sys.modules or 'PIL' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=Path(__file__).parents[3]).returncode == 0
