# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The simulated front end: tracks of landmarks, with noise, losses, outliers and descriptors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.sensors import Camera, DepthSensor, FeatureFrame, FeatureObservations, Rig
from slam_graph.simulation.landmarks import Landmarks
from slam_graph.simulation.motion import Motion
from slam_graph.simulation.simulation_config import TrackConfig, random_stream
from slam_graph.simulation.views import MAX_DEPTH_M, View, camera_groups
from slam_graph.simulation.world import World

GRID = (8, 5)
"""Columns and rows of the grid over which new features are distributed."""

_LANDMARKS_AT_ONCE = 2048
"""Landmarks that are projected at a time in the search for new features."""

_POSES_AT_ONCE = 256
"""Poses that are evaluated at a time; it bounds memory."""

_DESCRIPTOR_BYTES = 32

_ROW_ITERATIONS = 6
"""Iterations for the row at which a rolling shutter sees a point. At 3 rad/s and with a readout of
30 ms the error falls to a tenth in each, and begins with 20 px."""

BIT_FLIP_PROBABILITY = 0.08
"""Of each bit of an observed descriptor. Two observations of a landmark then differ in 38 of 256
bits on average, below the matching threshold of ORB-SLAM (50)."""


@dataclass(eq=False)
class _Tracks:
    """The active tracks of one group of cameras.

    Attributes:
        landmarks: (T,) numbers of their landmarks.
        ids: (T,) feature ids.
        ages: (T,) in frames.
        pixels: (T, 2) in the leading camera, without noise.
    """

    landmarks: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    ids: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    ages: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    pixels: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))

    def keep(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> None:
        """Keep some of them, in place."""
        for name in ("landmarks", "ids", "ages", "pixels"):
            setattr(self, name, getattr(self, name)[chosen])

    def add(self, landmarks: IntArray, ids: IntArray, pixels: FloatArray) -> None:
        """Append new tracks."""
        self.landmarks = np.concatenate([self.landmarks, landmarks])
        self.ids = np.concatenate([self.ids, ids])
        self.ages = np.concatenate([self.ages, np.ones(len(ids), np.int64)])
        self.pixels = np.concatenate([self.pixels, pixels])


@dataclass(frozen=True, eq=False)
class _Pose:
    """Pose of the platform at a frame, at the exposure of the middle row of the first camera."""

    stamp_ns: int
    rotation: FloatArray
    position: FloatArray
    motion: Motion


class TrackSimulator:
    """Tracks landmarks; memory does not grow with time.

    Cameras with overlapping views (a stereo pair) form a group. Its first camera finds features and
    tracks them while they are visible; the others observe those of them that they see.

    Args:
        rig: the cameras.
        world: its inner walls hide landmarks.
        landmarks: all landmarks.
        config: number of features, noise, losses, outliers.
        seed: of the simulation.
        place_seed: of what landmarks look like; the same as `seed` if None.
        depth_noise: factor on the noise of the rig's depth sensor.
        masks: whether features of the first camera know which object they are on.
    """

    def __init__(
        self,
        rig: Rig,
        world: World,
        landmarks: Landmarks,
        config: TrackConfig,
        seed: int,
        place_seed: int | None = None,
        depth_noise: float = 1.0,
        masks: bool = False,
    ) -> None:
        reach_m = landmarks.reach_m or MAX_DEPTH_M
        self.views = [View.of(mounted, reach_m) for mounted in rig.cameras]
        self._masks = masks
        self.groups = camera_groups(rig, self.views)
        self._middle_s = rig.cameras[0].middle_s
        self._world = world
        self._landmarks = landmarks
        self._config = config
        self._rng = np.random.default_rng(random_stream(seed, "tracks"))
        looks = seed if place_seed is None else place_seed
        self._descriptors = (
            _Descriptors(len(landmarks), config, looks, seed) if config.descriptors else None
        )
        self._depth = None if rig.depth is None else _Depths(rig.depth, depth_noise, seed)
        self._tracks = [_Tracks() for _ in self.groups]
        self._next_id = 0
        self._next_landmark = 0

    def frames(
        self, motion: Motion, exposures_ns: IntArray, offset_ns: int = 0
    ) -> Iterator[FeatureFrame]:
        """Frames in order of time; to be iterated once.

        Args:
            motion: of the platform.
            exposures_ns: (N,) times of exposure on the clock of the IMU; of rolling shutters those
                of the middle row of the first camera.
            offset_ns: time of the IMU clock minus time of the camera clock.
        """
        for first in range(0, len(exposures_ns), _POSES_AT_ONCE):
            stamps = exposures_ns[first : first + _POSES_AT_ONCE]
            rotations, positions = motion.rotations(stamps).as_matrix(), motion.positions(stamps)
            for stamp_ns, R, p in zip(stamps.tolist(), rotations, positions, strict=True):
                seen = self._observe(_Pose(stamp_ns, R, p, motion))
                yield FeatureFrame(stamp_ns - offset_ns, tuple(seen))

    def _observe(self, pose: _Pose) -> list[FeatureObservations]:
        """One frame: tracks continue or end, new ones begin, and every camera observes them."""
        seen = [FeatureObservations.empty()] * len(self.views)
        for group, tracks in zip(self.groups, self._tracks, strict=True):
            self._follow(tracks, self.views[group[0]], pose)
            self._begin(tracks, self.views[group[0]], pose)
            leading = self._measure(group[0], pose, tracks.landmarks, tracks.ids, tracks.pixels)
            if self._descriptors is not None:
                observed = self._descriptors.observe(tracks.landmarks)
                leading = replace(leading, descriptors=observed)
            seen[group[0]] = leading
            for camera in group[1:]:
                index, pixels = self._see(self.views[camera], pose, tracks.landmarks)
                rows = tracks.landmarks[index], tracks.ids[index]
                seen[camera] = self._measure(camera, pose, *rows, pixels)
        return seen

    def _see(self, view: View, pose: _Pose, landmarks: IntArray) -> tuple[IntArray, FloatArray]:
        """Which of some landmarks a camera sees (indices), and their pixels."""
        points, normals = self._landmarks.at(landmarks, pose.stamp_ns)
        world = self._landmarks.world_at(self._world, pose.stamp_ns)
        index, pixels = view.see(pose.rotation, pose.position, points, normals, world)
        if view.mounted.readout_s == 0.0 or len(index) == 0:
            return index, pixels
        return self._see_rolling(view, pose, index, points, pixels)

    def _see_rolling(
        self, view: View, pose: _Pose, index: IntArray, points: FloatArray, pixels: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """The same for a rolling shutter, of what is seen at the middle row's time.

        The row at which a point is seen and the time of that row are solved for in turn. Moving
        landmarks stay where they are at the middle row's time.
        """
        points = points[index]
        for _ in range(_ROW_ITERATIONS):
            seconds = view.mounted.row_times_s(pixels[:, 1]) - self._middle_s
            stamps = pose.stamp_ns + np.round(seconds * 1e9).astype(np.int64)
            R, p = pose.motion.rotations(stamps).as_matrix(), pose.motion.positions(stamps)
            pixels, inside = view.project(R, p, points)
        return index[inside], pixels[inside]

    def _follow(self, tracks: _Tracks, leader: View, pose: _Pose) -> None:
        """Keep the tracks that are still visible and not lost."""
        config = self._config
        index, pixels = self._see(leader, pose, tracks.landmarks)
        held = self._rng.random(len(index)) >= config.loss
        if config.max_length is not None:
            held &= tracks.ages[index] < config.max_length
        tracks.keep(index[held])
        tracks.pixels = pixels[held]
        tracks.ages += 1

    def _begin(self, tracks: _Tracks, leader: View, pose: _Pose) -> None:
        """Start tracks of landmarks without one, in the cells with the fewest features."""
        near = self._landmarks.around(pose.position)
        total, searched = len(near), 0
        taken = [t.landmarks for t in self._tracks]
        self._begin_on_objects(tracks, leader, pose)
        while searched < total and self._static(tracks) < self._config.features:
            count = min(_LANDMARKS_AT_ONCE, total - searched)
            block = near[(self._next_landmark + np.arange(count)) % total]
            self._next_landmark, searched = (self._next_landmark + count) % total, searched + count
            block = block[~np.isin(block, np.concatenate(taken))]
            index, pixels = self._see(leader, pose, block)
            static = tracks.pixels[tracks.landmarks < self._landmarks.static]
            chosen = self._select(leader.camera, static, pixels)
            landmarks = block[index[chosen]]
            tracks.add(landmarks, self._new_ids(landmarks), pixels[chosen])

    def _static(self, tracks: _Tracks) -> int:
        """Number of tracks that are not on objects."""
        return int(np.count_nonzero(tracks.landmarks < self._landmarks.static))

    def _begin_on_objects(self, tracks: _Tracks, leader: View, pose: _Pose) -> None:
        """Start tracks of all landmarks on moving objects that are seen."""
        if self._landmarks.static == len(self._landmarks):
            return  # most flights have none, and the search for tracks of none takes its time
        block = np.arange(self._landmarks.static, len(self._landmarks))
        block = block[~np.isin(block, np.concatenate([t.landmarks for t in self._tracks]))]
        if len(block):
            index, pixels = self._see(leader, pose, block)
            tracks.add(block[index], self._new_ids(block[index]), pixels)

    def _new_ids(self, landmarks: IntArray) -> IntArray:
        if self._config.keep_ids:
            return landmarks
        self._next_id += len(landmarks)
        return np.arange(self._next_id - len(landmarks), self._next_id)

    def _select(
        self, camera: Camera, present: FloatArray, candidates: FloatArray
    ) -> NDArray[np.intp]:
        """Candidates to take (indices): those in the cells with the fewest features first."""
        wanted = max(self._config.features - len(present), 0)
        if len(candidates) == 0:
            return np.zeros(0, np.intp)
        order = self._rng.permutation(len(candidates))
        cells = _cells(camera, candidates[order])
        occupied = np.bincount(_cells(camera, present), minlength=GRID[0] * GRID[1])
        by_cell = np.argsort(cells, kind="stable")
        first = np.searchsorted(cells[by_cell], cells[by_cell])
        rank = np.empty(len(order), np.int64)
        rank[by_cell] = np.arange(len(order)) - first
        best = np.argsort(rank + occupied[cells], kind="stable")[:wanted]
        return order[best]

    def _measure(
        self, number: int, pose: _Pose, landmarks: IntArray, ids: IntArray, exact: FloatArray
    ) -> FeatureObservations:
        """Observations of a camera, with noise and wrong matches, and with depth if it has one."""
        pixels, config, camera = exact, self._config, self.views[number].camera
        matched = np.arange(len(ids))
        if config.outliers > 0 and len(ids) > 1:
            wrong = np.flatnonzero(self._rng.random(len(ids)) < config.outliers)
            shift = self._rng.integers(1, len(ids), len(wrong))
            matched[wrong] = (wrong + shift) % len(ids)
            pixels = exact[matched]
        if config.pixel_sigma > 0:
            pixels = pixels + self._rng.normal(0.0, config.pixel_sigma, pixels.shape)
        seen = FeatureObservations(ids.copy(), pixels.copy(), camera.undistort(pixels))
        if self._masks and number == 0:  # as masks are those of the first camera
            seen = replace(seen, labels=self._landmarks.labels(landmarks))
        if self._depth is None or self._depth.sensor.camera != number:
            return seen
        exact_m = self._depths_m(number, pose, landmarks, exact)
        return self._depth.measure(seen, exact_m[matched])

    def _depths_m(
        self, number: int, pose: _Pose, landmarks: IntArray, exact: FloatArray
    ) -> FloatArray:
        """Depths (N,) of landmarks in a camera, each at the time of its row."""
        view = self.views[number]
        seconds = view.mounted.row_times_s(exact[:, 1]) - self._middle_s
        R, p = pose.rotation, pose.position
        if view.mounted.readout_s:
            stamps = pose.stamp_ns + np.round(seconds * 1e9).astype(np.int64)
            R, p = pose.motion.rotations(stamps).as_matrix(), pose.motion.positions(stamps)
        points, _ = self._landmarks.at(landmarks, pose.stamp_ns)
        from_eye = points - p - R @ view.position
        axis = R @ view.body_R_camera[:, 2]
        depths: FloatArray = np.sum(from_eye * axis, axis=1)
        return depths


def _cells(camera: Camera, pixels: FloatArray) -> IntArray:
    """Index of the grid cell (N,) of each pixel (N, 2)."""
    scale = np.array([GRID[0] / camera.width, GRID[1] / camera.height])
    cells = (pixels * scale).astype(np.int64)
    return np.asarray(cells[:, 1] * GRID[0] + cells[:, 0])


class _Depths:
    """Measured depths.

    Args:
        sensor: noise and range.
        scale: factor on the noise.
        seed: of the simulation.
    """

    def __init__(self, sensor: DepthSensor, scale: float, seed: int) -> None:
        self.sensor = sensor
        self._scale = scale
        self._rng = np.random.default_rng(random_stream(seed, "depth"))

    def measure(self, seen: FeatureObservations, exact_m: FloatArray) -> FeatureObservations:
        """Features with their depths (N,) as they are measured; none outside of the range."""
        sigma_m = self.sensor.sigma_m(exact_m)
        depth_m = exact_m + self._scale * sigma_m * self._rng.standard_normal(len(exact_m))
        depth_m[~((depth_m >= self.sensor.min_m) & (depth_m <= self.sensor.max_m))] = np.nan
        sigma_m = self.sensor.sigma_m(depth_m)  # what a user of the depth can know
        return replace(seen, depth_m=depth_m, depth_sigma_m=sigma_m)


class _Descriptors:
    """Binary descriptors of landmarks, some of which share one.

    Args:
        landmarks: their number.
        config: number of distinct descriptors.
        place_seed: of the descriptors.
        seed: of their wrong bits.
    """

    def __init__(self, landmarks: int, config: TrackConfig, place_seed: int, seed: int) -> None:
        rng = np.random.default_rng(
            random_stream(place_seed, "looks")
        )  # the name is part of the seed
        shape = (config.distinct_descriptors, _DESCRIPTOR_BYTES)
        self._distinct = rng.integers(0, 256, shape, dtype=np.uint8)
        self._of_landmark = rng.integers(0, config.distinct_descriptors, landmarks)
        self._rng = np.random.default_rng(random_stream(seed, "descriptors"))

    def observe(self, landmarks: IntArray) -> NDArray[np.uint8]:
        """Descriptors (N, 32) of landmarks (N,), with wrong bits that differ between calls."""
        flipped = self._rng.random((len(landmarks), 8 * _DESCRIPTOR_BYTES)) < BIT_FLIP_PROBABILITY
        return self._distinct[self._of_landmark[landmarks]] ^ np.packbits(flipped, axis=1)
