"""Where the meshes of a glTF scene stand: the node tree, walked without recursion."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendra.io._gltf_asset import Asset
from rendra.io._gltf_json import Item

Matrix = npt.NDArray[np.float64]

_IDENTITY = np.eye(4)


@dataclass(frozen=True)
class Instance:
    """One mesh of the scene.

    Attributes:
        mesh: its index.
        to_world: (4, 4), for column vectors; None for a mesh that stays where it is.
        node: where the node stands in the file.
        skinned: whether the node bends the mesh with a skin.
    """

    mesh: int
    to_world: Matrix | None
    node: str
    skinned: bool


def instances(asset: Asset) -> list[Instance]:
    """Every mesh of the default scene, of all nodes where there is no scene, of all meshes where there is no node.

    Raises:
        MeshFormatError: a node has two parents or is its own ancestor, or a transform is not finite.
    """
    if not asset.nodes:
        return [Instance(i, None, mesh.where, False) for i, mesh in enumerate(asset.meshes)]
    found: list[Instance] = []
    waiting = [(root, _IDENTITY) for root in reversed(_roots(asset))]
    seen: set[int] = set()
    while waiting:
        number, parent = waiting.pop()
        node = asset.nodes[number]
        if number in seen:
            node.fail(None, "the node has two parents, or is its own ancestor")
        seen.add(number)
        to_world = _chained(parent, node)
        mesh = node.index("mesh", len(asset.meshes), "meshes")
        if mesh is not None:
            moved = None if np.array_equal(to_world, _IDENTITY) else to_world
            found.append(Instance(mesh, moved, node.where, "skin" in node))
        children = node.indices("children", len(asset.nodes), "nodes")
        waiting += [(child, to_world) for child in reversed(children)]
    return found


def _roots(asset: Asset) -> list[int]:
    scenes = asset.root.items("scenes")
    if scenes:
        default = asset.root.index("scene", len(scenes), "scenes") or 0
        return scenes[default].indices("nodes", len(asset.nodes), "nodes")
    below = {child for node in asset.nodes for child in node.indices("children", len(asset.nodes), "nodes")}
    roots = [number for number in range(len(asset.nodes)) if number not in below]
    if not roots:
        asset.nodes[0].fail(None, "every node is the child of another, so the nodes form a circle")
    return roots


def _chained(parent: Matrix, node: Item) -> Matrix:
    """(4, 4) from the node to the world."""
    if not any(key in node for key in ("matrix", "translation", "rotation", "scale")):
        return parent
    with np.errstate(over="ignore", invalid="ignore"):
        to_world = parent @ _local(node)
    if not np.isfinite(to_world).all():
        node.fail(None, "the transform is not finite")
    return to_world


def _local(node: Item) -> Matrix:
    """(4, 4) from the node to its parent."""
    if "matrix" in node:
        matrix = node.numbers("matrix", _IDENTITY.ravel().tolist()).reshape(4, 4).T  # columns first
        if not np.array_equal(matrix[3], _IDENTITY[3]):
            node.fail("matrix", "is no affine transform", matrix[3].tolist(), "0, 0, 0, 1 as the last row")
        return matrix
    local = np.eye(4)
    if "rotation" in node:
        local[:3, :3] = _rotation(node)
    if "scale" in node:
        local[:3, :3] *= node.numbers("scale", [1.0, 1.0, 1.0])
    if "translation" in node:
        local[:3, 3] = node.numbers("translation", [0.0, 0.0, 0.0])
    return local


def _rotation(node: Item) -> Matrix:
    """(3, 3) of the unit quaternion x, y, z, w, made one where it is not quite."""
    quaternion = node.numbers("rotation", [0.0, 0.0, 0.0, 1.0]).tolist()
    length = math.hypot(*quaternion)
    if length == 0.0:
        node.fail("rotation", "is a quaternion of length 0", expected="a unit quaternion")
    if math.isinf(length):
        node.fail("rotation", "is no unit quaternion", quaternion, "a unit quaternion")
    x, y, z, w = (each / length for each in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
