# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the gyroscope says of mounting and focal length: the noise of tracks does not shift it."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from groups import slow
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.diagnosis.camera_and_gyroscope import refine
from slam_graph.diagnosis.frame_pairs import FramePair
from slam_graph.diagnosis.gathering import Part
from slam_graph.diagnosis.gyroscope import Gyroscope
from slam_graph.diagnosis.rotation_fit import RotationFit, RotationProblem
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.measurements import FeatureFrame, ImuData
from slam_graph.sensors.rig import Rig, RigCamera
from slam_graph.simulation.simulator import simulate


def recorded(trajectory: str, seed: int, pixel_sigma: float) -> tuple[Rig, Part]:
    """Tracks of one camera over 20 s, without a fault."""
    sequence = simulate(
        trajectory=trajectory,
        real_imu=Path(trajectory).exists(),
        cameras=1,
        rate_hz=20.0,
        duration_s=20.0,
        tracks={"features": 150, "pixel_sigma": pixel_sigma},
        seed=seed,
    )
    packets = list(sequence.packets())
    frames = [packet.frame for packet in packets if isinstance(packet.frame, FeatureFrame)]
    return sequence.rig, Part(frames, ImuData.concatenate([packet.imu for packet in packets]))


def fitted(rig: Rig, part: Part) -> RotationFit:
    """What camera and gyroscope say of one another."""
    fit = refine(rig, [part]).fit
    assert fit is not None
    return fit


def sigmas_away(fit: RotationFit, body_R_camera: FloatArray) -> float:
    """How far a mounting is from the one that was found."""
    turn, covariance = fit.turn_from(body_R_camera)
    return float(np.sqrt(turn @ np.linalg.solve(covariance, turn)))


LENSES: dict[str, tuple[float, ...]] = {
    "none": (),
    "radtan": (-0.28, 0.07, 2e-3, -3e-3),
    "equidistant": (-0.01, 0.02, -0.01, 0.002),
}


@pytest.mark.parametrize("model", LENSES)
def test_bearings_have_the_derivatives_of_the_lens(model: str) -> None:
    rng, step = np.random.default_rng(0), 1e-3
    lens = Camera(320.0, 300.0, 310.0, 250.0, model, LENSES[model], 640, 480)
    mounted = RigCamera(lens, gtsam.Pose3())
    imu = ImuData(np.arange(3) * 10**8, np.zeros((3, 3)), np.zeros((3, 3)))
    pixels = rng.uniform([0.0, 0.0], [640.0, 480.0], (2, 9, 2))
    pixels[0, 0] = 1e4  # may be beyond the edge

    def bearings(first: FloatArray, second: FloatArray) -> tuple[FloatArray, ...]:
        pair = FramePair(0, 0.0, 0.1, first, second, None)
        return RotationProblem([pair], [Gyroscope(imu)], mounted).bearings(1.0)

    rays, slopes, _, known = bearings(*pixels)
    assert np.isfinite(rays).all()
    assert np.isfinite(slopes).all()
    assert known[0, 1:].all()
    assert known[0, 0] or not slopes[0, 0, 0].any()
    for k in range(2):
        low, high = (bearings(*(pixels + side * step * np.eye(2)[k]))[0] for side in (-1.0, 1.0))
        central = (high - low) / (2.0 * step)
        np.testing.assert_allclose(slopes[:, 0, 1:, k], central[:, 0, 1:], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("seed", [slow(0), 1])
def test_noise_of_tracks_is_no_fault(seed: int) -> None:
    """Weighted squares alone would say: a focal length that is wrong by 2 to 3 %."""
    rig, part = recorded("random", seed, pixel_sigma=2.0)
    fit = fitted(rig, part)
    assert abs(np.log(fit.values.focal)) < min(4.0 * fit.sigmas[1], 0.02)
    assert sigmas_away(fit, rig.cameras[0].body_T_camera.rotation().matrix()) < 4.5
    assert fit.noise_px == pytest.approx(2.0, rel=0.15)


@pytest.mark.slow
def test_noise_of_tracks_is_no_fault_on_a_slow_flight(data_dir: Path) -> None:
    rig, part = recorded(str(data_dir / "euroc_inertial/V2_01_easy"), 0, pixel_sigma=1.0)
    fit = fitted(rig, part)
    assert abs(np.log(fit.values.focal)) < 0.01
    assert sigmas_away(fit, rig.cameras[0].body_T_camera.rotation().matrix()) < 5.0


@pytest.mark.parametrize("axis", [slow(0), 1, 2])
def test_a_camera_that_is_turned_by_three_degrees_is_named(axis: int) -> None:
    """In its own frame, and by as much as it is turned."""
    rig, part = recorded("figure8", 0, pixel_sigma=1.0)
    turn = np.deg2rad(3.0) * np.eye(3)[axis]
    mounted = rig.cameras[0]
    wrong = mounted.body_T_camera.compose(gtsam.Pose3(gtsam.Rot3.Expmap(turn), np.zeros(3)))
    turned = replace(rig, cameras=(replace(mounted, body_T_camera=wrong),))
    found = refine(turned, [part])
    assert [f.kind for f in found.findings if f.severity == "error"] == ["mounting"]
    assert found.fit is not None
    away, covariance = found.fit.turn_from(wrong.rotation().matrix())
    true = Rotation.from_rotvec(-turn).as_rotvec()
    assert np.all(np.abs(away - true) < 4.5 * np.sqrt(np.diag(covariance)))
