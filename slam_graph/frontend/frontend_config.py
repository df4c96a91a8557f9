# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The settings of the front end, and the registries of the parts that they name.

The defaults suit a 752x480 stereo camera at 20 Hz. A detector, a descriptor or a whole front end of
another package is registered in one of the registries (`slam_graph.plugins`, docs/frontend.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from slam_graph.plugins import Choice, Registry
from slam_graph.settings import Settings, expert

if TYPE_CHECKING:
    from slam_graph.diagnostics import Diagnostics
    from slam_graph.frontend.descriptors import Descriptor
    from slam_graph.frontend.detectors import Detector
    from slam_graph.frontend.frontend_protocol import Frontend
    from slam_graph.sensors import Rig

DETECTORS: Registry[Callable[[FrontendConfig], Detector]] = Registry(
    "slam_graph.detectors",
    "detector",
    home="slam_graph.frontend.detectors",
    names=("shi_tomasi", "harris", "fast", "dog", "surf", "orb", "brisk"),
)
"""Detectors by name: callables that make one from the settings."""

DESCRIPTORS: Registry[Callable[[], Descriptor]] = Registry(
    "slam_graph.descriptors",
    "descriptor",
    home="slam_graph.frontend.descriptors",
    names=("sift", "surf", "orb", "brisk", "brief"),
)
"""Descriptors by name: callables without arguments that make one."""

FRONTENDS: Registry[Callable[[Rig, FrontendConfig, int, Diagnostics, float], Frontend]] = Registry(
    "slam_graph.frontends",
    "front end",
    home="slam_graph.frontend.image_frontend",
    names=("klt",),
)
"""Front ends by name: callables that make one from rig, settings, seed, diagnostics and gravity in
m/s²."""

_PUBLISHED_WITH = {"sift": "dog", "surf": "surf", "orb": "orb", "brisk": "brisk", "brief": "fast"}
"""The detector that a descriptor was published with; for BRIEF, which has none, FAST."""

TRACKED_RANSAC_PX, MATCHED_RANSAC_PX = 1.0, 1.5
"""Defaults of `ransac_px`: matched keypoints are located anew in each image, less exactly."""

_MATCHING = "is a constant now, in slam_graph/frontend/matching.py"
_TRACKING = "is a constant now, in slam_graph/frontend/lucas_kanade.py"
_EXTRACTION = "is a constant now, in slam_graph/frontend/extraction.py"

PositivePixels = Annotated[float, Field(gt=0.0)]
PositiveCount = Annotated[int, Field(ge=1)]


class FrontendConfig(Settings):
    """How features are found, tracked and checked. Distances are in pixels of the raw image."""

    moved: ClassVar[Mapping[str, str]] = {
        "features": "is now frontend.max_features",
        "matching": "has become constants, in slam_graph/frontend/matching.py",
        "merge_distance_px": "is a constant now, in slam_graph/frontend/camera_tracker.py",
        "border_px": _EXTRACTION,
        "corner_window_px": "is a constant now, in slam_graph/frontend/detectors.py",
        "relative_corner_score": "is a constant now, in slam_graph/frontend/detectors.py",
        "verification": _TRACKING,
        "guided_levels": _TRACKING,
        "lk_iterations": _TRACKING,
        "lk_epsilon_px": _TRACKING,
        "lk_min_eigenvalue": _TRACKING,
        "backward_levels": _TRACKING,
        "ransac_confidence": "is a constant now, in slam_graph/frontend/outliers.py",
        "clahe_clip_limit": "is a constant now, in slam_graph/frontend/image_frontend.py",
        "clahe_tiles": "is a constant now, in slam_graph/frontend/image_frontend.py",
    }

    method: Annotated[str, Choice(FRONTENDS, DESCRIPTORS)] = "klt"
    """How features are found again in the next image. `klt` tracks corners by Lucas-Kanade: the
    longest tracks, in the least time. A descriptor (`sift`, `surf`, `orb`, `brisk`, `brief`)
    matches keypoints, and finds features again that were hidden for a few frames."""

    detector: Annotated[str, Choice(DETECTORS, others=("auto",))] = "auto"
    """What finds features. `auto` is Shi-Tomasi for `klt`, and for a descriptor the detector that
    it was published with (FAST for BRIEF). `fast` saves time."""

    max_features: PositiveCount = 200
    """Number of features aimed at in the first camera; the other cameras look for these same ones.
    More make the estimate less dependent on single ones, and cost time in front and back end."""

    grid: tuple[PositiveCount, PositiveCount] = expert((8, 6))
    """Columns and rows of the grid over which features are spread evenly. Fit it to the shape of
    the image; with fewer cells features crowd where the texture is strongest."""

    min_distance_px: PositivePixels = expert(12.0)
    """Least distance of a new feature from every other one. Scale it with the resolution."""

    prediction: Literal["none", "flow", "gyroscope", "state"] = expert("gyroscope")
    """Where the search for a feature begins. none: where it was; flow: moved on as in the last
    frame; gyroscope: the same with the rotation that the gyroscope measured; state: where the
    state and the map of the back end place it. Use `flow` if gyroscope or extrinsics are poor."""

    outliers: Literal["fundamental", "essential", "magsac", "gyroscope", "none"] = "fundamental"
    """RANSAC between two frames: on the fundamental matrix (7 points), the essential matrix (5),
    the fundamental matrix by MAGSAC++, or the direction of motion under the gyroscope's rotation
    (2), which needs the fewest inliers. Wide lenses are tested on the sphere, with samples of two
    matches for `gyroscope` and of eight for all others; `essential` and `magsac` do not apply."""

    ransac_px: PositivePixels | None = None
    """Largest epipolar distance of an inlier between two frames; null is 1 px for `klt` and 1.5 px
    for descriptors. Raise it for a poor calibration, if many features are `rejected_ransac`."""

    equalization: Literal["none", "histogram", "clahe"] = expert("none")
    """Contrast equalization of every image: none, of the whole histogram, or adaptive (CLAHE). Try
    `clahe` where images are dark or of low contrast and few features are found."""

    masks: tuple[Path | None, ...] = ()
    """One grey image per camera, or null; no features are taken where it is black (< 128). Mask
    whatever is fixed to the platform and visible."""

    subpixel: bool = expert(False)
    """Whether new keypoints are refined to a fraction of a pixel."""

    reference_patches: bool = expert(True)
    """Whether a tracked corner is placed by the patch of the image in which it was first seen, so
    that its track does not drift."""

    verify_new: bool = expert(True)
    """Whether a new feature must also be found in the image before."""

    min_corner_score: float = expert(1e-3, ge=0.0)
    """Smallest Shi-Tomasi eigenvalue of a corner (OpenCV's scale: grey levels / 255)."""

    fast_threshold: int = expert(20, ge=1)
    """Grey levels by which FAST's circle must differ; halved once in cells without corners."""

    window_px: int = expert(17, ge=3)
    """Side of the window that Lucas-Kanade tracks; 17 is tracked by a kernel, others by OpenCV."""

    pyramid_levels: int = expert(3, ge=0, le=8)
    """Pyramid levels above the image: 3 of them have half, a quarter and an eighth of its size."""

    forward_backward_px: float = expert(0.5, gt=0.0)
    """Largest distance between a point and itself after tracking it forward and back."""

    map_check_px: PositivePixels | None = expert(None)
    """Largest reprojection error against the back end's map (PnP with RANSAC); null: no check."""

    keep_moving: bool = expert(default=False)
    """Whether features of the first camera that move by themselves are tracked on, apart from the
    others. With `objects.enabled` it is so anyway."""

    drop_rejected: bool = expert(False)
    """Whether to stop tracking features that the χ² gate of the back end rejects."""

    stereo_epipolar_px: float = expert(1.5, gt=0.0)
    """Largest distance of a match in another camera from its epipolar line."""

    stereo_min_depth_m: float = expert(0.3, gt=0.0)
    """Matches in other cameras that triangulate nearer than this, or behind, are rejected."""

    @property
    def detector_name(self) -> str:
        """The detector that `detector` and `method` choose."""
        if self.detector != "auto":
            return self.detector
        return _PUBLISHED_WITH.get(self.method, "shi_tomasi")

    @property
    def epipolar_px(self) -> float:
        """Largest epipolar distance of an inlier between two frames, for the method chosen."""
        if self.ransac_px is not None:
            return self.ransac_px
        return MATCHED_RANSAC_PX if self.method in DESCRIPTORS else TRACKED_RANSAC_PX
