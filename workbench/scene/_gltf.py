"""What trimesh leaves out of glTF files (Khronos, glTF 2.0): lights, cameras and the strength of what glows."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.scene.model import Camera, Light

__all__ = ["described", "lights_and_cameras", "strengthened"]

FloatArray = NDArray[np.float64]

_MAGIC, _JSON = b"glTF", 0x4E4F534A
PICTURE_HEIGHT = 512
"""Height of a camera's picture, of which glTF says only the shape. [pixels]"""


def described(data: bytes) -> dict[str, Any]:
    """The JSON of a .gltf or .glb file.

    Raises
    ------
    ValueError
        If there is none.
    """
    if data.startswith(_MAGIC):
        if len(data) < 20:
            raise ValueError("the file ends within its header")
        length, kind = struct.unpack_from("<II", data, 12)
        if kind != _JSON or 20 + length > len(data):
            raise ValueError("found no JSON chunk")
        data = data[20 : 20 + length]
    found = json.loads(data.decode("utf-8-sig"))
    if not isinstance(found, dict):
        raise ValueError("found no glTF object")
    return found


def strengthened(data: bytes, description: dict[str, Any]) -> bytes:
    """The file with each emissive factor multiplied by its strength (KHR_materials_emissive_strength)."""
    strong = False
    for material in description.get("materials", ()):
        strength = material.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength")
        if strength is not None:
            strong = True
            material["emissiveFactor"] = [float(strength) * value for value in material.get("emissiveFactor", (0,) * 3)]
    if not strong:
        return data
    text = json.dumps(description).encode()
    if not data.startswith(_MAGIC):
        return text
    text += b" " * (-len(text) % 4)
    rest = data[20 + struct.unpack_from("<I", data, 12)[0] :]
    return struct.pack("<4sIIII", _MAGIC, 2, 20 + len(text) + len(rest), len(text), _JSON) + text + rest


def _matrix(node: dict[str, Any]) -> FloatArray:
    """From the node's space to its parent's, (4, 4)."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ) * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def lights_and_cameras(description: dict[str, Any]) -> tuple[tuple[Light, ...], dict[str, Camera]]:
    """Lights (KHR_lights_punctual) and perspective cameras of the scene, by their nodes' transforms.

    Candela and lux are read as W/sr and W/m2 as they stand, a spot as even within its outer cone.

    Raises
    ------
    ValueError, TypeError, KeyError, IndexError
        If the description breaks the format.
    """
    nodes = description.get("nodes", [])
    scenes = description.get("scenes", [])
    roots = scenes[description.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
    kinds = description.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights", [])
    lights: list[Light] = []
    cameras: dict[str, Camera] = {}
    waiting = [(index, np.eye(4)) for index in reversed(roots)]
    met = 0
    while waiting:
        index, above = waiting.pop()
        met += 1
        if met > len(nodes):
            raise ValueError("found nodes that contain each other")
        node = nodes[index]
        matrix = above @ _matrix(node)
        waiting += [(child, matrix) for child in reversed(node.get("children", ()))]
        place, ahead, up = matrix[:3, 3], -matrix[:3, 2], matrix[:3, 1]
        which = node.get("extensions", {}).get("KHR_lights_punctual", {}).get("light")
        if which is not None:
            table = kinds[which]
            name = str(table.get("name") or node.get("name") or f"light {len(lights)}")
            power = np.array(table.get("color", (1, 1, 1)), dtype=np.float64) * float(table.get("intensity", 1.0))
            if power.shape != (3,) or not (np.isfinite(power).all() and (power >= 0).all()):
                raise ValueError(f"light {name!r}: found the colour times intensity {power.tolist()}")
            direction = ahead / np.linalg.norm(ahead)
            if table["type"] == "directional":
                lights.append(Light(name, "directional", power, direction=direction))
            elif table["type"] == "spot":
                cone = math.degrees(float(table.get("spot", {}).get("outerConeAngle", math.pi / 4)))
                lights.append(Light(name, "spot", power, position=place, direction=direction, cone_deg=cone))
            elif table["type"] == "point":
                lights.append(Light(name, "point", power, position=place))
            else:
                raise ValueError(f"light {name!r}: found the type {table['type']!r}")
        if "camera" in node:
            table = description["cameras"][node["camera"]]
            if "perspective" in table:
                fov = math.degrees(float(table["perspective"]["yfov"]))
                width = round(PICTURE_HEIGHT * float(table["perspective"].get("aspectRatio", 1.0)))
                if not (0 < fov < 180 and 1 <= width <= 16 * PICTURE_HEIGHT):
                    raise ValueError(f"found a camera of {fov:g} degrees and {width} x {PICTURE_HEIGHT} pixels")
                name = str(node.get("name") or table.get("name") or f"camera {len(cameras)}")
                cameras.setdefault(name, Camera(place, place + ahead, up, fov, width, PICTURE_HEIGHT))
    return tuple(lights), cameras
