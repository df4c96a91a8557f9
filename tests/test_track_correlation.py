# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Statistical inefficiency of tracks: found from residuals that have lost what is slow."""

import numpy as np
import pytest

from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.smoothing.recording_cost import LinearReprojection
from slam_graph.backend.smoothing.track_correlation import statistical_inefficiency

KEYFRAMES, TRACKS = 20, 200


def tracks(correlation: float, sigma: float, keyframes: int = KEYFRAMES) -> LinearReprojection:
    """Residuals at the minimum of the points, in two cameras that see them in every keyframe."""
    rng = np.random.default_rng(7)
    errors = rng.normal(size=(keyframes, TRACKS, 2, 2))
    for k in range(1, keyframes):
        errors[k] = correlation * errors[k - 1] + np.sqrt(1.0 - correlation**2) * errors[k]
    errors = sigma * errors.transpose(1, 0, 2, 3).reshape(TRACKS, -1)
    turn = np.linspace(0.0, 1.0, keyframes)[:, None, None, None]
    by_point = rng.normal(size=(TRACKS, 1, 2, 2, 3)) + turn * rng.normal(size=(TRACKS, 1, 2, 2, 3))
    by_point = by_point.reshape(TRACKS, -1, 3)
    Q, _ = np.linalg.qr(by_point)
    residuals = errors - np.einsum("jra,jsa,js->jr", Q, Q, errors)
    shape = TRACKS, keyframes, 2
    feature, frame, camera = (
        np.broadcast_to(x, shape).ravel() for x in np.ogrid[: shape[0], : shape[1], : shape[2]]
    )
    pixels = np.zeros((len(feature), 2))
    obs = Observations(
        np.arange(TRACKS), tuple(range(keyframes)), feature, frame, camera, pixels, pixels
    )
    return LinearReprojection(
        obs,
        residuals.reshape(-1, 2),
        np.zeros((len(obs), 2, 6)),
        by_point.reshape(-1, 2, 3),
        np.ones(len(obs)),
        pixels,
    )


@pytest.mark.parametrize("correlation", [0.3, 0.6, 0.8, 0.9])
@pytest.mark.parametrize("sigma", [0.5, 2.0])
def test_correlation_is_found_although_points_follow_the_errors(
    correlation: float, sigma: float
) -> None:
    expected = sigma**2 * (1.0 + correlation) / (1.0 - correlation)
    found = statistical_inefficiency(tracks(correlation, sigma))
    assert found == pytest.approx(max(expected, 1.0), rel=0.15)


def test_white_noise_of_the_assumed_size_or_less_counts_as_it_is() -> None:
    assert statistical_inefficiency(tracks(0.0, 1.0)) == pytest.approx(1.0, abs=0.05)
    assert statistical_inefficiency(tracks(0.0, 0.7)) == 1.0


def test_short_tracks_tell_nothing() -> None:
    assert statistical_inefficiency(tracks(0.9, 1.0, keyframes=3)) == 1.0
