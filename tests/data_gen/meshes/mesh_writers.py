"""Writers of small mesh files byte by byte, so that tests do not depend on the exporter of a library."""

import io
import json
import struct

import numpy as np
import PIL.Image

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.uint32)
SQUARE_UV = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=np.float32)


def picture(mode="RGB", size=(4, 4), colour=None):
    """The bytes of a PNG of one colour."""
    stream = io.BytesIO()
    PIL.Image.new(mode, size, colour).save(stream, "PNG")
    return stream.getvalue()


def gltf(
    positions=TETRAHEDRON,
    faces=TETRAHEDRON_FACES,
    *,
    uv=None,
    normals=None,
    colours=None,
    material=None,
    image=None,
    nodes=None,
    mode=4,
):
    """The JSON and the buffer of a glTF with one mesh."""
    views, accessors, chunks = [], [], []

    def add(array, kind, component):
        data = array.tobytes()
        views.append({"buffer": 0, "byteOffset": sum(map(len, chunks)), "byteLength": len(data)})
        chunks.append(data + b"\0" * (-len(data) % 4))
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "count": len(array), "type": kind})
        return len(accessors) - 1

    attributes = {"POSITION": add(np.asarray(positions, dtype=np.float32), "VEC3", 5126)}
    primitive = {"attributes": attributes, "mode": mode}
    if faces is not None:
        primitive["indices"] = add(np.asarray(faces, dtype=np.uint32).reshape(-1), "SCALAR", 5125)
    if uv is not None:
        attributes["TEXCOORD_0"] = add(np.asarray(uv, dtype=np.float32), "VEC2", 5126)
    if normals is not None:
        attributes["NORMAL"] = add(np.asarray(normals, dtype=np.float32), "VEC3", 5126)
    if colours is not None:
        colours = np.asarray(colours)
        components = {"uint8": 5121, "uint16": 5123}
        kept = colours if colours.dtype.name in components else colours.astype(np.float32)
        attributes["COLOR_0"] = add(kept, "VEC4", components.get(kept.dtype.name, 5126))
        accessors[-1]["normalized"] = kept.dtype.kind == "u"
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes or [0])))}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"name": "solid", "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
    }
    if material is not None or image is not None:
        material = {"name": "paint", **(material or {})}
        if image is not None:
            material.setdefault("pbrMetallicRoughness", {})["baseColorTexture"] = {"index": 0}
            views.append({"buffer": 0, "byteOffset": sum(map(len, chunks)), "byteLength": len(image)})
            chunks.append(image + b"\0" * (-len(image) % 4))
            header["images"] = [{"bufferView": len(views) - 1, "mimeType": "image/png", "name": "wood"}]
            header["textures"] = [{"source": 0}]
        header["materials"] = [material]
        primitive["material"] = 0
    buffer = b"".join(chunks)
    header["buffers"] = [{"byteLength": len(buffer)}]
    return header, buffer


def glb_bytes(header, buffer):
    """A GLB file."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(buffer)
    return (
        b"glTF"
        + struct.pack("<2I", 2, total)
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(buffer), b"BIN\0")
        + buffer
    )


def write_glb(path, **keywords):
    """Write a GLB file and return its path."""
    path.write_bytes(glb_bytes(*gltf(**keywords)))
    return path


def write_gltf(folder, *, change=None, **keywords):
    """Write a glTF file with a changed JSON and with its buffer next to it, and return its path."""
    header, buffer = gltf(**keywords)
    header["buffers"][0]["uri"] = "mesh.bin"
    (folder / "mesh.bin").write_bytes(buffer)
    if change is not None:
        change(header)
    path = folder / "mesh.gltf"
    path.write_text(json.dumps(header))
    return path


OBJ_SOLID = """v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vt 0 1
vt 1 1
"""
OBJ_FACES = """f 1/1 3/3 2/2
f 1/1 2/2 4/4
f 1/1 4/4 3/3
f 2/2 3/3 4/4
"""


def write_obj(folder, *, mtl=None, texture=None, body=OBJ_SOLID + "usemtl paint\n" + OBJ_FACES, name="mesh.obj"):
    """Write an OBJ file, its MTL and its texture ``wood.png``, and return its path."""
    path = folder / name
    path.write_text(("mtllib mesh.mtl\n" if mtl is not None else "") + body, encoding="utf-8")
    if mtl:
        (folder / "mesh.mtl").write_text(mtl, encoding="utf-8")
    if texture is not None:
        (folder / "wood.png").write_bytes(texture)
    return path


def ply_bytes(*, binary=True, positions=TETRAHEDRON, faces=TETRAHEDRON_FACES, colours=None):
    """A PLY file with triangles and, if given, colours of the vertices."""
    kind = "binary_little_endian" if binary else "ascii"
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(positions)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    if colours is not None:
        head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue", "alpha"))
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    body = b""
    for index, point in enumerate(positions):
        extra = [] if colours is None else [int(value) for value in colours[index]]
        if binary:
            body += struct.pack("<3f", *point) + bytes(extra)
        else:
            body += (" ".join(map(str, [*(float(value) for value in point), *extra])) + "\n").encode()
    for face in faces:
        body += struct.pack("<B3i", 3, *face) if binary else ("3 " + " ".join(map(str, face)) + "\n").encode()
    return head.encode() + body


def stl_bytes(*, binary=True, positions=TETRAHEDRON, faces=TETRAHEDRON_FACES):
    """An STL file."""
    if binary:
        body = b"".join(struct.pack("<12fH", 0, 0, 0, *positions[face].reshape(-1), 0) for face in faces)
        return b"\0" * 80 + struct.pack("<I", len(faces)) + body
    lines = ["solid mesh"]
    for face in faces:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += ["vertex " + " ".join(str(float(value)) for value in positions[corner]) for corner in face]
        lines += ["endloop", "endfacet"]
    return ("\n".join(lines) + "\nendsolid mesh\n").encode()


def off_text(*, positions=TETRAHEDRON, faces=TETRAHEDRON_FACES, head="OFF", vertex_tail="", face_tails=("",) * 4):
    """An OFF file."""
    lines = [head, f"{len(positions)} {len(faces)} 0"]
    lines += [" ".join(str(float(value)) for value in point) + vertex_tail for point in positions]
    lines += [f"3 {face[0]} {face[1]} {face[2]}{tail}" for face, tail in zip(faces, face_tails, strict=True)]
    return "\n".join(lines) + "\n"


def dae_text(*, up="Y_UP", diffuse="<color>1 0.5 0 1</color>", extra="", images="", positions=TETRAHEDRON):
    """A COLLADA file."""
    points = " ".join(str(float(value)) for value in np.asarray(positions).reshape(-1))
    corners = " ".join(str(index) for index in TETRAHEDRON_FACES.reshape(-1))
    return f"""<?xml version="1.0" encoding="utf-8"?>{extra}
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified><up_axis>{up}</up_axis></asset>
{images}
<library_effects><effect id="e"><profile_COMMON><technique sid="t"><lambert><diffuse>{diffuse}</diffuse></lambert>
</technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m" name="paint"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="12">{points}</float_array><technique_common>
<accessor source="#pa" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4" material="s"><input semantic="VERTEX" source="#v" offset="0"/><p>{corners}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="vs"><node id="n"><translate>5 0 0</translate><instance_geometry url="#g">
<bind_material><technique_common><instance_material symbol="s" target="#m"/></technique_common></bind_material>
</instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#vs"/></scene></COLLADA>
"""
