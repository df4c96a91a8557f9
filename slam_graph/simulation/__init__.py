# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings with exact ground truth: IMU, and feature tracks or rendered images.

The code shares nothing with `frontend/` and `backend/`, so that an error there cannot hide here.
`simulate` (in `simulation/simulator.py`) makes a sequence, `SimulationConfig`
(in `simulation/simulation_config.py`) holds its settings.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "SimulationConfig",
    "simulate",
]

if TYPE_CHECKING:
    from slam_graph.simulation.simulation_config import SimulationConfig
    from slam_graph.simulation.simulator import simulate
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "simulation_config": ("SimulationConfig",),
            "simulator": ("simulate",),
        },
    )
