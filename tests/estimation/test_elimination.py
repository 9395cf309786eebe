"""Points are eliminated: the answer is that of the whole system, points and all, solved at once."""

import numpy as np
import pytest

from jcr.estimation import elimination
from jcr.estimation.elimination import Derivatives, Sightings, with_fixed_points, without_points

SHARED, OWN, IMAGES, POINTS = 4, 3, 5, 12


@pytest.mark.parametrize("together", [5, 1024])
def test_the_step_is_that_of_the_whole_system(monkeypatch, together: int):
    monkeypatch.setattr(elimination, "POINTS_AT_ONCE", together)
    rng = np.random.default_rng(1)
    # Each point in some of the images; in one of them twice, as by two cameras on one wrist.
    drawn = [np.sort(np.r_[i := rng.permutation(IMAGES)[:3], i[0]]) for _ in range(POINTS)]
    image, point = np.concatenate(drawn), np.repeat(np.arange(POINTS), 4)
    shared, own, by_point = (rng.normal(size=(len(image), 2, n)) for n in (SHARED, OWN, 3))
    residual = rng.normal(size=(len(image), 2))
    rows = Derivatives(shared=shared, own=own, by_point=by_point, residual=residual)
    seen = Sightings.of(point, image, IMAGES)
    size = SHARED + OWN * IMAGES
    whole = np.zeros((len(image), 2, size + 3 * POINTS))
    for k in range(len(image)):
        whole[k, :, :SHARED] = rows.shared[k]
        whole[k, :, SHARED + OWN * image[k] :][:, :OWN] = rows.own[k]
        whole[k, :, size + 3 * point[k] :][:, :3] = rows.by_point[k]
    expected = -np.linalg.lstsq(whole.reshape(-1, whole.shape[2]), rows.residual.ravel(), rcond=None)[0]
    normal = without_points(*with_fixed_points(rows, seen), rows, seen)
    step = np.linalg.solve(normal.hessian, normal.right)
    assert step == pytest.approx(expected[:size], rel=1e-5, abs=1e-6)
    moved = normal.stepped(np.zeros((POINTS, 3)), step)
    assert moved.ravel() == pytest.approx(expected[size:], rel=1e-5, abs=1e-6)
