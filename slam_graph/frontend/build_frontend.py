# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The front ends by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError
from slam_graph.frontend.descriptors import DESCRIPTORS
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.frontend_protocol import Frontend
from slam_graph.frontend.image_frontend import ImageFrontend
from slam_graph.frontend.replay import ReplayFrontend
from slam_graph.sensors.imu_buffer import STANDARD_GRAVITY
from slam_graph.sensors.rig import Rig

FRONTENDS: dict[str, Callable[[Rig, FrontendConfig, int, Diagnostics, float], Frontend]] = {
    "klt": ImageFrontend,
    **dict.fromkeys(DESCRIPTORS, ImageFrontend),
}
"""Front ends that find features in images, by the name that `FrontendConfig.method` gives."""


def build_frontend(
    rig: Rig,
    config: FrontendConfig | None = None,
    seed: int = 0,
    diagnostics: Diagnostics | None = None,
    content: Literal["images", "tracks"] = "images",
    gravity: float = STANDARD_GRAVITY,
) -> Frontend:
    """The front end for a recording.

    Args:
        rig: calibrated cameras.
        config: options; the defaults if None.
        seed: of everything random in the front end.
        diagnostics: where faults are counted.
        content: what the frames of the recording hold (`SequenceInfo.content`); tracks are handed
            on as they are.
        gravity: magnitude in m/s² (`backend.noise.gravity` of the settings).

    Raises:
        ConfigError: if no front end has the name that `config.method` gives, or an option of it
            does not fit the rig.
    """
    config = config or FrontendConfig()
    diagnostics = diagnostics or Diagnostics()
    if content == "tracks":
        return ReplayFrontend(rig, config, seed, diagnostics)
    if config.method not in FRONTENDS:
        raise ConfigError(
            f"unknown front end '{config.method}' (frontend.method); known: {', '.join(FRONTENDS)}"
        )
    return FRONTENDS[config.method](rig, config, seed, diagnostics, gravity)
