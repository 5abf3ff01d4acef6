"""Source of truth: the surface of a unit sphere in closed form."""

import numpy as np
import pytest
import trimesh
from rendered_here import rendered_here

from data_gen.datasets.generate import GenerationConfig, MeshFolder, generate
from hyperplanes.data import Dataset, mesh_path, read_channel, read_views
from hyperplanes.geometry import cameras as camera


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    (folder / "meshes").mkdir()
    trimesh.creation.icosphere(subdivisions=4, radius=7.0).export(folder / "meshes/ball.ply")
    channels = ("rgba", "depth", "normals", "coordinates", "mesh")
    config = GenerationConfig(held_out=0, views=2, resolution=32, workers=1, channels=channels)
    with rendered_here():
        generate(MeshFolder(folder / "meshes"), folder / "out", config)
    return folder / "out"


def test_depth_unprojects_onto_the_surface(ball):
    views, depth = read_views(ball / "ball"), read_channel(ball / "ball", "depth").numpy()
    matrices = camera.intrinsics(views.cameras).double().numpy()
    poses = camera.camera_from_world(views.cameras).double().numpy()
    coordinates = read_channel(ball / "ball", "coordinates").numpy()
    for view in range(2):
        rows, columns = np.nonzero(depth[view])
        assert len(rows) > 300
        rays = np.stack([columns, rows, np.ones(len(rows))], -1) @ np.linalg.inv(matrices[view]).T
        points = (rays * depth[view][rows, columns, None] - poses[view, :3, 3]) @ poses[view, :3, :3]
        footprint = depth[view].max() / matrices[view, 0, 0]
        assert np.abs(points - coordinates[view][rows, columns]).max() < 0.01 * footprint
        assert np.abs(np.linalg.norm(points, axis=-1) - 1).max() < 0.01, "facets lie a little below the sphere"


def test_normals_of_a_sphere_are_its_points(ball):
    normals = read_channel(ball / "ball", "normals").numpy()
    coordinates = read_channel(ball / "ball", "coordinates").numpy()
    seen = read_channel(ball / "ball", "depth").numpy() > 0
    assert np.abs(np.linalg.norm(normals[seen], axis=-1) - 1).max() < 1e-4
    assert (normals[seen] * coordinates[seen]).sum(-1).min() > 0.98


def test_the_mesh_is_where_the_cameras_look(ball):
    mesh = trimesh.load_scene(mesh_path(ball / "ball")).to_mesh()
    assert np.allclose(np.linalg.norm(mesh.vertices, axis=-1), 1.0, atol=1e-5)
    assert Dataset(ball).manifest["objects"]["ball"]["world_from_file"][0][0] == pytest.approx(1 / 7, rel=1e-5)
