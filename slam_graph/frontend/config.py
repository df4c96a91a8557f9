# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The options of the front end, with defaults that suit a 752x480 stereo camera at 20 Hz."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Pixels = Annotated[float, Field(gt=0.0)]
Count = Annotated[int, Field(ge=1)]


class FrontendConfig(BaseModel):
    """How features are found, followed and checked. Distances are in pixels of the raw image."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    method: str = "klt"
    """Which front end to build (a name in the registry of front ends)."""

    features: Count = 200
    """Number of features aimed at in the first camera; the other cameras see these same ones."""

    grid: tuple[Count, Count] = (8, 6)
    """Columns and rows of the grid over which features are spread evenly."""

    min_distance_px: Pixels = 12.0
    """A new corner keeps at least this distance from every other feature."""

    merge_distance_px: Annotated[float, Field(ge=0.0)] = 3.0
    """Of two features that come closer than this, the younger one is dropped."""

    border_px: Annotated[int, Field(ge=0)] = 5
    """Features are neither found nor kept within this distance of the edge of the image."""

    detector: Literal["shi_tomasi", "fast"] = "shi_tomasi"
    """Corner detector: the smaller eigenvalue of the gradient's covariance, or FAST."""

    min_corner_score: Annotated[float, Field(ge=0.0)] = 1e-3
    """Smallest Shi-Tomasi eigenvalue of a corner (OpenCV's scale: grey levels / 255)."""

    corner_window_px: Annotated[int, Field(ge=2)] = 7
    """Side of the window over which Shi-Tomasi sums the gradients."""

    relative_corner_score: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.05
    """A corner of a cell scores at least this share of the best one of the cell (Shi-Tomasi)."""

    fast_threshold: Count = 20
    """Grey levels by which FAST's circle must differ; halved once in cells without corners."""

    window_px: Annotated[int, Field(ge=3)] = 17
    """Side of the window that Lucas-Kanade tracks; OpenCV is fastest at 8n or 8n + 1."""

    pyramid_levels: Annotated[int, Field(ge=0, le=8)] = 3
    """Halvings of the image: 3 means four levels, from full to one eighth of the resolution."""

    lk_iterations: Count = 15
    """Most iterations on each level of the pyramid."""

    lk_epsilon_px: Pixels = 0.02
    """Lucas-Kanade stops when a step is smaller than this."""

    lk_min_eigenvalue: Annotated[float, Field(ge=0.0)] = 1e-3
    """Windows with less gradient than this are not tracked (OpenCV's `minEigThreshold`)."""

    backward_levels: Annotated[int, Field(ge=0, le=8)] = 0
    """Pyramid levels of the backward pass, which starts at the point where it should end."""

    forward_backward_px: Pixels = 0.5
    """Largest distance between a point and itself after tracking forward and back."""

    ransac_px: Pixels = 0.7
    """Largest epipolar distance of an inlier of the fundamental matrix between two frames."""

    ransac_confidence: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.999
    """Probability with which RANSAC draws at least one sample without an outlier."""

    stereo_epipolar_px: Pixels = 1.5
    """Largest distance of a match in another camera from its epipolar line."""

    stereo_min_depth_m: Annotated[float, Field(gt=0.0)] = 0.3
    """Matches in other cameras that triangulate nearer than this, or behind, are refused."""

    equalization: Literal["none", "histogram", "clahe"] = "none"
    """Contrast equalisation before anything else: of the whole histogram, or adaptive (CLAHE)."""

    clahe_clip_limit: Annotated[float, Field(gt=0.0)] = 3.0
    """Contrast limit of CLAHE."""

    clahe_tiles: tuple[Count, Count] = (8, 8)
    """Columns and rows of CLAHE's tiles."""

    masks: tuple[Path | None, ...] = ()
    """One grey image per camera, or none; no features are taken where it is black (< 128)."""
