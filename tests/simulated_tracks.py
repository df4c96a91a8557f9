# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Short simulated flights with feature tracks, for the tests of the simulation."""

from typing import Any

from slam_graph.simulation.simulated_sequence import SimulatedTracks
from slam_graph.simulation.simulation_config import SimulationConfig
from slam_graph.simulation.simulator import simulate

SHAPES = ("figure8", "rooms", "random")
"""The generated trajectories."""


def tracks(**options: Any) -> SimulatedTracks:
    """Six seconds, unless the settings say otherwise."""
    sequence = simulate(SimulationConfig(**{"duration_s": 6.0, **options}))
    assert isinstance(sequence, SimulatedTracks)
    return sequence
