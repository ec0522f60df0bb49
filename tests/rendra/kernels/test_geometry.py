"""The scalar functions that every kernel calls."""

import numpy as np
import pytest

from rendra.kernels.geometry import exponential, pixel_centre, pixel_span


def test_exponential_is_accurate_over_its_range():
    x = np.linspace(-86.9, 86.9, 20_001).astype(np.float32)
    got = np.array([exponential(value) for value in x])
    assert str(exponential.nopython_signatures[0].return_type) == "float32"
    np.testing.assert_allclose(got, np.exp(x.astype(np.float64)), rtol=3e-7)


def test_exponential_is_clamped_not_infinite():
    for x in (-np.inf, -1e6, 1e6, np.inf):
        assert np.isfinite(exponential(np.float32(x)))


@pytest.mark.parametrize(("size", "short"), [(1, 1), (7, 7), (8, 5), (256, 256)])
def test_pixel_span_holds_exactly_the_centres_inside(size, short):
    generator = np.random.default_rng(0)
    centres = np.array([pixel_centre(i, size, short) for i in range(size)])
    for _ in range(200):
        low, high = np.sort(generator.uniform(-3, 3, 2)).astype(np.float32)
        begin, end = pixel_span(low, high, size, short)
        inside = np.flatnonzero((centres >= low) & (centres <= high))
        assert list(range(begin, end)) == inside.tolist()
    low = high = centres[size // 2]
    assert pixel_span(low, high, size, short) == (size // 2, size // 2 + 1)
    assert pixel_span(np.float32(-1e30), np.float32(1e30), size, short) == (0, size)
