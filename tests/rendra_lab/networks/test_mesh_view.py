"""A mesh as a camera sees it."""

import pytest

from rendra_lab.data.meshes import load_mesh
from rendra_lab.networks.mesh_view import MeshView


@pytest.mark.parametrize("image_size", [0, -4, "abc", (64, 0), (64,), (64.5, 64), (3, 4, 5)])
def test_sizes_that_no_image_has_are_refused(image_size):
    with pytest.raises(ValueError, match="image_size must be one side"):
        MeshView(load_mesh("cube"), image_size=image_size)


@pytest.mark.parametrize("fov_deg", [0.0, 180.0, -60.0, float("nan")])
def test_fields_of_view_that_no_camera_has_are_refused(fov_deg):
    with pytest.raises(ValueError, match="fov_deg must lie between"):
        MeshView(load_mesh("cube"), fov_deg=fov_deg)
