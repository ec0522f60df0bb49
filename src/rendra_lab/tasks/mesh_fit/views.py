"""Pictures of a cloud and of the surface fitted to it, standing upright."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rendra.renderer import HardFlatShader, Materials, TexturesVertex
from rendra.structures import Meshes
from rendra.transforms import axis_angle_to_matrix
from rendra_lab.pictures import Headlight, OrbitCamera, Shading, Studio, point_marks

_CLOUD, _SURFACE = (0.16, 0.42, 0.80), (0.86, 0.80, 0.70)
_LARGEST = 8192  # pixels along a side
_STANDING = 2.0  # how much longer than the others the axis of something upright is
_SHOWN = 3000  # points at most


class CloudViews:
    """Draws cloud and surface from the front, where they are widest, and from the side.

    Args:
        up: what points upwards in the file's frame, such as [0, 0, 1]. None takes the coordinate axis along which
            the cloud is longest by far, the wider end below, and y where there is none.
        size: height and width of a picture in pixels.
    """

    def __init__(self, up: Sequence[float] | None = None, size: Sequence[int] = (320, 240)) -> None:
        if up is not None and (len(up) != 3 or not any(up)):
            raise ValueError(f"views.up must be a direction such as [0,0,1], or null, got {up}")
        self.up = None if up is None else [float(x) for x in up]
        if len(size) != 2 or not all(1 <= side <= _LARGEST for side in size):
            raise ValueError(f"views.size must be height and width from 1 to {_LARGEST} pixels, got {list(size)}")
        self.size = (size[0], size[1])
        self._points: Tensor | None = None  # whose pictures and frame are kept
        self._pictures: dict[str, Tensor] = {}
        self._turn = torch.eye(3)

    def __call__(self, points: Tensor, mesh: Meshes) -> dict[str, Tensor]:
        """Images (H, W, 3) of the points (P, 3) and of a batch of one mesh, by caption."""
        if self._points is None or not torch.equal(self._points.to(points), points):
            self._points, self._turn = points, upright(points, self.up)
            cloud = balls(points[:: -(-len(points) // _SHOWN)] @ self._turn)
            self._pictures = self._seen(cloud, points, "cloud")
        surface = mesh.update_padded(mesh.verts_padded() @ self._turn.to(points))
        surface.textures = TexturesVertex(torch.tensor(_SURFACE).to(points).expand_as(mesh.verts_padded()))
        fitted = self._seen(surface, points, "surface")
        pairs = zip(self._pictures.items(), fitted.items(), strict=True)
        return {name: image for pair in pairs for name, image in pair}

    def _seen(self, mesh: Meshes, points: Tensor, title: str) -> dict[str, Tensor]:
        """Pictures of a mesh in the frame of the points."""
        frame = _frame(points @ self._turn.to(points))
        views = {"front": 15.0, "side": 105.0}
        return {
            f"{title}, {name}": _studio(azimuth, frame, self.size).render(mesh)[..., :3]
            for name, azimuth in views.items()
        }


def upright(points: Tensor, up: Sequence[float] | None = None) -> Tensor:
    """The rotation (3, 3), applied as x @ R, that stands points (P, 3) on +y with their widest side across x."""
    direction = _guess_up(points) if up is None else torch.tensor(up).to(points)
    turn = _rotation_to_y(direction / direction.norm())
    flat = (points @ turn)[:, [0, 2]]
    _, axes = torch.linalg.eigh((flat - flat.mean(0)).T.cov())
    angle = torch.atan2(axes[1, 1], axes[0, 1])  # of the widest direction, from x towards z
    about_y = torch.zeros(3).to(points)
    about_y[1] = angle
    return turn @ axis_angle_to_matrix(about_y).T


def balls(points: Tensor) -> Meshes:
    """Points (P, 3) as octahedra that do not touch in a cloud of about even density."""
    radius = 0.35 * (points.amax(0) - points.amin(0)).amax() / max(len(points), 1) ** 0.5
    return point_marks(points, radius.clamp_max(0.02), _CLOUD)


def _guess_up(points: Tensor) -> Tensor:
    extent = points.amax(0) - points.amin(0)
    longest = int(extent.argmax())
    direction = torch.zeros_like(extent)
    if float(extent[longest]) < _STANDING * float(extent.sort().values[1]):
        direction[1] = 1
        return direction
    height = (points[:, longest] - points[:, longest].amin()) / extent[longest]
    low, high = (_width(points[part]) for part in (height < 1 / 3, height > 2 / 3))
    direction[longest] = 1 if low >= high else -1
    return direction


def _width(points: Tensor) -> float:
    """The second longest side of a bounding box."""
    return float((points.amax(0) - points.amin(0)).sort().values[1]) if len(points) else 0.0


def _rotation_to_y(direction: Tensor) -> Tensor:
    """The shortest rotation (3, 3) with direction @ R = +y."""
    y = torch.tensor([0.0, 1.0, 0.0]).to(direction)
    axis = torch.linalg.cross(direction, y)
    if float(axis.norm()) < 1e-6:  # along y already, or against it: half a turn about x
        axis = torch.tensor([torch.pi if float(direction[1]) < 0 else 0.0, 0.0, 0.0]).to(direction)
    else:
        axis = axis / axis.norm() * torch.acos(direction[1].clamp(-1, 1))
    return axis_angle_to_matrix(axis).T


def _frame(points: Tensor) -> tuple[list[float], float]:
    low, high = points.amin(0), points.amax(0)
    return ((low + high) / 2).tolist(), float((high - low).norm()) / 2


def _studio(azimuth: float, frame: tuple[list[float], float], size: tuple[int, int]) -> Studio:
    centre, radius = frame
    camera = OrbitCamera(dist=2.6 * max(radius, 1e-6), elev=8.0, azim=azimuth, at=centre, fov=40.0)
    light = Headlight(ambient=0.35, diffuse=0.65, specular=0.0)
    return Studio(camera, light, Materials(), Shading(HardFlatShader()), size)
