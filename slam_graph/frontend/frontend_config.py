# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The options of the front end, with defaults that suit a 752x480 stereo camera at 20 Hz."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from slam_graph.settings.base import Settings

OWN_DETECTORS = {"sift": "dog", "surf": "surf", "orb": "orb", "brisk": "brisk", "brief": "fast"}
"""The detector that each descriptor was published with; BRIEF has none of its own."""

Pixels = Annotated[float, Field(gt=0.0)]
Count = Annotated[int, Field(ge=1)]


class MatchingConfig(Settings):
    """How descriptors are matched, for the front ends that match."""

    candidates: Count = 500
    """Keypoints that are described in each image; features are matched to these."""

    distance_px: Pixels = 5.0
    """Keypoints keep at least this distance from one another."""

    search_radius_px: Pixels = 20.0
    """A match lies within this distance of where the feature is predicted."""

    ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.85
    """Ratio test: the best match is less than this share of the distance of the second best."""

    mutual: bool = True
    """Whether a match must be the best one seen from either image."""

    epipolar_px: Pixels = 1.5
    """What `ransac_px` is for corners that are followed; keypoints are found anew in each image,
    which is less exact."""

    memory_frames: Annotated[int, Field(ge=0)] = 5
    """A feature that found no match is looked for in so many more frames before it is lost."""


class FrontendConfig(Settings):
    """How features are found, followed and checked. Distances are in pixels of the raw image."""

    method: str = "klt"
    """`klt` follows corners by Lucas-Kanade; `sift`, `surf`, `orb`, `brisk` and `brief` match these
    descriptors."""

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

    detector: Literal["auto", "shi_tomasi", "harris", "fast", "dog", "surf", "orb", "brisk"] = (
        "auto"
    )
    """What finds features; `auto` is Shi-Tomasi for `klt`, and what a descriptor was published with
    for the others (FAST for BRIEF)."""

    subpixel: bool = False
    """Whether new keypoints are moved to the corner to a fraction of a pixel."""

    prediction: Literal["none", "flow", "gyroscope", "state"] = "gyroscope"
    """Where features are looked for first: where they were; moved on as in the last frame; the same
    with the rotation that the gyroscope measured; or where state and map of the back end say."""

    verify_new: bool = True
    """Whether a new feature must also be found in the image before."""

    verification: Annotated[float, Field(gt=0.0, le=1.0)] = 0.3
    """Errors allowed to a new corner of `klt`, as a share of those allowed to one that is
    followed."""

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

    guided_levels: Annotated[int, Field(ge=0, le=8)] = 1
    """Halvings where the prediction is good (the rotation is measured, the rest known); features
    that are not found that way are looked for again with all `pyramid_levels`."""

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

    outliers: Literal["fundamental", "essential", "magsac", "gyroscope", "none"] = "fundamental"
    """RANSAC between two frames: on the fundamental matrix (7 points), the essential matrix (5),
    the fundamental matrix by MAGSAC++, or the direction of motion under the gyroscope's rotation
    (2)."""

    ransac_px: Pixels = 1.0
    """Largest epipolar distance of an inlier between two frames, for `klt`."""

    ransac_confidence: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.999
    """Probability with which RANSAC draws at least one sample without an outlier."""

    map_check_px: Pixels | None = None
    """Largest reprojection error against the back end's map (PnP with RANSAC); no check if null."""

    drop_rejected: bool = False
    """Whether features that the χ² gate of the back end rejects are not followed any more."""

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

    matching: MatchingConfig = MatchingConfig()
    """How descriptors are matched."""

    @property
    def detector_name(self) -> str:
        """The detector that `detector` and `method` choose."""
        if self.detector != "auto":
            return self.detector
        return OWN_DETECTORS.get(self.method, "shi_tomasi")

    @property
    def epipolar_px(self) -> float:
        """Largest epipolar distance of an inlier between two frames, for the method chosen."""
        return self.ransac_px if self.method == "klt" else self.matching.epipolar_px
