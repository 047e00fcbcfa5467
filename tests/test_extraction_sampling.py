"""Grey values between pixels, of many features at once."""

from __future__ import annotations

import numpy as np

from mixpose.extraction.sampling import sample, sample_lines


def test_many_features_in_several_images_are_looked_up_as_exactly_as_one() -> None:
    rng = np.random.default_rng(0)
    images = [rng.uniform(0, 100, shape).astype(np.float32) for shape in ((300, 500), (400, 260))]
    own = rng.integers(0, 2, 1500)
    radii = rng.choice([4.0, 9.0, 120.0], 1500, p=[0.5, 0.45, 0.05])
    # beyond the borders of both, too
    centres = rng.uniform(-5, 405, (1500, 2))
    turned = np.linspace(0, 2 * np.pi, 24)
    u = centres[:, :1] + radii[:, None] * np.cos(turned)
    v = centres[:, 1:] + radii[:, None] * np.sin(turned)
    places, steps = np.zeros((2, 2, *u.shape))
    places[:] = centres.T[..., None]
    steps[:] = np.array([u, v]) - places
    middles, found = sample_lines(images, own, places, steps, np.array([0.0, 1.0]))
    assert (middles == middles[..., :1]).all()
    for k, image in enumerate(images):
        inside = np.clip(u, 0, image.shape[1] - 1), np.clip(v, 0, image.shape[0] - 1)
        alone = sample(image, np.stack(inside, axis=2)[own == k])
        # neighbours differ by 100 at most, places by what is left of single precision at 2000 px
        assert np.abs(found[own == k] - alone).max() < 2 * 100 * 2**-13
