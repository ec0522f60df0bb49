"""A board of two colours."""

import pytest
import torch

from rendra.utils import checkerboard


def test_squares_alternate():
    board = checkerboard(3, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert len(board) == 1
    assert board.get_bounding_boxes()[0].tolist() == [[-3, 3], [-3, 3], [0, 0]]
    assert (board.faces_areas_packed() == 0.5).all()
    assert (board.faces_normals_packed() == torch.tensor([0.0, 0.0, 1.0])).all()
    colors = board.textures.verts_features_packed()[board.faces_packed()]
    assert (colors == colors[:, :1]).all()  # none within a face
    squares = board.verts_packed()[board.faces_packed()].mean(1).floor().sum(1).long()
    assert torch.equal(colors[:, 0, 0], (squares % 2 == 0).float())
    assert torch.equal(colors[:, 0, 2], (squares % 2 == 1).float())
    assert len(board.faces_packed()) == 2 * 6 * 6


def test_a_board_without_squares_is_refused():
    with pytest.raises(ValueError, match="radius must be at least 1, got 0"):
        checkerboard(0)
