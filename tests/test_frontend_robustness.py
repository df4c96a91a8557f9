# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Whole runs on real images of EuRoC MH_01 that were spoilt: exposure, matches, movers."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from slam_graph.config import load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.frontend.association import Association
from slam_graph.frontend.lucas_kanade import CornerTracking
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, ImuData, Packet
from slam_graph.sensors.rig import Rig

pytestmark = pytest.mark.data

CAUSAL = ["final_ba.enabled=false"]
"""What is smoothed in the end is not looked at here."""

Image = NDArray[np.uint8]
Edit = Callable[[Image, int, float], Image]
"""What is done to an image, given its camera and the seconds since the first frame."""


class Edited:
    """A recording whose images are changed as they are read."""

    def __init__(self, path: Path, edit: Edit) -> None:
        self._sequence, self._edit = open_dataset(path), edit

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)

    def packets(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Packet]:
        first_ns = self._sequence.info().start_ns
        for packet in self._sequence.packets(start_ns, end_ns):
            t_s = (packet.frame.stamp_ns - first_ns) * 1e-9
            assert isinstance(packet.frame, CameraFrame)
            images = tuple(
                None if image is None else self._edit(image, camera, t_s)
                for camera, image in enumerate(packet.frame.images)
            )
            yield Packet(packet.imu, CameraFrame(packet.frame.stamp_ns, images))


class Kept:
    """Keeps the features of all frames."""

    def __init__(self) -> None:
        self.frames: list[FeatureFrame] = []

    def write(self, imu: ImuData, frame: FeatureFrame) -> None:
        self.frames.append(frame)


@pytest.fixture(scope="module")
def folder(data_dir: Path) -> Path:
    return data_dir / "euroc" / "MH_01_easy_17s"


@pytest.fixture(scope="module")
def clean_m(folder: Path) -> float:
    return ate_m(run(open_dataset(folder), load_config(overrides=CAUSAL, duration_s=8)))


def ate_m(result: RunResult) -> float:
    result.check()
    return float(result.metrics["accuracy"]["se3"]["ate"]["translation_m"]["rmse"])


SPOILERS: dict[tuple[float, float], Callable[[Image], Image]] = {
    (3.0, 4.0): lambda image: image // 10,
    (4.8, 5.8): lambda image: cv2.addWeighted(image, 4.0, image, 0.0, 60.0).astype(np.uint8),
    (6.6, 7.6): lambda image: cv2.GaussianBlur(image, (0, 0), 8.0).astype(np.uint8),
    (8.4, 9.4): lambda image: np.full_like(image, 128),
}
"""For a second each: ten times too dark, saturated, blurred, blank."""


def test_a_run_survives_dark_saturated_blurred_and_blank_images(folder: Path) -> None:
    def spoil(image: Image, camera: int, t_s: float) -> Image:
        for (start_s, end_s), spoiler in SPOILERS.items():
            if start_s <= t_s < end_s:
                return spoiler(image)
        return image

    kept = Kept()
    result = run(
        Edited(folder, spoil), load_config(overrides=CAUSAL, duration_s=10.5), recorder=kept
    )
    assert ate_m(result) < 0.0105
    assert result.coverage > 0.8
    assert result.warnings["few_features"] > 0
    counts = np.array([len(frame.cameras[0]) for frame in kept.frames])
    assert np.min(counts) == 0
    assert np.min(counts[-10:]) > 80


@pytest.mark.slow
def test_random_matches_do_little_harm(
    folder: Path, clean_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three matches in ten are replaced by random ones, in every frame anew."""
    rng, follow = np.random.default_rng(0), CornerTracking.follow

    def spoilt(self: CornerTracking, before: Any, image: Image, guess: Any) -> Association:
        found = follow(self, before, image, guess)
        wrong = rng.random(len(before)) < 0.3
        points = found.points.copy()
        size = np.array(image.shape[::-1])
        points[wrong] = rng.uniform(10, size - 10, (np.count_nonzero(wrong), 2))
        lost = {cause: features & ~wrong for cause, features in found.lost.items()}
        return Association(points, found.good | wrong, lost)

    monkeypatch.setattr(CornerTracking, "follow", spoilt)
    result = run(open_dataset(folder), load_config(overrides=CAUSAL, duration_s=8))
    assert result.logs.features["rejected_ransac"] > 0.15 * result.logs.features["tracked"]
    assert ate_m(result) < 2.0 * clean_m


class MovingWall:
    """A textured wall before the cameras that covers a third of their view and moves to and fro."""

    DEPTH_M, WIDTH_M, TEXEL_M = 1.5, 0.82, 0.0033

    def __init__(self, rig: Rig, since_s: float) -> None:
        self._since_s = since_s
        grey = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(900, 400)), 2.0)
        self._texture = np.clip(128 + 60 * grey / grey.std(), 0, 255).astype(np.uint8)
        self._places = []
        reference = rig.cameras[0].body_T_camera
        for mounted in rig.cameras:
            camera, pose = mounted.camera, reference.between(mounted.body_T_camera)
            u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
            m = camera.undistort(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
            rays = np.column_stack([m, np.ones(len(m))]) @ pose.rotation().matrix().T
            t = pose.translation()
            points = t + rays * ((self.DEPTH_M - t[2]) / rays[:, 2])[:, None]
            self._places.append(points[:, :2].reshape(*u.shape, 2).astype(np.float32))

    def __call__(self, image: Image, camera: int, t_s: float) -> Image:
        if t_s < self._since_s:
            return image
        x, y = np.moveaxis(self._places[camera], 2, 0)
        left = np.float32(0.3 * np.sin(2.0 * t_s) - 0.5 * self.WIDTH_M)
        scale = np.float32(1.0 / self.TEXEL_M)
        wall = cv2.remap(self._texture, (x - left) * scale, (y + 1.5) * scale, cv2.INTER_LINEAR)
        return np.where((x > left) & (x < left + self.WIDTH_M), wall, image).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("since_s", [0.0, 4.0])
def test_a_moving_wall_does_little_harm(folder: Path, clean_m: float, since_s: float) -> None:
    """It neither spoils the start in motion nor, once the run has begun, the estimate."""
    wall = MovingWall(open_dataset(folder).rig, since_s)
    black = wall(np.zeros((480, 752), np.uint8), 0, 5.0)
    assert 0.25 < np.mean(black > 0) < 0.4
    result = run(Edited(folder, wall), load_config(overrides=CAUSAL, duration_s=8))
    assert (result.trajectory.stamps_ns[0] - result.input.start_ns) * 1e-9 < 2.0
    assert ate_m(result) < 1.65 * clean_m


@pytest.mark.slow
def test_a_process_for_the_front_end_changes_nothing(folder: Path) -> None:
    """Not even where the front end hears of the back end in every frame."""
    changes = [*CAUSAL, "frontend.prediction=state", "frontend.drop_rejected=true"]
    changes += ["frontend.map_check_px=3", "frontend.outliers=gyroscope", "min_coverage=0"]
    runs = []
    for overlap in ("true", "false"):
        config = load_config(overrides=[*changes, f"overlap={overlap}"], duration_s=4)
        kept = Kept()
        runs.append((run(open_dataset(folder), config, recorder=kept), kept.frames))
    (one, frames), (other, frames_again) = runs
    assert one.logs.features["rejected_gate"] > 0
    assert one.logs.features == other.logs.features
    for a, b in zip(frames, frames_again, strict=True):
        for seen, again in zip(a.cameras, b.cameras, strict=True):
            np.testing.assert_array_equal(seen.ids, again.ids)
            np.testing.assert_array_equal(seen.pixels, again.pixels)
    np.testing.assert_array_equal(one.trajectory.positions, other.trajectory.positions)
    np.testing.assert_array_equal(one.trajectory.quaternions, other.trajectory.quaternions)
