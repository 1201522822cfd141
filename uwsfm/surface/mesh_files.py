"""Meshes as PLY, OBJ and GLB."""

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from uwsfm._base.files import replaced_file
from uwsfm._base.ply import write_ply
from uwsfm.color.encoding import light_of
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.surface.atlas import Atlas
from uwsfm.surface.level import Level
from uwsfm.surface.mesh import Mesh

# glTF: x to the right, y up, z towards the viewer. North of the map is away from it.
_GLTF_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_Block = tuple[NDArray[Any], int, str, int]
"""Values, and their component, type and target in glTF."""
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942


def write_mesh_ply(mesh: Mesh, path: Path, unit: str) -> None:
    """Write a binary PLY: x y z (double, world), normals, colours; triangles."""
    kinds = [(name, "<f8") for name in ("x", "y", "z")]
    kinds += [(name, "<f4") for name in ("nx", "ny", "nz")]
    kinds += [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(mesh.vertices), dtype=kinds)
    columns = [*mesh.vertices.T, *mesh.normals.T, *mesh.colors.T]
    for (name, _), values in zip(kinds, columns, strict=True):
        vertices[name] = values
    triple = np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))])
    faces = np.empty(len(mesh.triangles), dtype=triple)
    faces["count"], faces["vertex_indices"] = 3, mesh.triangles
    tables = [("vertex", vertices), ("face", faces)]
    write_ply(path, tables, comment=f"unit: {unit}; uwsfm mesh")


def write_obj(mesh: Mesh, path: Path, unit: str) -> None:
    """Write a Wavefront OBJ in the world frame, with colours after the positions."""
    with replaced_file(path) as partial, partial.open("w", encoding="ascii") as file:
        file.write(f"# unit: {unit}; world frame; uwsfm mesh\n")
        rows = np.hstack([mesh.vertices, mesh.colors / 255.0])
        np.savetxt(file, rows, fmt="v %.6f %.6f %.6f %.4f %.4f %.4f")
        np.savetxt(file, mesh.normals, fmt="vn %.4f %.4f %.4f")
        corners = np.repeat(mesh.triangles + 1, 2, axis=1)
        np.savetxt(file, corners, fmt="f %d//%d %d//%d %d//%d")


def gltf_pose(level: Level) -> Array:
    """Rotation (4,) xyzw from the world to glTF's axes: the map's up becomes y."""
    to_map = Rotation.from_quat(level.map_from_world[:4])
    return (Rotation.from_matrix(_GLTF_FROM_MAP) * to_map).as_quat()


def write_glb(mesh: Mesh, path: Path, level: Level, unit: str) -> None:
    """Write binary glTF 2.0: metres, +y up, colours as light, unlit.

    Positions are stored along the world's axes, from the middle of the mesh (single
    precision), and turned by the node; ``asset.extras`` holds ``world_from_gltf``, the
    pose that leads from the turned positions back to the world, and the unit.
    """
    # The standard has vertex colours linear: they are multiplied, not shown.
    light = np.ones((len(mesh.vertices), 4))
    light[:, :3] = light_of(mesh.colors, "srgb")
    block = np.rint(65535.0 * light).astype("<u2"), _USHORT, "VEC4", _ARRAY_BUFFER
    _write_binary(*_document(mesh, level, unit, "COLOR_0", block), path)


def write_textured_glb(
    atlas: Atlas, image: NDArray[np.uint8], path: Path, level: Level, unit: str
) -> None:
    """As `write_glb`, with a picture in place of colours.

    Args:
        atlas: of the mesh.
        image: (height, width, 3) red, green, blue; stored as JPEG.
        path: the file.
        level: what is up.
        unit: of lengths.
    """
    block = atlas.uv.astype("<f4"), _FLOAT, "VEC2", _ARRAY_BUFFER
    document, blocks = _document(atlas.mesh, level, unit, "TEXCOORD_0", block)
    ok, jpeg = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    assert ok
    document["images"] = [{"bufferView": len(blocks), "mimeType": "image/jpeg"}]
    document["textures"] = [{"source": 0}]
    material = document["materials"][0]["pbrMetallicRoughness"]
    material["baseColorTexture"] = {"index": 0}
    _write_binary(document, blocks, path, jpeg.tobytes())


def _document(
    mesh: Mesh, level: Level, unit: str, color: str, block: _Block
) -> tuple[dict[str, Any], list[_Block]]:
    """A glTF document of a mesh, and its arrays; ``block`` holds the attribute
    ``color`` of the vertices."""
    middle = np.round(mesh.vertices.mean(axis=0), 3)
    blocks: list[_Block] = [
        ((mesh.vertices - middle).astype("<f4"), _FLOAT, "VEC3", _ARRAY_BUFFER),
        (mesh.normals.astype("<f4"), _FLOAT, "VEC3", _ARRAY_BUFFER),
        block,
        (mesh.triangles.astype("<u4").reshape(-1, 1), _UINT, "SCALAR", _ELEMENT_BUFFER),
    ]
    quat = gltf_pose(level)
    turned = np.concatenate([quat, np.zeros(3)])
    world_from_gltf = rigid3.inverse(turned)
    world_from_gltf[4:] = middle
    document: dict[str, Any] = {
        "asset": {
            "version": "2.0",
            "generator": "uwsfm",
            "extras": {
                "unit": unit,
                "up": level.method,
                "world_from_gltf": {
                    "rotation_xyzw": world_from_gltf[:4].tolist(),
                    "translation_m": world_from_gltf[4:].tolist(),
                },
            },
        },
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "uwsfm", "mesh": 0, "rotation": quat.tolist()}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "NORMAL": 1, color: 2},
                        "indices": 3,
                        "material": 0,
                    }
                ]
            }
        ],
        "materials": [
            {
                "doubleSided": True,
                "pbrMetallicRoughness": {"metallicFactor": 0.0},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
    }
    return document, blocks


def _write_binary(
    document: dict[str, Any], blocks: list[_Block], path: Path, picture: bytes = b""
) -> None:
    """A glTF document, its arrays and a picture behind them, in one file."""
    offset, data = 0, []
    document["bufferViews"], document["accessors"] = [], []
    for index, (values, component, kind, target) in enumerate(blocks):
        document["bufferViews"].append(
            {
                "buffer": 0,
                "byteOffset": offset,
                "byteLength": values.nbytes,
                "target": target,
            }
        )
        accessor = {
            "bufferView": index,
            "componentType": component,
            "count": len(values),
            "type": kind,
        }
        if component == _USHORT:
            accessor["normalized"] = True
        if index == 0:  # the standard asks for the bounds of positions
            accessor["min"] = values.min(axis=0).tolist()
            accessor["max"] = values.max(axis=0).tolist()
        document["accessors"].append(accessor)
        padding = -values.nbytes % 4
        data.append(values.tobytes() + bytes(padding))
        offset += values.nbytes + padding
    if picture:
        view = {"buffer": 0, "byteOffset": offset, "byteLength": len(picture)}
        document["bufferViews"].append(view)
        data.append(picture + bytes(-len(picture) % 4))
        offset += len(data[-1])
    document["buffers"] = [{"byteLength": offset}]
    text = json.dumps(document, allow_nan=False).encode("utf-8")
    text += b" " * (-len(text) % 4)
    with replaced_file(path) as partial, partial.open("wb") as file:
        file.write(struct.pack("<III", _MAGIC, 2, 28 + len(text) + offset))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", offset, _BIN))
        file.writelines(data)
