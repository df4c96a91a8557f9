# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which tracks are of which object: mirror images, two bodies in one, tracks that go over."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
import pytest

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend import BackendConfig
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.mirror_motion import MirrorMotion
from slam_graph.backend.objects.motion_test import judge_tracks
from slam_graph.backend.objects.object_review import ObjectReview
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.objects.relative_motion import RelativeMotion, motion_over, object_policies
from slam_graph.backend.objects.track_assignment import TrackAssignment
from slam_graph.backend.objects.track_labels import TrackLabels
from slam_graph.backend.objects.track_window import TrackWindow
from slam_graph.backend.objects.tracked_object import TrackedObject
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.config import config_folder, load_config
from slam_graph.geometry import NavState
from slam_graph.pipeline import run
from slam_graph.sensors import FeatureFrame, FeatureObservations, Rig
from slam_graph.simulation.simulator import euroc_rig, simulate

RATE_HZ, FRAMES, SIGMA_PX = 10.0, 8, 0.5
BACKEND, CONFIG = BackendConfig(), ObjectsConfig()


class Body(NamedTuple):
    """Points (N, 3) in the first camera now, m, with a velocity and an angular rate there."""

    points: FloatArray
    velocity: tuple[float, float, float]
    rate: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def motion(self, seconds: float) -> gtsam.Pose3:
        """From where it is now to where it is then, about its middle."""
        middle = self.points.mean(axis=0)
        R = gtsam.Rot3.Expmap(np.array(self.rate) * seconds)
        shift = middle - R.rotate(middle) + np.array(self.velocity) * seconds
        return gtsam.Pose3(R, shift)


@dataclass
class Scene:
    """A platform at rest, which sees bodies; tracks are numbered from the first body on."""

    bodies: Sequence[Body]
    sigma_px: float = SIGMA_PX
    rate_hz: float = RATE_HZ

    def __post_init__(self) -> None:
        rig, rng = euroc_rig(), np.random.default_rng(7)
        self.rig: Rig = rig
        self.window = TrackWindow(rig, BACKEND)
        self.times = (np.arange(FRAMES) - FRAMES + 1) / self.rate_hz
        self.stamps = [round(1e9 * (1.0 + t)) for t in self.times]
        first = rig.cameras[0].body_T_camera
        for stamp, t in zip(self.stamps, self.times, strict=True):
            seen = []
            points = np.concatenate([b.motion(t).transformFrom(b.points.T).T for b in self.bodies])
            for mounted in rig.cameras:
                local = first.between(mounted.body_T_camera).transformTo(points.T).T
                pixels = mounted.camera.distort(local[:, :2] / local[:, 2:])[0]
                pixels = pixels + rng.normal(0.0, self.sigma_px, pixels.shape)
                ids = np.arange(len(points))
                seen.append(FeatureObservations(ids, pixels, mounted.camera.undistort(pixels)))
            self.window.add(FeatureFrame(stamp, tuple(seen)), 0)
        pose, zero = gtsam.Pose3(), np.zeros(3)
        self.ego = EgoMotion(
            tuple(self.stamps),
            (pose,) * FRAMES,
            np.zeros((FRAMES, 3)),
            NavState(self.stamps[-1], pose, zero, accel_bias=zero, gyro_bias=zero),
            1e-8 * np.eye(3),
            1e-10 * np.eye(3),
            1e-12 * np.eye(6),
        )

    def ids(self, body: int) -> IntArray:
        """Of the tracks of a body."""
        begin = sum(len(other.points) for other in self.bodies[:body])
        return np.arange(begin, begin + len(self.bodies[body].points))

    def poses(self, body: int) -> dict[int, gtsam.Pose3]:
        """Of the platform in the frame of a body, which is that of the platform now."""
        first = self.rig.cameras[0].body_T_camera
        moved = [first * self.bodies[body].motion(t) * first.inverse() for t in self.times]
        return {s: pose.inverse() for s, pose in zip(self.stamps, moved, strict=True)}

    def object(self, members: IntArray, number: int = 1) -> TrackedObject:
        """An object of some tracks, estimated over the window."""
        motion = motion_over(members, self.window, self.ego, policies(), CONFIG)
        assert motion is not None
        return TrackedObject(number, 0, members, motion, self.ego, CONFIG)

    def review(self) -> ObjectReview:
        """Of its objects."""
        return ObjectReview(self.window, self.ego, SIGMA_PX, policies(), CONFIG)


def policies(sigma_px: float = SIGMA_PX) -> tuple[AlgorithmConfig, BackendConfig]:
    """Of objects, and settings with the noise of the tracks."""
    noise = BACKEND.noise.model_copy(update={"pixel_sigma": sigma_px})
    algorithm = load_config(config_folder() / "objects.yaml").algorithm
    return algorithm, BACKEND.model_copy(update={"noise": noise})


def cube(middle: tuple[float, float, float], count: int = 20, half_m: float = 0.5) -> FloatArray:
    """Points (N, 3) within a cube."""
    rng = np.random.default_rng(round(10 * sum(middle)))
    return np.array(middle) + rng.uniform(-half_m, half_m, (count, 3))


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 40.0])
def test_frames_of_a_window_have_a_spacing(rate_hz: float) -> None:
    """So a faster camera makes no longer windows; the last frame is always there."""
    scene = Scene([Body(cube((0.2, 0.1, 3.5)), (0.3, 0.0, 0.0))], rate_hz=rate_hz)
    *past, last = scene.window.stamps_ns
    assert (past[0], last) == (scene.stamps[0], scene.stamps[-1])
    assert np.unique(np.diff(past)) == pytest.approx([100e6], abs=2)


def test_noise_that_is_assumed_on_the_way_is_that_of_the_settings() -> None:
    """As long as nothing was estimated, it takes their place."""
    scene = Scene([Body(cube((0.2, 0.1, 3.5)), (0.3, 0.0, 0.0))])
    covariances = []
    for setting in (SIGMA_PX, 4.0 * SIGMA_PX):
        motion = RelativeMotion(scene.rig, *policies(setting), CONFIG, CONFIG.window_s)
        motion.assume_pixel_noise(SIGMA_PX)
        for frame in scene.window.frames:
            motion.add(frame, scene.ego)
        covariances.append(motion.covariance(scene.stamps[-1]))
    assert covariances[0] == pytest.approx(covariances[1], rel=0.05)
    assert 1e-5 < np.sqrt(covariances[0][3, 3]) < 0.1


def test_a_motion_fits_better_than_its_mirror_image() -> None:
    scene = Scene([Body(cube((0.2, 0.1, 3.5)), (0.3, 0.0, 0.0), (0.0, 0.8, 0.0))])
    mirror = MirrorMotion(scene.window, SIGMA_PX)
    assert mirror.worse(scene.ids(0), scene.poses(0)) > 100


def test_the_mirror_image_of_a_mirror_image_is_the_motion() -> None:
    """The wrong one is known by that the other one, which is right, fits better."""
    scene = Scene([Body(cube((0.2, 0.1, 3.5)), (0.3, 0.0, 0.0), (0.0, 0.8, 0.0))])
    turned_back = Body(scene.bodies[0].points, (0.3, 0.0, 0.0), (0.0, -0.8, 0.0))
    wrong = Scene([turned_back]).poses(0)
    assert MirrorMotion(scene.window, SIGMA_PX).worse(scene.ids(0), wrong) < -100


def test_far_away_nobody_can_tell_a_motion_from_its_mirror_image() -> None:
    """At 30 m the second camera and perspective tell nothing of half a metre of depth."""
    scene = Scene([Body(cube((0.0, 0.0, 30.0)), (1.0, 0.0, 0.0), (0.0, 0.8, 0.0))])
    mirror = MirrorMotion(scene.window, SIGMA_PX)
    assert abs(mirror.worse(scene.ids(0), scene.poses(0))) < 12


def test_two_bodies_taken_for_one_become_two() -> None:
    left = Body(cube((-0.8, 0.0, 3.5), 20), (0.5, 0.0, 0.3), (0.0, 0.4, 0.0))
    right = Body(cube((0.8, 0.0, 3.5), 14), (0.1, 0.3, -0.3), (0.3, 0.0, 0.0))
    scene = Scene([left, right])
    parts = scene.review().of(scene.object(np.arange(34)))
    found = sorted((part.members.tolist() for part in parts), key=len)
    assert [len(members) for members in found] == [14, 20]
    assert found == [scene.ids(1).tolist(), scene.ids(0).tolist()]


@pytest.mark.parametrize("left", [0, 30])
def test_what_the_first_camera_does_not_see_another_one_may(left: int) -> None:
    """Two bodies become two all the same, and tracks that no camera sees are of none."""
    bodies = [
        Body(cube((x, 0.0, 3.5)), (0.5 * x, 0.3, -0.3 * x), (0.0, 0.4 * x, 0.0)) for x in (-1, 1)
    ]
    scene = Scene(bodies)
    item, (first, second) = scene.object(np.arange(40)), scene.window.frames[-1].cameras
    first, second = first.select(first.ids < left), second.select(second.ids < 38)
    scene.window.frames[-1] = FeatureFrame(scene.stamps[-1], (first, second))
    ids, pixels = scene.window.pixels(item.members)
    assert ids.tolist() == list(range(38))
    np.testing.assert_array_equal(pixels[:left], first.pixels)
    np.testing.assert_array_equal(pixels[left:], second.pixels[left:])
    found = sorted(part.members.tolist() for part in scene.review().of(item))
    assert found == [list(range(20)), list(range(20, 38))]


@pytest.mark.parametrize("count", [7, 20, 60])
def test_one_body_stays_one(count: int) -> None:
    scene = Scene([Body(cube((0.3, 0.0, 3.5), count), (0.5, 0.0, 0.3), (0.0, 0.6, 0.0))])
    assert scene.review().of(scene.object(scene.ids(0))) == []


def test_a_track_goes_over_to_the_object_that_it_fits() -> None:
    """Those that were given to the wrong one; what stands still goes to none of them."""
    left = Body(cube((-0.8, 0.0, 3.5)), (0.5, 0.0, 0.2))
    right = Body(cube((0.8, 0.0, 3.5)), (-0.4, 0.3, 0.0))
    wall = Body(cube((0.0, 0.0, 4.5), 30, 1.0), (0.0, 0.0, 0.0))
    scene = Scene([left, right, wall])
    one, other = scene.object(scene.ids(0)[:-2]), scene.object(scene.ids(1), number=2)
    one.members = np.union1d(one.members, scene.ids(1)[:3])  # wrong ones
    other.members = scene.ids(1)[3:-2]
    obs = scene.window.observations(np.arange(70), 3, scene.stamps)
    free = obs.subset(~np.isin(obs.ids, [*one.members, *other.members]))
    projection = scene.window.projection()
    test = judge_tracks(free, projection, scene.ego, SIGMA_PX, BACKEND, CONFIG)
    labels = TrackLabels(scene.window.frames[-1])
    TrackAssignment(scene.window, labels, scene.ego, SIGMA_PX).join([one, other], test)
    assert one.members.tolist() == scene.ids(0).tolist()
    assert other.members.tolist() == scene.ids(1).tolist()


@pytest.mark.slow
def test_two_objects_side_by_side() -> None:
    """Their motions, and what is said of the errors; without masks. One is in test_objects."""
    sequence = simulate(
        duration_s=6.0, rate_hz=RATE_HZ, seed=3, tracks={"pixel_sigma": SIGMA_PX},
        objects={"count": 2},
    )  # fmt: skip
    changes = {"objects.enabled": True, "backend.noise.pixel_sigma": SIGMA_PX}
    result = run(sequence, overrides={**changes, "final_ba.enabled": False})
    found = result.metrics["moving_objects"]["accuracy"]
    assert found["steps"] > 60
    assert found["median_motion_rotation_deg"] < 0.5
    assert found["motion_rotation_deg"] < 1.0
    assert found["nees"] < 2.0


# --- policies ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["okvis", "msckf", "swf", "ekf"])
def test_objects_hold_no_features_in_the_state_where_others_are_linearised_anew(name: str) -> None:
    """They enter it when two frames have seen them, with depths that are off by a third of it."""
    policies = load_config(name).algorithm
    taken = object_policies(policies)
    expected = 0 if name == "okvis" else policies.cost.max_state_features
    assert taken.cost.max_state_features == expected
    assert taken.gauss_newton == policies.gauss_newton
