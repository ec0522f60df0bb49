"""Leeds Sports Pose: `data=lsp`.

Johnson and Everingham, "Clustered Pose and Nonlinear Appearance Models for Human Pose Estimation", BMVC 2010; the
extended set of 2011. The estimates are those that Bogo et al. fitted bodies to, ECCV 2016.
"""

from __future__ import annotations

import io
import logging
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rendra_lab.data.matlab_files import read_matlab
from rendra_lab.data.picture_files import find_picture, upright_size
from rendra_lab.errors import UserError
from rendra_lab.tasks.smplify.joint_layouts import Joints
from rendra_lab.tasks.smplify.picture_people import (
    MOST_PEOPLE,
    GivenPerson,
    PicturePeople,
    box_size,
    check_joints,
)
from rendra_lab.tasks.smplify.records import LSP_JOINTS

log = logging.getLogger(__name__)

_FILES = ("est_joints.npz", "joints.mat")
_FLAGS = ("auto", "seen", "hidden")
_MOST_BYTES = 64 << 20


class LSP(PicturePeople):
    """The data set as its authors lay it out: `images/im0001.jpg` ..., and `joints.mat` or `est_joints.npz`.

    Pictures may be missing. Then the middle of the box about a person's joints is taken to be the picture's, and
    twice its distance from the corner the picture's size.

    joints.mat holds MATLAB's pixels, whose first one has its middle at 1: half a pixel is taken off. est_joints.npz
    holds what its authors compare with projections about half the picture's size, and is taken as it is. The third
    row of joints.mat becomes a confidence of 1 or 0, see `flags`; that of est_joints.npz is clipped to [0, 1].

    Args:
        path: the folder.
        joints: est_joints.npz or joints.mat; None takes the first of the two that is there.
        flags: what a 1 in the third row of joints.mat means. seen: the joint is visible. hidden: it is not. auto:
            seen in files (14, 3, N), the extended set's; in files (3, 14, N) what leaves more joints seen, since the
            set's notes say the one and its file the other.
        focal_px: in the picture's pixels: 5000 of the paper's, which enlarges pictures twice.
        **people: `first`, `count`, `hips_and_neck` and `steps` of `PicturePeople`.
    """

    def __init__(
        self,
        path: str | Path,
        joints: str | None = None,
        flags: str = "auto",
        focal_px: float = 2500.0,
        **people: Any,
    ) -> None:
        super().__init__(focal_px, **people)
        if joints is not None and joints not in _FILES:
            raise UserError(f"data.joints is one of {' '.join(_FILES)}, or null; got {joints!r}")
        if flags not in _FLAGS:
            raise UserError(f"data.flags is one of {' '.join(_FLAGS)}; got {flags!r}")
        self.path = Path(path)
        self.joints = joints
        self.flags = flags

    def read(self) -> list[GivenPerson]:
        """The people of the file of joints, in its order."""
        file = self._file()
        joints, numbers = read_estimates(file) if file.suffix == ".npz" else read_annotations(file, self.flags)
        return [self._person(file, joints[row], int(numbers[row])) for row in self.taken(len(joints), file)]

    def _file(self) -> Path:
        if not self.path.is_dir():
            raise UserError(f"there is no folder {self.path}; data.path is that of {' or '.join(_FILES)}")
        wanted = _FILES if self.joints is None else (self.joints,)
        for name in wanted:
            if (self.path / name).is_file():
                return self.path / name
        raise UserError(f"there is no {' or '.join(wanted)} in {self.path}")

    def _person(self, file: Path, joints: Joints, number: int) -> GivenPerson:
        where = f"{file}, person {number}"
        joints = check_joints(joints, LSP_JOINTS, where)
        names = (f"im{number:04d}", f"im{number:05d}")
        folders = (self.path / "images", self.path)
        picture = next((path for folder in folders if (path := find_picture(folder, names, where))), None)
        size = box_size(joints) if picture is None else upright_size(picture, where)
        return GivenPerson(where, names[0] if picture is None else str(picture), picture, size, joints)


def read_estimates(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Joints (N, 14, 3) of est_joints.npz, and the numbers (N,) of their pictures.

    Args:
        path: a file with est_joints (3, 14, N), more rows are not read, and perhaps image_index (N,); without it the
            pictures are 1, 2, 3 ...

    Raises:
        UserError: another file, other shapes, or a picture that comes twice.
    """
    arrays = dict(_arrays(path))
    if "est_joints" not in arrays:
        raise UserError(f"{path}: 'est_joints' is missing; it holds {', '.join(map(repr, arrays)) or 'nothing'}")
    joints = arrays["est_joints"]
    if joints.ndim != 3 or joints.shape[0] < 3 or joints.shape[1] != 14:
        raise UserError(f"{path}: 'est_joints' has the shape {joints.shape}; expected (3, 14, N)")
    count = joints.shape[2]
    numbers = arrays.get("image_index", np.arange(1, count + 1))
    if numbers.shape != (count,):
        raise UserError(f"{path}: 'image_index' has the shape {numbers.shape}; expected ({count},), one a person")
    if numbers.dtype.kind not in "iu" or (numbers < 1).any() or (numbers > 10**9).any():
        raise UserError(f"{path}: 'image_index' must hold whole numbers from 1, those of im0001.jpg ...")
    once, times = np.unique(numbers, return_counts=True)
    if len(once) < count:
        raise UserError(f"{path}: 'image_index' holds {once[times > 1][0]} more than once")
    return joints[:3].transpose(2, 1, 0).astype(np.float64), numbers.astype(np.int64)


def read_annotations(path: Path, flags: str = "auto") -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Joints (N, 14, 3) of joints.mat, their middle of the first pixel at 0.5, and the numbers 1 ... N.

    Args:
        path: a file of MATLAB's, version 4 to 7.2, with joints (3, 14, N) or (14, 3, N).
        flags: see LSP.

    Raises:
        UserError: another file, another shape, or flags that are neither 0 nor 1.
    """
    joints = read_matlab(path, "joints", "an array (3, 14, N) or (14, 3, N)", 42 * MOST_PEOPLE)
    joints = joints[..., None] if joints.ndim == 2 else joints
    if joints.ndim != 3 or joints.shape[:2] not in ((3, 14), (14, 3)):
        raise UserError(f"{path}: 'joints' has the shape {joints.shape}; expected (3, 14, N) or (14, 3, N)")
    is_extended = joints.shape[:2] == (14, 3)
    answer = (joints.transpose(2, 0, 1) if is_extended else joints.transpose(2, 1, 0)).astype(np.float64)
    answer[..., :2] -= 0.5
    flag = answer[..., 2]
    bad = np.argwhere((flag != 0) & (flag != 1))
    if len(bad):
        person, joint = bad[0]
        raise UserError(
            f"{path}, person {person + 1}, {LSP_JOINTS[joint]}: the flag is {flag[person, joint]:g}; expected 0 or 1"
        )
    if flags == "auto":
        flags = "seen" if is_extended or flag.mean() >= 0.5 else "hidden"
        log.info("%s: a flag of 1 is taken to mean that a joint is %s", path, flags)
    answer[..., 2] = flag if flags == "seen" else 1 - flag
    return answer, np.arange(1, len(answer) + 1)


def _arrays(path: Path) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """The arrays that matter of an .npz, without pickles and of bounded size."""
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                if entry.filename not in ("est_joints.npy", "image_index.npy"):
                    continue
                if entry.file_size > _MOST_BYTES:
                    raise UserError(
                        f"{path}: {entry.filename} takes {entry.file_size:,} bytes; at most {_MOST_BYTES:,} are read"
                    )
                with archive.open(entry) as handle:
                    data = handle.read(_MOST_BYTES)
                yield entry.filename[:-4], _numbers(path, np.load(io.BytesIO(data), allow_pickle=False))
    except UserError:
        raise
    except Exception as error:  # of the archive, of zlib, and of the header's parser, which evaluates text
        raise UserError(f"{path} is no .npz file that can be read: {_one_line(error)}") from error


def _numbers(path: Path, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
        raise UserError(f"{path} holds {getattr(array, 'dtype', type(array).__name__)}; expected real numbers")
    return array


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
