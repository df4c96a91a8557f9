# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a camera model is, and the models by name.

A camera maps a point p = (x, y, z) of its frame (z forward) to a pixel in two steps: the model maps
the normalised point m = (x/z, y/z) to a point q of the image plane, and the focal lengths and the
principal point map q to the pixel. A `CameraModel` is the first step for any coefficients; it has
no state. To add one, subclass `CameraModel` and register it::

    @register_camera_model
    class FieldOfView(CameraModel):
        name = "fov"
        coefficient_names = ("w",)
        ...

or give a package an entry point in the group ``slam_graph.camera_models``, with the name of the
model, that refers to the class. It can then be used in calibration files, simulated, and calibrated
online like those that are built in.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.errors import ConfigError, DataError
from slam_graph.plugins import Registry

MAX_TANGENT = 11.45
"""Longest normalised point that is used: 85° off the axis. What a lens sees beyond has no place
on the plane z = 1, or one too far out to calculate with."""

_FOLD_SAMPLES = 458
"""Radii at which a model is tested for being one-to-one; a step is 0.025."""

_NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-10

Coefficients = tuple[float, ...]


class CameraModel(ABC):
    """A map q = d(m) from normalised points to the image plane, with derivatives and inverse.

    All methods take N points at once. `coefficients` are in the order of `coefficient_names`.

    Attributes:
        name: of the model in `Camera.distortion`, and in Kalibr's files if these have no other.
        coefficient_names: their number is that of the coefficients.
        ranges: lowest and highest value of coefficients that must be in a range, by name.
        sees_sideways: whether images of such a lens show what is too far off the axis to use, so
            that these pixels must be left out.
        kalibr_camera: Kalibr's `camera_model`.
        distortion_names: of its distortion in calibration files, Kalibr's first, EuRoC's last;
            `name` if empty.
        leading: how many of its coefficients Kalibr writes before the focal lengths, in
            `intrinsics`; the others are in `distortion_coeffs`.
        ros_names: `distortion_model` of ROS' `CameraInfo`.
    """

    name: ClassVar[str]
    coefficient_names: ClassVar[tuple[str, ...]]
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    sees_sideways: ClassVar[bool] = False
    kalibr_camera: ClassVar[str] = "pinhole"
    distortion_names: ClassVar[tuple[str, ...]] = ()
    leading: ClassVar[int] = 0
    ros_names: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def distort(self, m: FloatArray, coefficients: Coefficients) -> tuple[FloatArray, FloatArray]:
        """Points q (N, 2) of normalised points m (N, 2), and the derivatives dq/dm (N, 2, 2)."""

    def points(self, m: FloatArray, coefficients: Coefficients) -> FloatArray:
        """Points q (N, 2) alone; a model that computes them in less time overrides it."""
        return self.distort(m, coefficients)[0]

    @abstractmethod
    def by_coefficients(self, m: FloatArray, coefficients: Coefficients) -> FloatArray:
        """Derivatives (N, 2, n) of q by the coefficients."""

    def undistort(
        self, q: FloatArray, coefficients: Coefficients, near: FloatArray | None = None
    ) -> FloatArray:
        """Normalised points m (N, 2) of points q (N, 2), N > 0: the inverse of `distort`.

        By Newton's method; a model with an inverse in closed form overrides it. Where there is no
        such m, the result is NaN or any point.

        Args:
            q: (N, 2).
            coefficients: of the model.
            near: (N, 2) a guess of the result, where there is one.
        """
        return self._newton(q, coefficients, q if near is None else near, _NEWTON_STEPS)

    def max_tangent(self, coefficients: Coefficients) -> float:
        """The valid field of view: length of the longest normalised point that may be used.

        Up to there the model is one-to-one (the determinant of its derivative is positive);
        polynomials often fold back beyond the field of view of the lens that they describe.
        """
        radii = np.linspace(0.0, MAX_TANGENT, _FOLD_SAMPLES + 1)[1:]
        angles = np.arange(8) * (np.pi / 4.0)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        with np.errstate(all="ignore"):
            slope = self.distort((radii[:, None, None] * directions).reshape(-1, 2), coefficients)[
                1
            ]
            determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
        one_to_one = np.all(determinant.reshape(-1, len(directions)) > 0.0, axis=1)
        return MAX_TANGENT if one_to_one.all() else float(radii[np.argmin(one_to_one)])

    def check(self, coefficients: Coefficients) -> None:
        """Refuse coefficients of a calibration file that are out of their ranges.

        Raises:
            DataError: naming the first of these, and its range.
        """
        for name, value in zip(self.coefficient_names, coefficients, strict=True):
            low, high = self.ranges.get(name, (-np.inf, np.inf))
            if not low <= value <= high:
                raise DataError(
                    f"{name} of camera model '{self.name}' is in [{low:g}, {high:g}], got {value:g}"
                )

    def gtsam_calibration(self, intrinsics: FloatArray, coefficients: Coefficients) -> Any | None:
        """GTSAM's calibration object, such as `gtsam.Cal3DS2`; None if GTSAM has no such model.

        Args:
            intrinsics: (fx, fy, cx, cy) in pixels.
            coefficients: of the model.
        """
        return None

    def _newton(
        self, q: FloatArray, coefficients: Coefficients, m: FloatArray, steps: int
    ) -> FloatArray:
        """Newton's method on `distort` from a start m (N, 2)."""
        with np.errstate(all="ignore"):  # of pixels that no point is seen at
            for _ in range(steps):
                value, jacobian = self.distort(m, coefficients)
                m = m + _solve_2x2(jacobian, q - value)
                if np.max(np.abs(q - value), initial=0.0) < NEWTON_TOLERANCE:
                    break
        return m


def _is_model(part: object) -> bool:
    return isinstance(part, type) and issubclass(part, CameraModel)


CAMERA_MODELS: Registry[type[CameraModel]] = Registry(
    "slam_graph.camera_models",
    "camera model",
    home="slam_graph.sensors.lens_models",  # which needs the other built-in models
    accepts=_is_model,
)
"""The camera models by name, those of installed plugins too."""

ModelT = TypeVar("ModelT", bound=type[CameraModel])


def register_camera_model(model: ModelT) -> ModelT:
    """Make a camera model known by its name; a decorator for subclasses of `CameraModel`.

    Raises:
        ConfigError: if another model has this name.
    """
    return CAMERA_MODELS.register(model.name)(model)


def camera_model(name: str) -> CameraModel:
    """The camera model of a name.

    Raises:
        DataError: if there is none.
        ConfigError: if it is a plugin's that cannot be loaded, or has another name itself.
    """
    if name not in CAMERA_MODELS:
        raise DataError(CAMERA_MODELS.unknown(name))
    model = CAMERA_MODELS[name]
    if model.name != name:
        raise ConfigError(
            f"camera model '{name}': the class {model.__name__} has the name '{model.name}'; "
            "its entry point must have the same"
        )
    return model()


def _solve_2x2(A: FloatArray, b: FloatArray) -> FloatArray:
    """Solutions x (N, 2) of A x = b for A (N, 2, 2), b (N, 2)."""
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    x = (A[:, 1, 1] * b[:, 0] - A[:, 0, 1] * b[:, 1]) / determinant
    y = (A[:, 0, 0] * b[:, 1] - A[:, 1, 0] * b[:, 0]) / determinant
    return np.stack([x, y], axis=1)
