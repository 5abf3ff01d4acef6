"""Reads glTF and GLB files: the meshes of a scene, placed by nodes, skins and instances.

trimesh's reader uses the first texture coordinates for all textures, repeats every texture, ignores morph weights,
skins, instances and quantisation, decodes images that do not fit into memory, and silently loses what it cannot read.
Here trimesh only holds the result.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.util import unique_name

from data_gen.meshes.files import MAX_PARTS, MeshError
from data_gen.meshes.formats.gltf.accessors import check_accessors, read_numbers
from data_gen.meshes.formats.gltf.container import Document, not_negative, open_document
from data_gen.meshes.formats.gltf.materials import GltfMaterial, read_materials
from data_gen.meshes.formats.gltf.primitives import Skinning, read_primitive
from data_gen.meshes.materials import ColourSpace
from data_gen.meshes.model_folder import ModelFolder

__all__ = ["read_gltf"]

_WORLD = "world"


def read_gltf(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, ColourSpace, list[str]]:
    """Read a glTF or, by its name, GLB file, with checks of its buffers and textures.

    Returns:
        Its scene; the colour space of its plain colours (trimesh writes vertex colours as sRGB); and warnings about
        what will not be drawn as the file states.

    Raises:
        MeshError: if the file was cut, is malformed, or requires unsupported features.
    """
    try:
        document = open_document(data, folder)
        check_accessors(document)
        scene = _SceneReader(document, read_materials(document)).read()
        by_trimesh = "trimesh" in str(document.header.get("asset", {}).get("generator", "")).lower()
    except MeshError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
        reason = " ".join(str(error).split())[:200]
        raise MeshError(
            f"{folder.path}: expected a valid glTF, found {type(error).__name__} at {reason}; export it again"
        ) from error
    return scene, "scene" if by_trimesh else "gltf", list(dict.fromkeys(document.warnings))


class _SceneReader:
    """Makes a trimesh.Scene from the nodes of a document."""

    def __init__(self, document: Document, materials: list[GltfMaterial]) -> None:
        self._document, self._materials = document, materials
        self._nodes = document.items("nodes")
        self._scene = trimesh.Scene()
        self._counts: dict[str | None, int] = {}
        self._plain = [self._geometries(mesh, index) for index, mesh in enumerate(document.items("meshes"))]
        self._parts = 0
        self._in_world: dict[Any, npt.NDArray[np.float64]] = {_WORLD: np.eye(4)}  # transforms of frames

    def read(self) -> trimesh.Scene:
        """All nodes of the scene, each under its parent."""
        drawn: list[dict[str, Any]] = []
        for frame_from, index, matrix in self._edges():
            node = self._nodes[index]
            self._scene.graph.update(frame_to=index, frame_from=frame_from, matrix=matrix)
            self._in_world[index] = self._in_world[frame_from] @ matrix
            if "mesh" in node:
                drawn.append(node | {"index": index})
        for node in drawn:
            self._place(node)
        return self._scene

    def _edges(self) -> list[tuple[Any, int, npt.NDArray[np.float64]]]:
        """Frames, their child nodes and transforms, parents first."""
        document = self._document
        scenes = document.items("scenes")
        roots = scenes[not_negative(document.header.get("scene", 0))].get("nodes", []) if scenes else []
        queue: list[tuple[Any, int]] = [(_WORLD, not_negative(root)) for root in roots]
        edges: list[tuple[Any, int, npt.NDArray[np.float64]]] = []
        seen: set[int] = set()
        while queue:
            edge = queue.pop()
            if edge[1] in seen:
                document.warnings.append(f"node {edge[1]} is the child of several nodes; drawn once")
                continue
            seen.add(edge[1])
            node = self._nodes[edge[1]]
            matrix = _matrix(node)
            if not np.isfinite(matrix).all():
                document.warnings.append(f"node {node.get('name', edge[1])}: left out, its transform is not finite")
                continue
            edges.append((*edge, matrix))
            queue += [(edge[1], not_negative(child)) for child in node.get("children", [])]
        return edges

    def _geometries(
        self, mesh: dict[str, Any], index: int, weights: Any = None, skinning: Skinning | None = None
    ) -> list[str]:
        """Names of the geometries made from the primitives of a mesh."""
        label = mesh.get("name") or f"mesh {index}"
        names = []
        for primitive in mesh["primitives"]:
            found = read_primitive(
                self._document,
                primitive,
                label,
                self._materials,
                weights=mesh.get("weights", ()) if weights is None else weights,
                skinning=skinning,
            )
            if found is not None:
                name = unique_name(mesh.get("name", "GLTF"), self._scene.geometry, counts=self._counts)
                self._scene.geometry[name] = found
                names.append(name)
        return names

    def _place(self, node: dict[str, Any]) -> None:
        """Place the mesh of a node in the scene: once, deformed by its skin, or once per instance."""
        index = not_negative(node["mesh"])
        mesh = self._document.items("meshes")[index]
        names, frame = self._plain[index], node["index"]
        if "skin" in node:
            skin = self._document.items("skins")[not_negative(node["skin"])]
            names, frame = self._geometries(mesh, index, node.get("weights"), self._skinning(skin)), _WORLD
        elif "weights" in node:
            names = self._geometries(mesh, index, node["weights"])
        instances = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        matrices = [np.eye(4)] if instances is None else self._instances(instances)
        self._parts += len(names) * len(matrices)
        if self._parts > MAX_PARTS:
            raise MeshError(
                f"{self._document.path}: expected at most {MAX_PARTS} parts, found {self._parts} or more; merge its "
                "nodes or leave some of its instances out"
            )
        for number, matrix in enumerate(matrices):
            for name in names:
                self._scene.graph.update(
                    frame_to=(node["index"], number, name), frame_from=frame, matrix=matrix, geometry=name
                )

    def _skinning(self, skin: dict[str, Any]) -> Skinning:
        matrices = np.stack([self._in_world[not_negative(joint)] for joint in skin["joints"]])
        if "inverseBindMatrices" in skin:
            inverse = read_numbers(self._document, skin["inverseBindMatrices"]).reshape(-1, 4, 4)
            matrices = matrices @ inverse[: len(matrices)].transpose(0, 2, 1)
        return matrices

    def _instances(self, extension: dict[str, Any]) -> npt.NDArray[np.float64]:
        """Transforms `(instance, 4, 4)` of EXT_mesh_gpu_instancing."""
        arrays = {name: read_numbers(self._document, number) for name, number in extension["attributes"].items()}
        count = max((len(array) for array in arrays.values()), default=0)
        if count > MAX_PARTS:
            raise MeshError(
                f"{self._document.path}: expected at most {MAX_PARTS} parts, found {count} instances; leave some out"
            )
        keys = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}
        nodes = [{keys[name]: array[index] for name, array in arrays.items() if name in keys} for index in range(count)]
        return np.stack([_matrix(node) for node in nodes]) if nodes else np.zeros((0, 4, 4))


def _matrix(node: dict[str, Any]) -> npt.NDArray[np.float64]:
    """The transform of a node: its matrix, or translation @ rotation @ scale."""
    matrix = np.eye(4)
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape((4, 4)).T
    if "translation" in node:
        matrix = np.dot(matrix, trimesh.transformations.translation_matrix(node["translation"]))
    if "rotation" in node:
        x, y, z, w = np.reshape(node["rotation"], 4)
        matrix = np.dot(matrix, trimesh.transformations.quaternion_matrix((w, x, y, z)))
    if "scale" in node:
        matrix = np.dot(matrix, np.diag(np.concatenate((node["scale"], [1.0]))))
    return matrix
