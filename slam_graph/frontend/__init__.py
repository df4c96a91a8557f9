# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""From images to feature tracks: extraction, data association, outlier rejection."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "DESCRIPTORS",
    "DETECTORS",
    "FRONTENDS",
    "Descriptor",
    "Detector",
    "Feedback",
    "Frontend",
    "FrontendConfig",
    "Image",
    "Keypoints",
    "build_frontend",
]

if TYPE_CHECKING:
    from slam_graph.frontend.descriptors import Descriptor
    from slam_graph.frontend.detectors import Detector
    from slam_graph.frontend.frontend_config import (
        DESCRIPTORS,
        DETECTORS,
        FRONTENDS,
        FrontendConfig,
    )
    from slam_graph.frontend.frontend_protocol import Feedback, Frontend, build_frontend
    from slam_graph.frontend.keypoints import Image, Keypoints
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "descriptors": ("Descriptor",),
            "detectors": ("Detector",),
            "frontend_config": ("DESCRIPTORS", "DETECTORS", "FRONTENDS", "FrontendConfig"),
            "frontend_protocol": ("Feedback", "Frontend", "build_frontend"),
            "keypoints": ("Image", "Keypoints"),
        },
    )
