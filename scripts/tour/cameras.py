"""From the world to the picture: `python scripts/tour/cameras.py [FILE.obj]`.

Eight cameras look at one vertex. It goes from the world to the view (+X left, +Y up, +Z into the scene), on to NDC
(the short side of the picture from 1 to -1, left and up positive) and to the screen (pixels from the upper left
corner), once in perspective and once in parallel projection.
"""

import sys
from typing import Any

import torch

from rendra.io import load_obj
from rendra.renderer import OrthographicCameras, PerspectiveCameras
from rendra.transforms import euler_angles_to_matrix

CORNER = torch.tensor([[-0.5, -0.5, 9.5]])  # of a cube ten units ahead
IMAGE_SIZE = (512, 1024)  # height, width
MIDDLE = (512.0, 256.0)  # x, y
FOCAL_LENGTH = (1200.0, 300.0)  # pixels, along x and y; in parallel projection pixels per unit of length

# The book gives the size of this picture as (1024, 512). The library reads (height, width): a picture 1024 high and
# 512 wide, on whose right edge the point (512, 256) lies. Coordinates in pixels stay what they are, but those in NDC
# are off, and what is drawn is another part of the scene.
BOOK_IMAGE_SIZE = (1024, 512)


def main(file: str | None = None) -> None:
    """Follows the first vertex of the user's OBJ file, or the corner of a cube."""
    point = CORNER if file is None else load_obj(file)[0][:1]
    steps = torch.arange(-4.0, 4.0)
    R = euler_angles_to_matrix(torch.deg2rad(torch.stack([5 * steps, steps, steps], dim=1)), "ZYX")
    T = torch.stack([steps, torch.zeros(8), torch.zeros(8)], dim=1)
    settings: dict[str, Any] = {
        "R": R,
        "T": T,
        "focal_length": torch.tensor([FOCAL_LENGTH]).expand(8, 2),
        "principal_point": torch.tensor([MIDDLE]).expand(8, 2),
        "in_ndc": False,
        "image_size": torch.tensor([IMAGE_SIZE]).expand(8, 2),
    }
    perspective, orthographic = PerspectiveCameras(**settings), OrthographicCameras(**settings)
    print("world", triple(point[0]))

    view = perspective.get_world_to_view_transform().transform_points(point)
    centres = perspective.get_camera_center()
    for index in range(8):
        print(f"camera {index}: centre {triple(centres[index])}, view {triple(view[index, 0])}")
    print("row vectors: x_view = x_world R + T:", torch.allclose(view, point @ R + T[:, None], atol=1e-5))

    for name, cameras in (("perspective", perspective), ("orthographic", orthographic)):
        # the third coordinate is 1 / z in perspective, z itself in parallel projection
        ndc, screen = cameras.transform_points_ndc(point), cameras.transform_points_screen(point)
        full = cameras.get_full_projection_transform().transform_points(point)  # these cameras': pixels, +X left
        for index in range(8):
            places = (triple(each[index, 0]) for each in (full, ndc, screen))
            print(f"{name} {index}: projected {next(places)}, ndc {next(places)}, screen {next(places)}")
    straight = torch.tensor([[0.0, 0.0, 5.0]])  # ahead of each camera, in its view
    ahead = perspective.get_world_to_view_transform().inverse().transform_points(straight)
    middle = perspective.transform_points_screen(ahead)[:, 0, :2]
    print("straight ahead is the middle of the picture:", torch.allclose(middle, torch.tensor(MIDDLE), atol=1e-2))

    mistaken = PerspectiveCameras(**settings | {"image_size": torch.tensor([BOOK_IMAGE_SIZE]).expand(8, 2)})
    print("its NDC:", triple(perspective.transform_points_ndc(ahead)[4, 0]))
    print("and with the book's size:", triple(mistaken.transform_points_ndc(ahead)[4, 0]))


def triple(point: torch.Tensor) -> str:
    """Three coordinates in round brackets."""
    return "(" + ", ".join(f"{float(each) + 0.0:.3f}" for each in point) + ")"


if __name__ == "__main__":
    main(*sys.argv[1:2])
