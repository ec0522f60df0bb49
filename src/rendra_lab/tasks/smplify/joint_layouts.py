"""Skeletons of other programs, and where each has LSP's fourteen joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendra_lab.tasks.smplify.records import LSP_JOINTS

Joints = npt.NDArray[np.float64]
"""(K, 3): x and y in pixels, the middle of the first one at 0.5, and the confidence in [0, 1]."""


@dataclass(frozen=True)
class Layout:
    """The joints of a skeleton.

    Attributes:
        name: in `data.layout`.
        joints: K names.
        sources: for each of LSP's joints the rows that give it: their mean, with the smallest of their confidences.
            None of them: this skeleton lacks it, and its confidence is 0. Only necks are means, where there is none
            of its own; the top of a head is never guessed from a face.
        first_pixel: where the program puts the middle of the first pixel.
    """

    name: str
    joints: tuple[str, ...]
    sources: tuple[tuple[int, ...], ...]
    first_pixel: float

    def to_lsp(self, joints: Joints) -> Joints:
        """LSP's joints (14, 3) of this skeleton's (K, 3); where the confidence is 0 all is 0."""
        answer = np.zeros((len(LSP_JOINTS), 3))
        for row, source in enumerate(self.sources):
            found = joints[list(source)]
            if source and found[:, 2].min() > 0:
                answer[row] = *found[:, :2].mean(axis=0), found[:, 2].min()
        return answer


_ARMS_AND_NECK = (
    "nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist",
)  # fmt: skip
_LEGS = ("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle")
_FACE = ("right_eye", "left_eye", "right_ear", "left_ear")
_TOES = ("left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel")
_COCO = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
    "right_ankle",
)  # fmt: skip
_MEDIAPIPE = (
    "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer",
    "left_ear", "right_ear", "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index",
    "left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    "left_heel", "right_heel", "left_foot_index", "right_foot_index",
)  # fmt: skip

# rows of: ankle knee hip (right), hip knee ankle (left), wrist elbow shoulder (right), shoulder elbow wrist (left),
# neck, top of the head
LAYOUTS = {
    layout.name: layout
    for layout in (
        Layout(
            "openpose_body25",
            (*_ARMS_AND_NECK, "middle_hip", *_LEGS, *_FACE, *_TOES),
            ((11,), (10,), (9,), (12,), (13,), (14,), (4,), (3,), (2,), (5,), (6,), (7,), (1,), ()),
            first_pixel=0.0,
        ),
        Layout(
            "openpose_coco18",
            (*_ARMS_AND_NECK, *_LEGS, *_FACE),
            ((10,), (9,), (8,), (11,), (12,), (13,), (4,), (3,), (2,), (5,), (6,), (7,), (1,), ()),
            first_pixel=0.0,
        ),
        Layout(
            "coco17",
            _COCO,
            ((16,), (14,), (12,), (11,), (13,), (15,), (10,), (8,), (6,), (5,), (7,), (9,), (5, 6), ()),
            first_pixel=0.0,
        ),
        Layout(
            "mediapipe33",
            _MEDIAPIPE,
            ((28,), (26,), (24,), (23,), (25,), (27,), (16,), (14,), (12,), (11,), (13,), (15,), (11, 12), ()),
            first_pixel=0.5,
        ),
        Layout("lsp14", LSP_JOINTS, tuple((row,) for row in range(len(LSP_JOINTS))), first_pixel=0.5),
    )
}
