"""What people do, in degrees: key poses of the trunk and limbs between which natural poses lie.

A key names what differs from standing at ease; a pair is (left, right), one number both sides alike.

Trunk: flex forwards, side to the left, turn to the left; nod, tilt, look of the head likewise; pitch forwards and
roll to the left of the pelvis in the world. Legs: hip flexion, abd(uction), out(ward turn), knee flexion, ankle
(plantar flexion), toe (up). Arms: raise from hanging (0) over horizontal (90) to overhead (180), in the plane to the
side (0) or in front (90); spin outwards of the upper arm, elbow flexion, palm (pronation), wrist flexion, shrug of
the shoulder, grip of the fingers. The ranges are in `joint_limits`.
"""

from __future__ import annotations

from dataclasses import dataclass

TRUNK = ("flex", "side", "turn", "nod", "tilt", "look", "pitch", "roll")
LEG = ("hip", "abd", "out", "knee", "ankle", "toe")
ARM = ("raise_", "plane", "spin", "elbow", "palm", "wrist", "shrug", "grip")
LIMB = LEG + ARM
ANGLES = (*TRUNK, *(f"left_{name}" for name in LIMB), *(f"right_{name}" for name in LIMB))
AT_EASE = {"flex": 4, "nod": 4, "abd": 5, "out": 8, "knee": 4, "hip": 1, "raise_": 14, "plane": 25, "spin": -12,
           "elbow": 16, "palm": 15, "grip": 25}  # fmt: skip
SPREAD = {"flex": 5, "side": 4, "turn": 5, "nod": 8, "tilt": 5, "look": 13, "pitch": 4, "roll": 3, "hip": 6, "abd": 5,
          "out": 8, "knee": 7, "ankle": 8, "toe": 5, "raise_": 7, "plane": 10, "spin": 11, "elbow": 10, "palm": 18,
          "wrist": 12, "shrug": 4, "grip": 12}  # fmt: skip
"""Standard deviations of what differs from person to person, degrees."""

Pair = float | tuple[float, float]
Key = dict[str, float]


def key(**angles: Pair) -> Key:
    """A pose by what differs from standing at ease."""
    whole = {name: float(AT_EASE.get(name, 0)) for name in TRUNK}
    for side in ("left_", "right_"):
        whole |= {side + name: float(AT_EASE.get(name, 0)) for name in LIMB}
    for name, value in angles.items():
        if name in TRUNK:
            assert not isinstance(value, tuple)
            whole[name] = value
        else:
            left, right = value if isinstance(value, tuple) else (value, value)
            whole["left_" + name], whole["right_" + name] = left, right
    return whole


@dataclass(frozen=True)
class Family:
    """Poses of one kind.

    Attributes:
        share: of all poses, relative.
        keys: in the order in which a motion passes them; poses lie between neighbours.
        is_cyclic: the motion goes on from the last key to the first one.
        is_apart: keys are no motion: poses lie about one of them, and the trunk as it says.
        free_arms: share of the poses whose arms do something else, out of ARMS.
    """

    share: float
    keys: tuple[Key, ...]
    is_cyclic: bool = False
    is_apart: bool = False
    free_arms: float = 0.0


# A stride is two keys and their mirror; an arm swings with the leg of the other side.
FAMILIES: dict[str, Family] = {
    "standing": Family(10, (
        key(), key(hip=(4, -2), abd=(8, 2), knee=(8, 2), side=3), key(abd=14, out=14), key(flex=10, nod=18),
        key(hip=(18, -4), knee=(14, 3), abd=(10, 6), out=(25, 10), side=-3),
    ), free_arms=0.7),
    "walking": Family(8, (
        key(hip=(24, -14), knee=(5, 12), ankle=(0, 8), turn=5, plane=(-80, 80), raise_=(20, 26), elbow=(12, 28)),
        key(hip=(6, 12), knee=(12, 52), ankle=(-5, 18), raise_=(10, 12), plane=(40, 40)),
        key(hip=(-14, 24), knee=(12, 5), ankle=(8, 0), turn=-5, plane=(80, -80), raise_=(26, 20), elbow=(28, 12)),
        key(hip=(12, 6), knee=(52, 12), ankle=(18, -5), raise_=(10, 12), plane=(40, 40)),
    ), is_cyclic=True, free_arms=0.15),
    "running": Family(12, (
        key(pitch=8, hip=(68, -18), knee=(85, 30), ankle=(0, 35), turn=12, plane=(-75, 85), raise_=(48, 45),
            elbow=(85, 100), abd=3, out=4, spin=(-10, -25)),
        key(pitch=9, hip=(30, 5), knee=(22, 105), ankle=(-5, 30), turn=3, plane=(60, 60), raise_=(15, 22), elbow=90,
            abd=3, out=4, spin=-15),
        key(pitch=8, hip=(-18, 68), knee=(30, 85), ankle=(35, 0), turn=-12, plane=(85, -75), raise_=(45, 48),
            elbow=(100, 85), abd=3, out=4, spin=(-25, -10)),
        key(pitch=9, hip=(5, 30), knee=(105, 22), ankle=(30, -5), turn=-3, plane=(60, 60), raise_=(22, 15), elbow=90,
            abd=3, out=4, spin=-15),
    ), is_cyclic=True),
    "jumping": Family(8, (
        key(hip=75, knee=80, ankle=-18, pitch=22, flex=18, raise_=45, plane=-75, elbow=15, nod=-12),
        key(hip=-8, knee=8, ankle=45, flex=-6, raise_=165, plane=65, elbow=12, spin=30),
        key(hip=(85, -10), knee=(95, 35), ankle=30, raise_=(70, 165), plane=(70, 50), elbow=(50, 12), spin=(10, 40)),
        key(hip=(80, 75), knee=(110, 105), ankle=30, flex=15, raise_=90, plane=40, elbow=25),
        key(hip=20, abd=40, knee=12, ankle=40, out=20, raise_=110, plane=10, elbow=10, flex=-4),
        key(hip=(70, -15), abd=(10, 12), knee=(6, 25), ankle=40, raise_=(95, 95), plane=(75, 10), elbow=12),
        key(hip=(10, 15), knee=(75, 85), ankle=40, flex=-12, raise_=150, plane=30, elbow=25, spin=35, nod=-10),
    ), free_arms=0.25),
    "sitting": Family(6, (
        key(hip=88, knee=88, abd=8, raise_=32, plane=80, elbow=60, pitch=-4, spin=-15, palm=40),
        key(hip=95, knee=70, abd=14, out=12, flex=22, pitch=4, raise_=38, plane=75, elbow=85, spin=-30, nod=12),
        key(hip=92, knee=8, abd=10, flex=16, raise_=28, plane=-40, elbow=8, spin=0, ankle=10),
        key(hip=88, knee=115, abd=42, out=48, flex=24, raise_=40, plane=65, elbow=62, spin=-25, ankle=15),
        key(hip=75, knee=75, pitch=-18, abd=12, raise_=30, plane=70, elbow=45, flex=14),
    ), free_arms=0.4),
    "squatting": Family(5, (
        key(hip=100, knee=120, abd=22, out=22, ankle=-22, pitch=18, flex=18, raise_=80, plane=80, elbow=15, nod=-15),
        key(hip=62, knee=72, abd=20, out=18, ankle=-18, pitch=22, flex=10, raise_=70, plane=65, elbow=50, nod=-18),
        key(hip=112, knee=142, abd=26, out=26, ankle=-26, pitch=12, flex=34, raise_=42, plane=80, elbow=70, spin=-25),
        key(hip=85, knee=100, abd=28, out=25, ankle=-20, pitch=35, flex=12, raise_=38, plane=85, elbow=35, nod=-22),
    ), free_arms=0.35),
    "kneeling": Family(4, (
        key(hip=4, knee=92, ankle=40, abd=8),
        key(hip=(88, 2), knee=(90, 95), ankle=(0, -12), abd=10, out=4, toe=(0, 50)),
        key(hip=82, knee=145, ankle=45, abd=10, flex=14, raise_=35, plane=75, elbow=55, spin=-18, pitch=-6),
        key(hip=40, knee=110, ankle=40, flex=20, pitch=25, raise_=60, plane=80, elbow=20),
    ), free_arms=0.5),
    "lunging": Family(6, (
        key(hip=(78, -20), knee=(82, 35), ankle=(-6, 0), toe=(0, 50), abd=6, out=3),
        key(hip=(95, -15), knee=(98, 22), ankle=(-14, 0), toe=(0, 45), pitch=18, flex=8, raise_=(85, 60),
            plane=(70, -50), elbow=15),
        key(hip=(60, 20), abd=(38, 46), out=(40, 25), knee=(85, 8), ankle=(-10, 10), side=-6, raise_=90, plane=15),
        key(hip=(50, 30), abd=(25, 25), knee=(55, 45), ankle=-8, pitch=24, flex=14, raise_=55, plane=70, elbow=60),
    ), free_arms=0.4),
    "kicking": Family(7, (
        key(hip=(10, -28), knee=(20, 92), ankle=(-5, 30), abd=(5, 14), turn=14, pitch=-4, raise_=(78, 45),
            plane=(20, -45), elbow=25, flex=-6),
        key(hip=(2, 35), knee=(15, 48), ankle=(0, 35), abd=(6, 14), turn=-6, raise_=(72, 45), plane=(55, -30),
            pitch=-8, flex=10),
        key(hip=(0, 92), knee=(12, 10), ankle=(5, 40), abd=(6, 8), turn=-16, raise_=(75, 55), plane=(75, -50),
            pitch=-14, flex=22, elbow=20),
        key(hip=(4, 75), abd=(6, 62), out=(20, 10), knee=(10, 12), roll=24, side=10, ankle=(0, 25), raise_=(60, 55),
            plane=(70, 50), elbow=(105, 85), spin=(-5, -5)),
        key(hip=(8, 95), knee=(14, 95), abd=10, raise_=(55, 50), plane=70, elbow=(110, 110), flex=12, ankle=(0, 25)),
    )),
    "throwing": Family(8, (
        key(turn=-28, look=22, hip=(40, 0), knee=(50, 12), raise_=(92, 80), plane=(45, -35), elbow=(20, 70),
            spin=(0, 40), abd=12, side=-6, pitch=-4),
        key(turn=-8, hip=(45, -6), knee=(20, 18), abd=14, raise_=(60, 96), plane=(60, -12), elbow=(65, 95),
            spin=(-5, 88), flex=-6, side=6, pitch=2),
        key(turn=16, hip=(48, -14), knee=(35, 20), raise_=(45, 112), plane=(40, 60), elbow=(80, 25), spin=(0, 45),
            flex=10, side=10, pitch=12, toe=(0, 35), abd=10),
        key(turn=32, hip=(62, -18), knee=(48, 30), raise_=(35, 62), plane=(-40, 118), elbow=(60, 22), spin=(0, -20),
            flex=26, side=8, pitch=22, toe=(0, 35), nod=-15),
    )),
    "serving": Family(5, (
        key(turn=-16, raise_=(150, 62), plane=(70, -30), elbow=(8, 95), spin=(25, 45), knee=30, hip=20, flex=-8,
            nod=-28, side=-6),
        key(turn=-10, raise_=(120, 108), plane=(60, -5), elbow=(30, 125), spin=(10, 85), knee=18, hip=6, flex=-14,
            nod=-26, ankle=20, side=8),
        key(turn=8, raise_=(55, 168), plane=(70, 40), elbow=(75, 8), spin=(-20, 35), hip=(10, -12), knee=8, ankle=35,
            side=12, nod=-22, roll=6),
        key(turn=24, raise_=(45, 70), plane=(60, 115), elbow=(70, 25), spin=(-25, -25), hip=(45, -12), knee=(28, 45),
            flex=22, pitch=18),
    )),
    "batting": Family(7, (
        key(turn=-34, look=30, hip=30, knee=32, abd=18, pitch=12, flex=10, raise_=(80, 62), plane=(122, -8),
            elbow=(42, 112), spin=(25, 48), out=14),
        key(turn=-8, hip=(32, 18), knee=(22, 30), abd=20, pitch=10, flex=10, raise_=(62, 48), plane=(85, 70),
            elbow=(22, 72), spin=(12, 0), out=12),
        key(turn=32, look=-8, hip=(28, 10), knee=(12, 35), abd=18, pitch=6, flex=4, raise_=(62, 86), plane=(0, 122),
            elbow=(108, 40), spin=(48, 24), out=12, ankle=(0, 25)),
        key(turn=-20, pitch=26, flex=16, hip=42, knee=22, abd=14, raise_=(52, 40), plane=(115, 70), elbow=(10, 30),
            spin=(0, -10), nod=14),
        key(turn=26, raise_=(85, 70), plane=(60, 112), elbow=(60, 35), spin=(20, 10), hip=(28, 6), knee=(30, 22),
            abd=14, pitch=8, flex=6),
    )),
    "reaching": Family(5, (
        key(raise_=(95, 12), plane=(85, 25), elbow=(10, 15), flex=10, turn=-10, pitch=6),
        key(raise_=(160, 14), plane=(60, 20), elbow=(10, 20), nod=-22, side=-10, ankle=20, shrug=(8, 0)),
        key(raise_=88, plane=82, elbow=14, flex=14, pitch=10, nod=-6),
        key(raise_=(100, 50), plane=(10, 30), elbow=(8, 40), side=18, hip=(25, 5), knee=(30, 6), abd=(20, 10)),
        key(raise_=(70, 90), plane=(60, 70), elbow=(20, 14), hip=(70, -25), knee=(50, 12), pitch=42, flex=12,
            nod=-25),
    )),
    "overhead": Family(5, (
        key(raise_=170, plane=60, elbow=8, spin=35), key(raise_=140, plane=25, elbow=25, spin=40, flex=-6, nod=-15),
        key(raise_=128, plane=22, elbow=128, spin=78), key(raise_=95, plane=15, elbow=95, spin=88),
        key(raise_=158, plane=45, elbow=45, spin=45, hip=(50, 4), knee=(60, 8)),
    )),
    "folded_arms": Family(5, (
        key(raise_=(40, 36), plane=(72, 66), elbow=(112, 108), spin=(-42, -50), palm=30, abd=8),
        key(raise_=46, plane=-12, elbow=98, spin=-80, palm=40, wrist=20, abd=12),
        key(raise_=(46, 16), plane=(-12, 25), elbow=(98, 20), spin=(-80, -10), hip=(4, 0), side=3, wrist=(20, 0)),
        key(raise_=(42, 34), plane=(80, 70), elbow=(140, 100), spin=(12, -52), nod=14),
        key(raise_=26, plane=-62, elbow=58, spin=-62, palm=30),
    )),
    "bending": Family(5, (
        key(pitch=48, flex=32, hip=45, knee=10, raise_=70, plane=85, elbow=8, nod=8),
        key(pitch=70, flex=58, hip=68, knee=14, raise_=92, plane=85, elbow=10, nod=14),
        key(pitch=36, flex=30, hip=60, knee=58, raise_=55, plane=82, elbow=22, abd=14, ankle=-14),
        key(flex=4, side=26, roll=6, raise_=(18, 150), plane=(10, 15), elbow=(12, 30), abd=14),
        key(pitch=80, flex=4, hip=(88, -6), knee=(8, 12), raise_=90, plane=(30, 30), elbow=10, nod=-26),
        key(flex=-32, pitch=-12, hip=-12, knee=20, nod=-24, raise_=150, plane=60, elbow=15, spin=30),
    ), is_cyclic=True, is_apart=True, free_arms=0.15),
    "crawling": Family(3, (
        key(pitch=84, flex=6, hip=(92, 78), knee=(95, 88), ankle=40, raise_=(82, 96), plane=85, elbow=10, nod=-26),
        key(pitch=84, flex=2, hip=(78, 92), knee=(88, 95), ankle=40, raise_=(96, 82), plane=85, elbow=10, nod=-26),
        key(pitch=80, flex=10, hip=(108, 18), knee=(105, 22), ankle=(10, 0), toe=(30, 50), raise_=82, plane=80,
            elbow=6, nod=-24),
        key(pitch=82, flex=0, hip=4, knee=4, ankle=0, toe=55, raise_=84, plane=72, elbow=12, spin=20, nod=-16),
        key(pitch=82, flex=0, hip=6, knee=5, toe=55, raise_=58, plane=40, elbow=95, spin=25, nod=-20),
    ), is_cyclic=True),
    "lying": Family(4, (
        key(pitch=-88, raise_=25, plane=0, elbow=15, ankle=30, out=20), key(pitch=-86, hip=52, knee=85, raise_=40,
            plane=10, elbow=30), key(pitch=-88, raise_=(130, 30), plane=10, elbow=(40, 70), hip=(0, 30), knee=(4, 50),
            spin=(70, -10), out=20), key(pitch=86, flex=-8, nod=-18, look=30, raise_=(120, 40), plane=15,
            elbow=(70, 40), ankle=40, hip=(0, 20), abd=(6, 28), knee=(4, 40)),
        key(roll=82, hip=(35, 55), knee=(50, 75), flex=18, raise_=(75, 70), plane=85, elbow=70, side=-6),
        key(pitch=-62, flex=30, hip=70, knee=80, nod=15, raise_=60, plane=70, elbow=110, spin=-10),
    ), is_cyclic=True, is_apart=True, free_arms=0.2),
    "gymnastics": Family(8, (
        key(pitch=178, raise_=172, plane=55, elbow=5, spin=30, ankle=40, nod=-25, flex=-6, hip=-2, abd=4),
        key(roll=175, abd=55, raise_=150, plane=10, elbow=5, ankle=40, nod=-22, out=25, spin=35),
        key(roll=95, abd=(58, 52), raise_=140, plane=10, elbow=5, ankle=40, out=25, side=8, spin=35),
        key(pitch=172, hip=(62, -24), knee=(12, 20), raise_=168, plane=60, elbow=6, ankle=40, nod=-22, spin=30),
        key(pitch=130, flex=40, hip=115, knee=130, nod=28, raise_=72, plane=82, elbow=62, spin=-12, ankle=35),
        key(pitch=74, flex=-8, hip=(78, -30), knee=(5, 6), ankle=(0, 42), raise_=95, plane=10, elbow=5, nod=-26),
        key(hip=(88, -28), abd=(6, 8), knee=4, ankle=40, pitch=16, raise_=100, plane=10, elbow=6, flex=-6),
        key(pitch=196, flex=-40, hip=-22, knee=62, raise_=165, plane=62, elbow=8, nod=-28, ankle=20, spin=30),
        key(hip=(20, 55), abd=(10, 55), out=(15, 48), knee=(6, 125), ankle=(0, 35), raise_=150, plane=55, elbow=40),
        key(hip=96, knee=5, ankle=35, pitch=-12, flex=8, raise_=30, plane=-30, elbow=4, spin=0),
    ), is_cyclic=True, is_apart=True),
}  # fmt: skip

ARMS: tuple[Key, ...] = (
    key(), key(elbow=25, plane=50), key(raise_=46, plane=-12, elbow=98, spin=-80, palm=40, wrist=20),
    key(raise_=40, plane=70, elbow=110, spin=-46), key(raise_=168, plane=55, elbow=10, spin=35),
    key(raise_=130, plane=25, elbow=125, spin=78), key(raise_=92, plane=8, elbow=6),
    key(raise_=88, plane=82, elbow=10),
    key(raise_=36, plane=72, elbow=112, spin=8), key(raise_=28, plane=80, elbow=88, spin=-6),
    key(raise_=62, plane=50, elbow=125, spin=20), key(raise_=110, plane=60, elbow=70, spin=60),
    key(raise_=30, plane=-70, elbow=20), key(raise_=75, plane=10, elbow=60, spin=-60),
    key(raise_=95, plane=40, elbow=30),
)  # fmt: skip
"""What arms do of their own, left and right alike; each side may draw another one."""
