"""Pictures of fitted people: a body stands where the camera sees it."""

import numpy as np
import pytest
import torch

from rendra.body import SMPL
from rendra_lab.tasks.smplify.body_spheres import Balls
from rendra_lab.tasks.smplify.people import GeneratedPeople
from rendra_lab.tasks.smplify.portraits import Frame, Portraits
from rendra_lab.tasks.smplify.records import FitPrediction, PeopleBatch

_PEOPLE, _SIDE = 6, 96


@pytest.fixture(scope="module")
def body() -> SMPL:
    return SMPL.free(low=True)


@pytest.fixture(scope="module")
def people(body: SMPL) -> PeopleBatch:
    data = GeneratedPeople(body, count=_PEOPLE, image_size=(160, 200), noise_px=0.0, missing=0.0, swapped=0.0, seed=3)
    data.setup("fit")
    return data.people


@pytest.fixture(scope="module")
def true_bodies(people: PeopleBatch) -> FitPrediction:
    """What a perfect fit would answer."""
    truth = people.truth
    assert truth is not None
    nobody = Balls(torch.zeros(_PEOPLE, 0, 3), torch.zeros(_PEOPLE, 0), ())
    return FitPrediction(
        truth.pose, truth.betas, truth.translation, truth.clean_px, nobody,
        torch.arange(_PEOPLE), torch.zeros(_PEOPLE, dtype=torch.bool), truth.joints, truth.verts,
    )  # fmt: skip


def covered(portraits: Portraits, bodies: FitPrediction, people: PeopleBatch, person: int) -> torch.Tensor:
    """The share of each pixel that the body hides: what black paper and white paper show the same of."""
    black, white = (np.full((_SIDE, _SIDE, 3), shade, dtype=np.uint8) for shade in (0, 255))
    over_black, over_white = (
        torch.from_numpy(portraits.overlay(bodies, people, person, paper).astype(np.float32))
        for paper in (black, white)
    )
    return 1 - (over_white - over_black).mean(-1) / 255


@pytest.mark.parametrize("person", range(_PEOPLE))
def test_a_true_body_covers_what_its_camera_sees_of_it(
    body: SMPL, people: PeopleBatch, true_bodies: FitPrediction, person: int
) -> None:
    share = covered(Portraits(body.faces, _SIDE), true_bodies, people, person)
    frame, verts = Frame.about(people, person), true_bodies.verts[person]  # type: ignore[index]
    pixels = people.focal_px[person] * verts[:, :2] / verts[:, 2:] + people.center_px[person]
    places = frame.places(pixels, _SIDE)
    ys, xs = (share > 0.02).nonzero().unbind(1)
    low, high = places.amin(0).clamp(0, _SIDE), places.amax(0).clamp(0, _SIDE)
    assert [int(xs.min()), int(ys.min())] == pytest.approx(low.tolist(), abs=1.5)
    assert [int(xs.max()) + 1, int(ys.max()) + 1] == pytest.approx(high.tolist(), abs=1.5)
    columns, rows = places.clamp(0, _SIDE - 1).long().unbind(1)
    assert float(share[rows, columns].mean()) > 0.8  # every vertex lies on the body, many at its edge
    columns, rows = frame.places(people.joints_px[person], _SIDE).clamp(0, _SIDE - 1).long().unbind(1)
    assert float(share[rows, columns].mean()) > 0.9  # and all joints but the top of the head within it
