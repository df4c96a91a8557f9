# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Quantiles as NumPy has them, in less time."""

import numpy as np
import pytest

from slam_graph.backend.objects.track_window import quantile


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.9, 1.0])
def test_quantile(share: float) -> None:
    rng = np.random.default_rng(1)
    for count in (1, 2, 7, 40):
        values = rng.normal(size=count)
        assert quantile(values, share) == np.quantile(values, share)
