# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings with exact ground truth: IMU, and feature tracks or rendered images.

The code shares nothing with `frontend/` and `backend/`, so that an error there cannot hide here.
`simulate` (in `simulation/simulator.py`) makes a sequence, `SimulationConfig`
(in `simulation/simulation_config.py`) holds its settings.
"""
