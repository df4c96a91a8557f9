# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Ray-casting renderer of walls with textures of band-limited noise.

Ray-casting renderer: for every pixel the nearest wall along its ray, and the texture there. Rays
are those of the camera model, so distortion is exact. Textures are interpolated in floating point
(OpenCV's warps round coordinates to 1/32 of a pixel or more).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.kernels.wall_rendering import cast_rays
from slam_graph.sensors import Camera, CameraFrame, Rig, RigCamera
from slam_graph.simulation.depth_rendering import DepthRendering
from slam_graph.simulation.landmarks import MovingBoard
from slam_graph.simulation.motion import Motion
from slam_graph.simulation.moving_bodies import MovingBody
from slam_graph.simulation.simulation_config import ImageConfig, random_stream
from slam_graph.simulation.textures import Atlas, Grey
from slam_graph.simulation.world import Panel, World

_NEAREST_M, _FARTHEST_M = 1e-3, 1e6
_LIGHT = np.array([0.25, 0.45, 0.86])
"""Direction of the light: walls of different orientation differ in brightness."""

BLUR_SAMPLES = 5
"""Sharp images that are averaged to one with motion blur; each costs a whole rendering."""


class Renderer:
    """Renders images of a world; an image depends on its time and the seed only.

    Args:
        rig: the cameras.
        world: walls.
        atlas: their textures.
        config: noise, exposure, blur.
        seed: of the simulation.
        board: moving object, whose texture is the last one of the atlas; or None.
        depth: what is measured of the depth; None for nothing.
    """

    def __init__(
        self,
        rig: Rig,
        world: World,
        atlas: Atlas,
        config: ImageConfig,
        seed: int,
        board: MovingBoard | None = None,
        depth: DepthRendering | None = None,
    ) -> None:
        self._depth = depth
        self.bodies: tuple[MovingBody, ...] = ()
        self._cameras = [_RayCamera(mounted) for mounted in rig.cameras]
        self._middle_s = rig.cameras[0].middle_s
        self._world = world
        self._board = board
        self._atlas = atlas
        self._config = config
        self._seed = seed
        start = np.random.default_rng(random_stream(seed, "exposure"))
        self._phase = float(start.uniform(0.0, 2.0 * np.pi))

    def frame(self, motion: Motion, exposure_ns: int, offset_ns: int = 0) -> CameraFrame:
        """The images of all cameras.

        Args:
            motion: of the platform.
            exposure_ns: middle of the exposure on the clock of the IMU; of rolling shutters, of the
                middle row of the first camera.
            offset_ns: time of the IMU clock minus time of the camera clock.
        """
        stamps = self._instants(motion, exposure_ns)
        gain = self._gain(exposure_ns - motion.start_ns)
        images = []
        instants = [(self._world_at(stamp_ns), stamp_ns) for stamp_ns in stamps.tolist()]
        for number, camera in enumerate(self._cameras):
            sharp = [self._sharp(number, *instant, motion) for instant in instants]
            values = gain * np.mean(sharp, axis=0)
            if self._config.noise_sigma > 0:
                since_ns = exposure_ns - motion.start_ns
                seed = random_stream(self._seed, "pixels", number, since_ns)
                noise = np.random.default_rng(seed).standard_normal(values.shape, np.float32)
                values += np.float32(self._config.noise_sigma) * noise
            image = np.rint(values).clip(0, 255).astype(np.uint8)
            images.append(image.reshape(camera.height, camera.width))
        depth = None if self._depth is None else self._measured(motion, exposure_ns)
        return CameraFrame(exposure_ns - offset_ns, tuple(images), depth)

    def _measured(self, motion: Motion, exposure_ns: int) -> Grey:
        """The depth image (height, width) at the middle of the exposure."""
        assert self._depth is not None
        number = self._depth.sensor.camera
        lens, world = self._cameras[number], self._world_at(exposure_ns)
        parts = self._rows(number, exposure_ns, motion)
        exact = np.concatenate([self._distance(number, world, *part) for part in parts])
        shape = (lens.height, lens.width)
        since_ns = exposure_ns - motion.start_ns
        return self._depth.measure((exact * lens.rays[:, 2]).reshape(shape), since_ns)

    def labels(self, motion: Motion, exposure_ns: int, camera: int = 0) -> NDArray[np.uint16]:
        """The label image (height, width) of a camera: numbers of objects, 0 elsewhere."""
        lens, world = self._cameras[camera], self._world_at(exposure_ns)
        parts = self._rows(camera, exposure_ns, motion)
        panels = np.concatenate([self._hit(camera, world, *part).panel for part in parts])
        numbers = np.zeros(len(world.panels), np.uint16)
        first = len(self._world.panels)
        for body in self.bodies:
            numbers[first : first + len(body.panels)] = body.number
            first += len(body.panels)
        return np.where(lens.lit, numbers[panels], 0).astype(np.uint16).reshape(lens.height, -1)

    def _sharp(self, number: int, world: World, stamp_ns: int, motion: Motion) -> Grey:
        """Noise-free grey values of a camera, (height · width,), without blur.

        Rows of a rolling shutter are seen from where the camera was; a moving board does not move.
        """
        parts = self._rows(number, stamp_ns, motion)
        return np.concatenate([self._radiance(number, world, *part) for part in parts])

    def _rows(
        self, number: int, stamp_ns: int, motion: Motion
    ) -> Iterator[tuple[FloatArray, FloatArray, slice]]:
        """Rotation and position of the body for each part of a camera's pixels."""
        camera = self._cameras[number]
        stamps, rows = np.array([stamp_ns]), [slice(None)]
        if camera.mounted.readout_s:
            v = np.arange(camera.height)
            seconds = camera.mounted.row_times_s(v.astype(np.float64)) - self._middle_s
            stamps = stamp_ns + np.round(seconds * 1e9).astype(np.int64)
            rows = [slice(row * camera.width, (row + 1) * camera.width) for row in v.tolist()]
        poses = motion.rotations(stamps).as_matrix(), motion.positions(stamps)
        return zip(*poses, rows, strict=True)

    def _radiance(
        self,
        camera: int,
        world: World,
        world_R_body: FloatArray,
        position: FloatArray,
        pixels: slice,
    ) -> Grey:
        """Noise-free grey values of some pixels of a camera, for a pose of the body."""
        lens = self._cameras[camera]
        hit = self._hit(camera, world, world_R_body, position, pixels)
        # a pixel covers distance / focal length, and more on a wall at a slant
        footprint = hit.distance * lens.stretch[pixels] / (lens.focal_px * np.sqrt(hit.slant))
        shade = np.array([_shade(panel) for panel in world.panels], np.float32)
        grey = shade[hit.panel] * self._atlas.sample(hit.panel, footprint, hit.a, hit.b)
        return np.where(lens.lit[pixels], grey, np.float32(0.0))

    def _distance(
        self,
        camera: int,
        world: World,
        world_R_body: FloatArray,
        position: FloatArray,
        pixels: slice,
    ) -> Grey:
        """Distances along the rays of some pixels, NaN outside the field of view."""
        hit = self._hit(camera, world, world_R_body, position, pixels)
        return np.where(self._cameras[camera].lit[pixels], hit.distance, np.float32(np.nan))

    def _hit(
        self,
        camera: int,
        world: World,
        world_R_body: FloatArray,
        position: FloatArray,
        pixels: slice,
    ) -> _Hits:
        """What the rays of some pixels of a camera meet, for a pose of the body."""
        lens = self._cameras[camera]
        R = world_R_body @ lens.body_R_camera
        eye = position + world_R_body @ lens.position
        return cast(world, eye, lens.rays[pixels] @ R.T.astype(np.float32))

    def _world_at(self, stamp_ns: int) -> World:
        """The walls, and the board at a time."""
        if self._board is None and not self.bodies:
            return self._world
        moving = [panel for body in self.bodies for panel in body.at(stamp_ns)]
        if self._board is not None:
            moving.append(self._board.at(stamp_ns))
        return World((*self._world.panels, *moving))

    def _instants(self, motion: Motion, exposure_ns: int) -> NDArray[np.int64]:
        """Times of the sharp images whose mean is the blurred one."""
        if self._config.exposure_s == 0.0:
            return np.array([exposure_ns], np.int64)
        count = BLUR_SAMPLES
        parts = (np.arange(count) + 0.5) / count - 0.5
        shifts = np.round(parts * self._config.exposure_s * 1e9).astype(np.int64)
        return np.clip(exposure_ns + shifts, motion.start_ns, motion.end_ns)

    def _gain(self, since_ns: int) -> np.float32:
        config = self._config
        turn = 2.0 * np.pi * since_ns * 1e-9 / config.exposure_period_s + self._phase
        return np.float32(1.0 + config.exposure_change * np.sin(turn))


class _RayCamera:
    """The rays of all pixels of a camera.

    Attributes:
        rays: (H W, 3) unit vectors in the camera frame.
        stretch: (H W,) angle that a pixel covers, relative to one at the centre.
        focal_px: mean focal length.
        lit: (H W,) pixels inside the valid field of view of the camera model.
    """

    def __init__(self, mounted: RigCamera) -> None:
        camera, pose = mounted.camera, mounted.body_T_camera
        self.mounted = mounted
        self.width, self.height = camera.width, camera.height
        self.rays, self.stretch, self.lit = _pixels_of(camera)
        self.focal_px = np.float32(0.5 * (camera.fx + camera.fy))
        self.body_R_camera = pose.rotation().matrix()
        self.position = np.asarray(pose.translation())


@lru_cache(maxsize=2)
def _pixels_of(camera: Camera) -> tuple[Grey, Grey, BoolArray]:
    """Rays, stretch and field of view of a camera, as `_RayCamera` has them.

    Those of the last two are kept, for the next simulation: it takes 0.2 s to invert a lens.
    """
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    plane, lit = camera.visible(pixels)
    rays = np.column_stack([plane, np.ones(len(plane))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    grid = rays.reshape(camera.height, camera.width, 3)
    sides = [np.linalg.norm(np.gradient(grid, axis=axis), axis=2) for axis in (0, 1)]
    focal_px = np.float32(0.5 * (camera.fx + camera.fy))
    stretch = (np.sqrt(sides[0] * sides[1]) * focal_px).ravel().astype(np.float32)
    stretch = np.maximum(stretch, np.float32(1e-3))  # it is 0 outside the field of view
    found = rays.astype(np.float32), stretch, lit
    for shared in found:
        shared.setflags(write=False)
    return found


class _Hits:
    """Intersections of N rays with the panels.

    Attributes:
        panel: (N,) numbers of the panels; 0 where nothing is hit.
        distance: (N,) m, along the ray.
        slant: (N,) cosine of the angle between ray and normal.
        a, b: (N,) coordinates on the panel, across and along, m.
    """

    def __init__(self, count: int) -> None:
        self.panel: IntArray = np.zeros(count, np.int64)
        self.places: Grey = np.zeros((4, count), np.float32)
        self.distance, self.slant, self.a, self.b = self.places
        self.distance[:], self.slant[:] = _FARTHEST_M, 1.0


def cast(world: World, eye: FloatArray, rays: Grey) -> _Hits:
    """The nearest panel along each ray.

    Args:
        world: the panels; from behind they are transparent.
        eye: (3,) origin of the rays.
        rays: (N, 3) unit vectors.
    """
    hits = _Hits(len(rays))
    frames = np.array([[panel.normal, panel.across, panel.along] for panel in world.panels])
    corners = np.array([panel.corner - eye for panel in world.panels])
    sizes = np.array([panel.size for panel in world.panels])
    places = np.column_stack([(frames @ corners[:, :, None])[:, :, 0], sizes])
    ahead = np.flatnonzero(places[:, 0] < -_NEAREST_M)
    seen = frames[ahead].astype(np.float32), places[ahead].astype(np.float32)
    cast_rays(np.ascontiguousarray(rays), ahead, *seen, hits.panel, hits.places)
    return hits


def _shade(panel: Panel) -> float:
    return 0.8 + 0.2 * float(panel.normal @ _LIGHT)
