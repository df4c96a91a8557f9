# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Generated and recorded trajectories as splines of poses.

Splines of poses: through waypoints, and fitted to a recorded trajectory.

Generated trajectories: a path through a room, flown with stops, the camera looking ahead. Each
shape gives control points. The path is a cubic spline through them, parameterised by arc length.
The distance flown is a smooth function of time that is constant while hovering. Position and
attitude depend on that distance only, so the platform hovers without any motion.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly, CubicSpline, make_lsq_spline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.errors import DataError
from slam_graph.geometry import Trajectory
from slam_graph.simulation.motion import SplineMotion
from slam_graph.simulation.simulation_config import FlightConfig

_KNOT_SPACING_S = 0.1
"""Distance of the knots of a fitted spline: it follows motions of up to about 4 Hz and smooths
faster ones (noise of the recording)."""

_DEGREE = 5
_LONGEST_GAP_S = 0.5


def through_waypoints(times_s: FloatArray, poses: FloatArray) -> BPoly:
    """A spline through waypoints with continuous velocity and acceleration.

    Between equal neighbours it is constant; it arrives and leaves there with zero velocity and
    acceleration.

    Args:
        times_s: (N,) strictly increasing, N ≥ 2.
        poses: (N, 7) position and quaternion, neighbouring quaternions in the same
            hemisphere.

    Returns:
        A quintic Hermite spline: position, velocity and acceleration at its two ends determine
        each segment.
    """
    slopes, curvatures = np.zeros_like(poses), np.zeros_like(poses)
    held = np.all(poses[1:] == poses[:-1], axis=1)
    for first, last in _stretches(~held):
        ends = (
            "clamped" if first > 0 else "not-a-knot",
            "clamped" if last < len(poses) - 1 else "not-a-knot",
        )
        rows = slice(first, last + 1)
        moving = CubicSpline(times_s[rows], poses[rows], bc_type=ends)
        slopes[rows], curvatures[rows] = moving(times_s[rows], 1), moving(times_s[rows], 2)
        for end, clamped in ((first, first > 0), (last, last < len(poses) - 1)):
            if clamped:
                slopes[end] = curvatures[end] = 0.0
    return BPoly.from_derivatives(times_s, np.stack([poses, slopes, curvatures], axis=1))


def _stretches(moving: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last waypoint of each run of moving segments (N-1,)."""
    edges = np.flatnonzero(np.diff(moving.astype(int), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def fit(trajectory: Trajectory, spacing_s: float = _KNOT_SPACING_S) -> SplineMotion:
    """A smooth motion along a recorded trajectory, by least squares.

    Args:
        trajectory: with at least some tens of poses per second.
        spacing_s: distance of the knots.

    Raises:
        DataError: if there are too few poses, or gaps among them.
    """
    times_s = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    if len(times_s) < 2 * _DEGREE + 2:
        raise DataError(f"a trajectory of {len(times_s)} poses is too short to fly along")
    gap = int(np.argmax(np.diff(times_s)))
    if times_s[gap + 1] - times_s[gap] > _LONGEST_GAP_S:
        raise DataError(
            f"the recorded trajectory has a gap of {times_s[gap + 1] - times_s[gap]:.2f} s at "
            f"{trajectory.stamps_ns[gap]}; choose another part of it (start_s, duration_s)"
        )
    knots = _knots(times_s, spacing_s)
    poses = np.column_stack([trajectory.positions, continuous(trajectory.quaternions)])
    spline = make_lsq_spline(times_s, poses, knots, _DEGREE)
    return SplineMotion(int(trajectory.stamps_ns[0]), int(trajectory.stamps_ns[-1]), spline)


def _knots(times_s: FloatArray, spacing_s: float) -> FloatArray:
    """Knots with at least two poses between neighbours, so that the fit is determined."""
    wanted = np.arange(times_s[0] + spacing_s, times_s[-1] - 0.5 * spacing_s, spacing_s)
    index = np.unique(np.searchsorted(times_s, wanted))
    kept = [0]
    for candidate in index.tolist():
        if candidate - kept[-1] >= 2 and candidate < len(times_s) - 2:
            kept.append(candidate)
    ends = np.full(_DEGREE + 1, times_s[0]), np.full(_DEGREE + 1, times_s[-1])
    return np.concatenate([ends[0], times_s[kept[1:]], ends[1]])


def continuous(quaternions: FloatArray) -> FloatArray:
    """The same rotations (N, 4), with signs such that neighbours are in the same hemisphere."""
    turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    signs = np.where(np.cumsum(np.concatenate([[False], turned])) % 2 == 1, -1.0, 1.0)
    smooth: FloatArray = quaternions * signs[:, None]
    return smooth


def stamps_between(start_ns: int, end_ns: int, rate_hz: float) -> IntArray:
    """Times from `start_ns` to at most `end_ns` at a rate; rounding errors do not add up."""
    count = int((end_ns - start_ns) * 1e-9 * rate_hz + 1e-6) + 1
    steps = np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    return start_ns + steps


_WAYPOINT_PERIOD_S = 0.25
_RAMP_S = 1.5
"""Time from standing still to full speed."""
SPEED_CHANGE, SPEED_CHANGE_PERIOD_S = 0.3, 9.0
"""Relative amplitude and period of the changes of speed, which excite the accelerometer."""
_HEADING_SMOOTHING_M = 0.35
_PATH_STEP_M = 0.02
WOBBLE_RAD = 0.1
"""Amplitude of roll and pitch: enough to excite all axes of the gyroscope."""
_WOBBLE_LENGTHS_M = ((1.3, 3.7), (1.7, 2.9))
"""Wavelengths of pitch and of roll, along the path."""

MIN_LEG_M, SHARPEST_TURN = 2.0, 0.0
"""Shortest distance to the next random point, and the smallest cosine of the turn towards it."""

_CAMERA_HEIGHT_M, _CAR_RADIUS_M, _CAR_STEP_M = 1.65, 25.0, 5.0
_STRAIGHTS_M = (40.0, 160.0)
"""Height of a car's camera, radius of its turns, distance of control points, lengths of roads."""
_CAR_WOBBLE_RAD, _CAR_WAVES = 0.006, 8.0
"""Amplitude of its pitch and roll, and how many times longer their waves are than in flight."""

START_NS = 1_000_000_000
"""Time at which generated motions begin."""

ROOM_PITCH_M = 7.0
"""Distance between the middles of neighbouring rooms of `rooms`."""


def _figure8(length_m: float, rng: np.random.Generator) -> FloatArray:
    """Control points (M, 3) of figures of eight, 6 m long and 3.6 m wide."""
    lap = 16
    theta = np.arange(lap * (int(length_m / 12.0) + 2)) * (2 * np.pi / lap)
    height = 1.5 + 0.4 * np.sin(0.5 * theta + rng.uniform(0, 2 * np.pi))
    return np.column_stack([3.0 * np.sin(theta), 1.8 * np.sin(2.0 * theta), height])


def _rooms(length_m: float, rng: np.random.Generator) -> FloatArray:
    """Control points (M, 3) of tours through three rooms and back, with a loop in each."""
    eastward = [(-3.5, 0.0), (-2.0, -0.4), (0.0, -1.6), (1.6, 0.0), (0.0, 1.6), (-1.6, 0.2)]
    eastward += [(-0.4, -1.3), (1.6, -0.7)]
    turn = [(-3.5, 0.0), (-2.0, -0.5), (0.0, -1.8), (1.8, 0.0), (0.0, 1.8), (-2.0, 0.5)]
    middle, back = np.array(eastward), -np.array(eastward)
    far, near = np.array(turn), -np.array(turn)
    pitch = np.array([ROOM_PITCH_M, 0.0])
    lap = np.concatenate([near, middle + pitch, far + 2 * pitch, back + pitch])
    plane = np.tile(lap, (int(length_m / 30.0) + 2, 1))
    height = gaussian_filter1d(rng.normal(size=len(plane)), 1.5)
    height = 1.4 + 0.35 * np.tanh(height / np.std(height))
    return np.column_stack([plane, height])


def _random(length_m: float, rng: np.random.Generator) -> FloatArray:
    """Control points (M, 3) anywhere in a box of 7 x 6 x 2 m, without turning on the spot."""
    low, high = np.array([-3.5, -3.0, 0.7]), np.array([3.5, 3.0, 2.7])
    points, length = [rng.uniform(low, high)], 0.0
    direction = np.zeros(3)
    while length < length_m + 10.0 or len(points) < 4:
        candidates = rng.uniform(low, high, (64, 3))
        steps = candidates - points[-1]
        lengths = np.linalg.norm(steps, axis=1)
        turns = (steps @ direction) / lengths
        chosen = int(np.argmax((lengths > MIN_LEG_M) & (turns >= SHARPEST_TURN)))
        points.append(candidates[chosen])
        length += float(lengths[chosen])
        direction = steps[chosen] / lengths[chosen]
    return np.array(points)


def _car(length_m: float, rng: np.random.Generator) -> FloatArray:
    """Control points (M, 3) of a drive on plane roads: straight ones, and arcs between them."""
    points, place, heading = [np.array([0.0, 0.0, _CAMERA_HEIGHT_M])], np.zeros(2), 0.0
    driven = 0.0
    while driven < length_m + 3.0 * _CAR_STEP_M:
        turn = rng.choice([-1.0, 1.0]) * np.radians(rng.uniform(45.0, 100.0))
        straight, arc = rng.uniform(*_STRAIGHTS_M), abs(turn) * _CAR_RADIUS_M
        steps = max(2, round(straight / _CAR_STEP_M)), max(2, round(arc / _CAR_STEP_M))
        headings = np.concatenate(
            [np.full(steps[0], 0.0), turn * (np.arange(steps[1]) + 0.5) / steps[1]]
        )
        lengths = np.repeat([straight / steps[0], arc / steps[1]], steps)
        for angle, metres in zip(heading + headings, lengths, strict=True):
            place = place + metres * np.array([np.cos(angle), np.sin(angle)])
            points.append(np.append(place, _CAMERA_HEIGHT_M))
        heading, driven = heading + turn, driven + straight + arc
    return np.array(points)


_SHAPES: dict[str, Callable[[float, np.random.Generator], FloatArray]] = {
    "figure8": _figure8,
    "rooms": _rooms,
    "random": _random,
    "car": _car,
}
"""By name, a function that gives control points (M, 3) of a path of at least that many metres."""


def fly(
    shape: str,
    duration_s: float,
    body_T_camera: gtsam.Pose3,
    config: FlightConfig,
    rng: np.random.Generator,
) -> SplineMotion:
    """A flight along a generated path.

    Args:
        shape: figure8, rooms, random or car.
        duration_s: of the flight.
        body_T_camera: the camera that looks ahead, with its image upright.
        config: speed and stops.
        rng: random heights, waypoints and phases.
    """
    waypoints = int(np.ceil(duration_s / _WAYPOINT_PERIOD_S)) + 1
    times_s = np.arange(waypoints, dtype=np.float64) * _WAYPOINT_PERIOD_S
    flown_m = _distance_flown(times_s, config)
    path = _by_arc_length(_SHAPES[shape](float(flown_m[-1]) + 2.0, rng))
    wobble = (_CAR_WOBBLE_RAD, _CAR_WAVES) if shape == "car" else (WOBBLE_RAD, 1.0)
    view = _view_angles(path, flown_m, rng, wobble)
    # the view frame (x ahead, y left, z up) seen from a camera (x right, y down, z ahead)
    camera_R_view = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    view_R_body = Rotation.from_matrix(camera_R_view.T @ body_T_camera.rotation().matrix().T)
    attitude = Rotation.from_euler("ZYX", view) * view_R_body
    poses = np.column_stack([path(flown_m), continuous(attitude.as_quat())])
    end_ns = START_NS + round(duration_s * 1e9)
    return SplineMotion(START_NS, end_ns, through_waypoints(times_s, poses))


def _distance_flown(times_s: FloatArray, config: FlightConfig) -> FloatArray:
    """Distance flown (N,) at times (N,), in metres; constant while hovering."""
    fine = np.arange(0.0, times_s[-1] + 0.01, 0.01)
    speed = config.speed * (1.0 + SPEED_CHANGE * np.sin(2 * np.pi * fine / SPEED_CHANGE_PERIOD_S))
    if config.hover_s > 0:
        since = np.mod(fine, config.hover_s + config.hover_every_s)
        left = config.hover_s + config.hover_every_s - since
        speed *= _smooth_step((since - config.hover_s) / _RAMP_S) * _smooth_step(left / _RAMP_S)
    distance = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1])) * 0.01])
    return np.asarray(np.interp(times_s, fine, distance))


def _smooth_step(x: FloatArray) -> FloatArray:
    """From 0 to 1 with zero slope at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))


def _by_arc_length(points: FloatArray) -> CubicSpline:
    """A path through points (M, 3) as a function of arc length, in metres."""
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    rough = CubicSpline(np.concatenate([[0.0], np.cumsum(chords)]), points)
    dense = rough(np.arange(rough.x[0], rough.x[-1], 0.2))
    steps = np.linalg.norm(np.diff(dense, axis=0), axis=1)
    return CubicSpline(np.concatenate([[0.0], np.cumsum(steps)]), dense)


def _view_angles(
    path: CubicSpline, flown_m: FloatArray, rng: np.random.Generator, wobble: tuple[float, float]
) -> FloatArray:
    """Yaw along the path, and oscillating pitch and roll (N, 3), at distances `flown_m` (N,).

    `wobble` has the amplitude (rad) of the oscillations and a factor on their wavelengths.
    """
    dense = np.arange(0.0, flown_m[-1] + 2.0 * _HEADING_SMOOTHING_M, _PATH_STEP_M)
    tangent = path(dense, 1)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    heading = gaussian_filter1d(heading, _HEADING_SMOOTHING_M / _PATH_STEP_M, mode="nearest")
    angles = [np.interp(flown_m, dense, heading)]
    for lengths in _WOBBLE_LENGTHS_M:
        waves = [
            np.sin(2 * np.pi * flown_m / (wobble[1] * x) + rng.uniform(0, 2 * np.pi))
            for x in lengths
        ]
        angles.append(wobble[0] * np.mean(waves, axis=0))
    return np.column_stack(angles)
