"""Bakes the free body: bodies of `anny` (data CC0, code Apache-2.0) as one file of SMPL's layout.

    python -m venv .venv-bake && .venv-bake/bin/pip install -r requirements.txt
    .venv-bake/bin/python bake.py ../../src/rendra/body/data

Adults of all shapes are drawn, put into a T-pose with anny's own skeleton, and their vertices analysed: ten
directions span nearly all of what differs. Bones are gathered into SMPL's 24 joints, which vertices regress as in
SMPL. Lengths are metres, y is up, the body looks along +z with its left arm along +x; the pelvis is the origin.
Loper et al., "SMPL", 2015 (the layout); Bregier et al., "Human Mesh Modeling for Anny Body", 2025 (the bodies).
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import anny
import numpy as np
import torch
from scipy.optimize import nnls

NUM_BETAS = 10
NUM_BODIES = 1200
BODIES_AT_ONCE = 50
SLOTS = 4  # joints that move one vertex
REGRESSED_FROM = 300  # vertices about each joint are candidates,
REGRESSED_BY = 32  # at most so many are taken
LEGS_APART = 0.05  # sideways over downwards, of the legs of a T-pose
STATURES = (10, 18)  # of a beta distribution of anny's heights: statures of 1.75 m, standard deviation 0.1 m
LOCAL_SPREAD = 0.5  # standard deviation of anny's local changes, whose range is [-1, 1]
# What clothes-free bodies differ in beside anny's phenotypes; left and right change alike.
LOCAL_CHANGES = (
    "stomach-tone-incr", "buttocks-volume-incr", "hip-scale-horiz-incr", "hip-scale-depth-incr", "hip-waist-up",
    "torso-scale-horiz-incr", "torso-scale-depth-incr", "torso-scale-vert-incr", "torso-vshape-incr",
    "head-scale-vert-incr", "head-scale-horiz-incr", "neck-scale-vert-incr", "neck-scale-horiz-incr",
    "upperleg-fat-incr", "lowerleg-fat-incr", "upperleg-muscle-incr", "lowerleg-muscle-incr",
    "upperleg-scale-vert-incr", "lowerleg-scale-vert-incr", "upperarm-scale-vert-incr", "lowerarm-scale-vert-incr",
    "upperarm-fat-incr", "lowerarm-fat-incr", "upperarm-muscle-incr", "foot-scale-incr", "hand-scale-incr",
    "stomach-pregnant-incr", "pelvis-tone-incr", "bulge-incr",
)  # fmt: skip

# SMPL's joints in order: their names, parents, the bones of anny that move with each, and the bone it lies at.
SIDES = (("left", "L"), ("right", "R"))
JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
TRUNK = {
    "pelvis": ("root", "spine05"),
    "spine1": ("spine04", "spine03"),
    "spine2": ("spine02",),
    "spine3": ("spine01",),
    "neck": ("neck01", "neck02", "neck03"),
    "head": ("head", "eye.L", "eye.R"),
}
LIMBS = {
    "hip": ("upperleg01", "upperleg02"),
    "knee": ("lowerleg01", "lowerleg02"),
    "ankle": ("foot",),
    "foot": ("toe",),
    "collar": ("clavicle", "shoulder01"),
    "shoulder": ("upperarm01", "upperarm02"),
    "elbow": ("lowerarm01", "lowerarm02"),
    "wrist": ("wrist", "metacarpal"),
    "hand": ("finger",),
}
KNUCKLES = tuple(f"finger{finger}-1" for finger in (2, 3, 4, 5))
TOES = tuple(f"toe{toe}-1" for toe in (1, 2, 3, 4, 5))


@dataclass
class Bodies:
    """B bodies: what anny says of each, in our axes."""

    verts: np.ndarray  # (B, V, 3)
    heads: np.ndarray  # (B, bones, 3)


class Source:
    """anny, asked for bodies at rest."""

    def __init__(self, topology: str) -> None:
        self.model = anny.Anny(local_changes="default", topology=topology).to(dtype=torch.float32)
        self.bones = list(self.model.bone_labels)
        self.parents = list(self.model.bone_parents)
        faces = np.asarray(self.model.faces)
        self.faces = faces if faces.shape[1] == 3 else np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
        count = len(self.bones)
        rows, slots = self.model.vertex_bone_indices.numpy(), self.model.vertex_bone_weights.numpy()
        self.weights = np.zeros((len(rows), count))
        np.add.at(self.weights, (np.arange(len(rows))[:, None], rows), slots)

    def bodies(self, phenotypes: dict[str, np.ndarray], changes: dict[str, np.ndarray]) -> Bodies:
        """Bodies at rest, (B,) numbers a name."""
        verts, heads = [], []
        count = len(next(iter(phenotypes.values())))
        for first in range(0, count, BODIES_AT_ONCE):
            some = slice(first, first + BODIES_AT_ONCE)
            with torch.no_grad():
                found = self.model(
                    phenotype_kwargs={name: torch.tensor(value[some]).float() for name, value in phenotypes.items()},
                    local_changes_kwargs={name: torch.tensor(value[some]).float() for name, value in changes.items()},
                )
            verts.append(upright(found["rest_vertices"].numpy()))
            heads.append(upright(found["rest_bone_heads"].numpy()))
        return Bodies(np.concatenate(verts).astype(np.float64), np.concatenate(heads).astype(np.float64))

    def bone(self, name: str, side: str = "") -> int:
        """The index of a bone."""
        return self.bones.index(f"{name}.{side}" if side else name)


def upright(points: np.ndarray) -> np.ndarray:
    """From anny's axes (z up, looking along -y) to SMPL's (y up, looking along +z)."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def joint_of_bones(source: Source) -> np.ndarray:
    """The joint (bones,) that each bone moves with."""
    joint = np.full(len(source.bones), -1)
    for name, bones in TRUNK.items():
        for bone in bones:
            joint[source.bone(bone)] = JOINTS.index(name)
    for side, letter in SIDES:
        joint[source.bone("pelvis", letter)] = 0
        for part, prefixes in LIMBS.items():
            for index, bone in enumerate(source.bones):
                if bone.endswith(f".{letter}") and bone.startswith(prefixes):
                    joint[index] = JOINTS.index(f"{side}_{part}")
    assert (joint >= 0).all(), [bone for bone, found in zip(source.bones, joint, strict=True) if found < 0]
    return joint


def joint_places(source: Source, heads: np.ndarray) -> np.ndarray:
    """Where SMPL's joints (B, 24, 3) lie: at the bone that each begins with; the pelvis a little above the hips."""
    places = np.empty((len(heads), len(JOINTS), 3))
    for name, bones in TRUNK.items():
        places[:, JOINTS.index(name)] = heads[:, source.bone(bones[0])]
    for side, letter in SIDES:
        for part, prefixes in LIMBS.items():
            if part in ("hand", "foot"):
                rows = [source.bone(bone, letter) for bone in (KNUCKLES if part == "hand" else TOES)]
                place = heads[:, rows].mean(1)
            else:
                place = heads[:, source.bone(prefixes[0], letter)]
            places[:, JOINTS.index(f"{side}_{part}")] = place
    hips = (places[:, 1] + places[:, 2]) / 2
    places[:, 0] = hips + 0.25 * (places[:, JOINTS.index("spine1")] - hips)
    return places


def turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The smallest rotations (B, 3, 3) that turn directions (B, 3) into others."""
    start, end = (vector / np.linalg.norm(vector, axis=-1, keepdims=True) for vector in (start, end))
    axis, cosine = np.cross(start, end), (start * end).sum(-1)
    zero = np.zeros(len(axis))
    x, y, z = axis.T
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    return np.eye(3) + cross + cross @ cross / (1 + cosine)[:, None, None]


def t_pose(source: Source, bodies: Bodies) -> Bodies:
    """The bodies with straight arms to the sides, palms down, and straight legs, by anny's skeleton and weights."""
    count, heads = len(bodies.heads), bodies.heads
    turns = np.tile(np.eye(3), (count, len(source.bones), 1, 1))  # of each bone, in the world
    for _, letter in SIDES:
        out = np.array([1.0 if letter == "L" else -1.0, 0.0, 0.0])
        down = np.array([LEGS_APART * out[0], -1.0, 0.0])
        for chain, goal in (
            (("upperarm01", "lowerarm01", "wrist"), out),
            (("upperleg01", "lowerleg01", "foot"), down),
        ):
            places = [heads[:, source.bone(bone, letter)] for bone in chain]
            for first, last, bone in zip(places[:-1], places[1:], chain[:-1], strict=True):
                turned = turn(last - first, np.broadcast_to(goal, first.shape))
                turns[:, source.bone(bone, letter)] = turned
        _straighten_hand(source, heads, turns, letter, out)
    owner = _nearest_turned(source)
    turns = turns[:, owner]
    moved = heads.copy()
    for bone, parent in enumerate(source.parents):
        if parent >= 0:
            apart = heads[:, bone] - heads[:, parent]
            moved[:, bone] = moved[:, parent] + np.einsum("bij,bj->bi", turns[:, parent], apart)
    shift = moved - np.einsum("bkij,bkj->bki", turns, heads)
    verts = np.empty_like(bodies.verts)
    for index in range(count):  # one at a time: (V, bones) times (bones, 12) is small
        blend = np.concatenate([turns[index].reshape(-1, 9), shift[index]], axis=1)
        row = source.weights @ blend
        verts[index] = np.einsum("vij,vj->vi", row[:, :9].reshape(-1, 3, 3), bodies.verts[index]) + row[:, 9:]
    return Bodies(verts, moved)


def _straighten_hand(source: Source, heads: np.ndarray, turns: np.ndarray, letter: str, out: np.ndarray) -> None:
    """The hand goes on along the arm, its knuckles from front to back; half of its roll is the forearm's."""
    wrist = heads[:, source.bone("wrist", letter)]
    middle = np.mean([heads[:, source.bone(bone, letter)] for bone in KNUCKLES], axis=0)
    fore, little = heads[:, source.bone("finger2-1", letter)], heads[:, source.bone("finger5-1", letter)]
    along = turn(middle - wrist, np.broadcast_to(out, wrist.shape))
    across = np.einsum("bij,bj->bi", along, fore - little)
    across[:, 0] = 0
    roll = turn(across, np.broadcast_to([0.0, 0.0, 1.0], across.shape))
    turns[:, source.bone("wrist", letter)] = roll @ along
    elbow = turns[:, source.bone("lowerarm01", letter)]
    after = turn(
        np.einsum("bij,bj->bi", elbow, fore - little) * [0, 1, 1], np.broadcast_to([0.0, 0, 1], across.shape)
    )
    turns[:, source.bone("lowerarm02", letter)] = _half(after) @ elbow


def _half(rotation: np.ndarray) -> np.ndarray:
    """Rotations about x by half the angle."""
    angle = np.arctan2(rotation[:, 2, 1], rotation[:, 1, 1]) / 2
    half = np.tile(np.eye(3), (len(angle), 1, 1))
    half[:, 1, 1] = half[:, 2, 2] = np.cos(angle)
    half[:, 2, 1] = np.sin(angle)
    half[:, 1, 2] = -half[:, 2, 1]
    return half


def _nearest_turned(source: Source) -> list[int]:
    """For each bone the nearest ancestor, or itself, whose turn is set; feet and the trunk keep their own: none."""
    parts = ("upperarm01", "lowerarm01", "lowerarm02", "wrist", "upperleg01", "lowerleg01", "foot", "root")
    set_bones = {index for index, bone in enumerate(source.bones) if bone.split(".")[0] in parts}
    owners = []
    for bone in range(len(source.bones)):
        while bone not in set_bones and source.parents[bone] >= 0:
            bone = source.parents[bone]
        owners.append(bone)
    return owners


def draw(source: Source, rng: np.random.Generator, count: int) -> tuple[dict, dict]:
    """Phenotypes and local changes of adults of all shapes."""
    spread = {name: rng.uniform(0, 1, count) for name in source.model.phenotype_labels}
    spread["age"] = rng.uniform(0.55, 1.0, count)  # 2/3 is a young adult, 1 is old
    spread["height"] = rng.beta(*STATURES, count)
    changes = {}
    for part in LOCAL_CHANGES:
        value = np.clip(LOCAL_SPREAD * rng.standard_normal(count), -1, 1)
        names = [name for name in (part, f"l-{part}", f"r-{part}") if name in source.model.local_change_labels]
        changes |= dict.fromkeys(names, value)
    return spread, changes


def regress(verts: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (24, n) and weights (24, n) >= 0, of sum 1, whose mean is each joint, in all bodies."""
    rows, weights = [], []
    for joint in range(places.shape[1]):
        target = places[:, joint]
        near = np.argsort(np.linalg.norm(verts.mean(0) - target.mean(0), axis=1))[:REGRESSED_FROM]
        system = verts[:, near].transpose(0, 2, 1).reshape(-1, len(near))
        system = np.concatenate([system, 1e3 * np.ones((1, len(near)))])
        solution, _ = nnls(system, np.append(target.reshape(-1), 1e3))
        best = np.argsort(-solution)[:REGRESSED_BY]
        rows.append(near[best])
        weights.append(solution[best] / solution[best].sum())
    return np.array(rows), np.array(weights)


def quantized(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """16-bit numbers and the scale that makes them lengths again; a scale for each index of the last axis."""
    scale = np.abs(values).max(tuple(range(values.ndim - 1))) / 32767
    return np.round(values / scale).astype(np.int16), scale.astype(np.float32)


@dataclass
class Sample:
    """The same drawn bodies for every mesh: T-posed, their pelvis at the origin."""

    source: Source
    verts: np.ndarray  # (B, V, 3)
    joints: np.ndarray  # (B, 24, 3)


def sample(topology: str, seed: int = 0) -> Sample:
    """Bodies of a mesh; where they stand is not their shape."""
    source = Source(topology)
    bodies = t_pose(source, source.bodies(*draw(source, np.random.default_rng(seed), NUM_BODIES)))
    joints = joint_places(source, bodies.heads)
    return Sample(source, bodies.verts - joints[:, :1], joints - joints[:, :1])


def principal_betas(verts: np.ndarray) -> np.ndarray:
    """Coordinates (B, 10) of bodies along the directions in which they differ most, each of variance 1."""
    mean = verts.mean(0)
    centred = (verts - mean).reshape(len(verts), -1)
    values, vectors = np.linalg.eigh(centred @ centred.T)  # as many as bodies, fewer than coordinates
    betas = np.sqrt(len(verts) - 1) * vectors[:, ::-1][:, :NUM_BETAS]
    signs = np.sign((betas.T @ centred) @ mean.reshape(-1))  # positive ones make the body larger
    explained = values[::-1][:NUM_BETAS].sum() / values.sum()
    print(f"{NUM_BETAS} betas explain {100 * explained:.2f} % of the variance of {len(verts)} bodies")
    stature = np.ptp(verts[..., 1], axis=1)
    print(f"statures {stature.mean():.2f} m, standard deviation {stature.std():.3f} m")
    return betas * signs


def bake(bodies: Sample, betas: np.ndarray, path: Path) -> None:
    """Writes one mesh."""
    verts, mean, source = bodies.verts, bodies.verts.mean(0), bodies.source
    directions, *_ = np.linalg.lstsq(betas, (verts - mean).reshape(len(verts), -1), rcond=None)
    shapedirs = directions.reshape(NUM_BETAS, -1, 3).transpose(1, 2, 0)
    error = np.linalg.norm(mean + np.einsum("vcn,bn->bvc", shapedirs, betas) - verts, axis=-1)
    weights = np.zeros((verts.shape[1], len(JOINTS)))
    np.add.at(weights.T, joint_of_bones(source), source.weights.T)
    slots = np.argsort(-weights, axis=1)[:, :SLOTS]
    kept = np.take_along_axis(weights, slots, 1)
    rows, regressor = regress(verts, bodies.joints)
    joint_error = np.linalg.norm(np.einsum("jn,bjnk->bjk", regressor, verts[:, rows]) - bodies.joints, axis=-1)
    template, template_scale = quantized(mean)
    shapes, shapes_scale = quantized(shapedirs)
    np.savez_compressed(
        path, v_template=template, v_template_scale=template_scale, shapedirs=shapes, shapedirs_scale=shapes_scale,
        f=source.faces.astype(np.uint16), weights=np.round(255 * kept / kept.sum(1, keepdims=True)).astype(np.uint8),
        weights_joint=slots.astype(np.uint8), J_regressor=regressor.astype(np.float32),
        J_regressor_vertex=rows.astype(np.uint16), parents=np.array(PARENTS, np.int8), joint_names=np.array(JOINTS),
    )  # fmt: skip
    spread = 1e3 * np.sqrt((shapedirs**2).sum(1).mean(0))
    print(f"{path.name}: {verts.shape[1]} vertices, {len(source.faces)} faces, {path.stat().st_size / 1e3:.0f} kB")
    print(f"  vertices move by {np.round(spread, 1)} mm (rms) as one beta goes from 0 to 1")
    print(
        f"  vertices of the drawn bodies: mean error {1e3 * error.mean():.1f} mm, largest {1e3 * error.max():.0f} mm"
    )
    print(f"  their joints: mean error {1e3 * joint_error.mean():.1f} mm, "
          f"{JOINTS[joint_error.mean(0).argmax()]} {1e3 * joint_error.mean(0).max():.1f} mm")  # fmt: skip
    print(f"  weights beyond {SLOTS} joints: at most {1 - kept.sum(1).min():.3f}")


def main() -> None:
    """Both bodies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where free.npz and free_low.npz go")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    full, low = sample("anny"), sample("notoes_collapse10pc")
    betas = principal_betas(full.verts)  # the same for both
    bake(full, betas, folder / "free.npz")
    bake(low, betas, folder / "free_low.npz")


if __name__ == "__main__":
    main()
