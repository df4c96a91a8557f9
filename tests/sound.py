# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What must hold of all that was read, from a damaged file too: finite values, times in order."""

from pathlib import Path
from typing import Any

import numpy as np
from damage import CAMPAIGN
from properties import LARGEST_STAMP_NS

from slam_graph.bundle_adjustment.bal_problem import BalProblem
from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.streams.mask_images import LARGEST_LABEL
from slam_graph.geometry import NavState, Trajectory
from slam_graph.maps.map_model import NO_FEATURE, SlamMap
from slam_graph.pose_graph import PoseGraph, Poses, optimize_pose_graph
from slam_graph.sensors import (
    AidingData,
    Camera,
    CameraFrame,
    FeatureFrame,
    FeatureObservations,
    ImuNoise,
    Rig,
)


def sound_dataset(path: Path, **options: Any) -> None:
    """Everything that a run reads of the recording in a file or folder."""
    sequence = open_dataset(path, **options)
    assert isinstance(sequence, RecordedSequence)
    sound_recording(sequence)


def sound_recording(sequence: RecordedSequence) -> None:
    """Everything that a run reads of a recording."""
    sound_rig(sequence.rig)
    info = sequence.info()
    assert info.start_ns <= info.end_ns
    sound_stamps(np.array([info.start_ns]), np.array([info.end_ns]))
    assert min(info.frames, info.imu_samples, info.depth_frames) >= 0
    truth, start = sequence.groundtruth(), sequence.initial_state()
    if truth is not None:
        sound_trajectory(truth)
    if start is not None:
        sound_state(start)
    for path in sequence.object_truth().values():
        sound_trajectory(path)
    labels, last_ns, last_sample_ns = sequence.labels_over_time(), None, None
    for packet in sequence.packets():
        frame, imu = packet.frame, packet.imu
        sound_stamps(np.array([frame.stamp_ns]), imu.stamps_ns)
        assert last_ns is None or frame.stamp_ns > last_ns
        assert last_sample_ns is None or not len(imu) or imu.stamps_ns[0] > last_sample_ns
        last_ns = frame.stamp_ns
        last_sample_ns = int(imu.stamps_ns[-1]) if len(imu) else last_sample_ns
        assert np.isfinite(np.square([imu.gyro, imu.accel])).all()
        if packet.aiding is not None:
            sound_aiding(packet.aiding)
        if isinstance(frame, CameraFrame):
            sound_images(frame, sequence.rig)
            label_image = sequence.label_image(frame.stamp_ns)
            first = sequence.rig.cameras[0].camera
            assert label_image is None or label_image.shape == (first.height, first.width)
        else:
            sound_features(frame if labels is None else labels.labelled(frame))


def sound_stamps(*series: np.ndarray) -> None:
    """Times in order, of which differences fit into 64 bits."""
    for stamps in series:
        assert stamps.dtype == np.int64
        assert np.all(stamps[1:] > stamps[:-1])
        assert np.all((stamps > -LARGEST_STAMP_NS) & (stamps < LARGEST_STAMP_NS))


def sound_state(state: NavState) -> None:
    """A finite state, with a covariance that is none or finite and not negative."""
    sound_stamps(np.array([state.stamp_ns]))
    assert np.isfinite(state.world_T_body.matrix() ** 2).all()
    assert np.isfinite(np.square([state.velocity, state.gyro_bias, state.accel_bias])).all()
    if state.covariance is not None:
        assert np.isfinite(state.covariance).all()
        assert np.all(np.diag(state.covariance) >= 0.0)


def sound_images(frame: CameraFrame, rig: Rig) -> None:
    """Images of the size that the calibration says, and depths within the range of the sensor."""
    for image, mounted in zip(frame.images, rig.cameras, strict=True):
        camera = mounted.camera
        assert image is None or image.shape == (camera.height, camera.width)
        assert image is None or image.dtype == np.uint8
    if frame.depth is None:
        return
    assert rig.depth is not None
    assert frame.depth_ns is not None
    sound_stamps(np.array([frame.depth_ns]))
    camera = rig.cameras[rig.depth.camera].camera
    sound_depth(frame.depth, camera, rig.depth.max_m if rig.depth.lens is None else np.inf)


def sound_depth(depth: np.ndarray, camera: Camera, most_m: float) -> None:
    """Depths in m of the size of the camera's images, NaN where there is none."""
    assert depth.shape == (camera.height, camera.width)
    assert depth.dtype == np.float32
    measured = depth[~np.isnan(depth)]
    assert np.isfinite(measured).all()
    assert np.all((measured >= 0.0) & (measured <= np.float32(most_m)))


def sound_features(frame: FeatureFrame) -> None:
    """Finite coordinates, ids that are there once in a camera, and depths with their noise."""
    for seen in (*frame.cameras, *frame.moving):
        sound_observations(seen)


def sound_observations(seen: FeatureObservations) -> None:
    """What `sound_features` says, of one camera."""
    assert len(np.unique(seen.ids)) == len(seen)
    for values in (seen.pixels, seen.normalized):
        assert values.shape == (len(seen), 2)
        assert np.isfinite(values**2).all()
    if seen.depth_m is not None:
        assert seen.depth_sigma_m is not None
        np.testing.assert_array_equal(np.isnan(seen.depth_m), np.isnan(seen.depth_sigma_m))
        known = ~np.isnan(seen.depth_m)
        assert np.isfinite(seen.depth_m[known] ** 2).all()
        assert np.all((seen.depth_m[known] > 0.0) & (seen.depth_sigma_m[known] > 0.0))
    if seen.labels is not None:
        assert np.all((seen.labels >= 0) & (seen.labels <= LARGEST_LABEL))


def sound_aiding(data: AidingData) -> None:
    """Finite fixes, poses and odometry in the order of time, with noise that is positive."""
    sound_stamps(data.fix_stamps_ns, data.pose_stamps_ns, data.odometry_stamps_ns)
    for positions in (data.fix_positions, data.pose_positions, data.odometry_positions):
        assert np.isfinite(positions**2).all()
    assert np.isfinite(data.fix_covariances**2).all()
    assert np.isfinite(np.linalg.inv(data.fix_covariances) ** 2).all()
    for turns in (data.pose_quaternions, data.odometry_quaternions):
        np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1.0, atol=0.02)
    assert np.all(data.pose_sigmas > 0.0)  # infinite where nothing was measured
    if data.datum is not None:
        assert np.all(np.abs(data.datum) <= [90.0, 360.0, 1e8])


def sound_map(found: SlamMap) -> None:
    """Finite values, keyframes in the order of time, and indices of what is there."""
    for recording in found.recordings:
        sound_rig(recording.rig)
    for path in found.trajectories():
        if len(path):
            sound_trajectory(path)
    for values in (found.points, found.normalized, found.links.covariances, found.vocabulary.idf):
        assert np.isfinite(values**2).all()
    sound_poses(found.poses)
    if len(found.links):
        sound_poses(found.links.measured)
        assert np.all(np.linalg.eigvalsh(found.links.covariances) > 0.0)
    assert found.offsets[0] == 0
    assert found.offsets[-1] == len(found.features)
    assert np.all(found.offsets[1:] >= found.offsets[:-1])
    for indices, least, count in (
        (found.features, NO_FEATURE, len(found.points)),
        (found.recording_of, 0, len(found.recordings)),
        (found.links.ends, 0, len(found)),
    ):
        assert np.all((indices >= least) & (indices < count))


def sound_trajectory(path: Trajectory) -> None:
    """Times in order, finite values, and quaternions of unit length."""
    sound_stamps(path.stamps_ns)
    with_states = (path.velocities, path.gyro_biases, path.accel_biases)
    for values in (path.positions, *(part for part in with_states if part is not None)):
        assert np.isfinite(values**2).all()
    np.testing.assert_allclose(np.linalg.norm(path.quaternions, axis=1), 1.0, atol=0.02)


def sound_rig(rig: Rig) -> None:
    """A rig that images can be of: its numbers have squares that are finite."""
    sound_noise(rig.imu)
    for mounted in rig.cameras:
        sound_camera(mounted.camera)
        assert np.isfinite(mounted.body_T_camera.matrix() ** 2).all()
        assert abs(mounted.time_offset_s) * 1e9 < LARGEST_STAMP_NS
        assert np.isfinite(mounted.readout_s)
    if rig.depth is not None:
        sensor = rig.depth
        values = np.array([sensor.scale, sensor.min_m, sensor.max_m, *sensor.sigma_m(np.ones(2))])
        assert np.isfinite(values**2).all()
        assert np.isfinite(sensor.camera_T_depth.matrix() ** 2).all()
        if sensor.lens is not None:
            sound_camera(sensor.lens)


def sound_noise(noise: ImuNoise) -> None:
    """Variances and periods that are finite, and not zero."""
    values = np.array(list(vars(noise).values()))
    assert np.all(values > 0)
    assert np.all((values**2 > 0) & np.isfinite(values**2))


def sound_camera(camera: Camera) -> None:
    """An image of some size, and pixels that have rays, or none, without an overflow."""
    for size in (camera.width, camera.height):
        assert isinstance(size, int)
        assert 0 < size < 2**16
    assert camera.fx > 0
    assert camera.fy > 0
    corners = np.array([[0.0, 0.0], [camera.width, camera.height], [camera.cx, camera.cy]])
    rays = camera.undistort(corners)
    assert rays.shape == (3, 2)
    assert np.isfinite(camera.distort(np.array([[0.0, 0.0], [0.1, -0.1]]))[0]).all()


def sound_graph(graph: PoseGraph) -> None:
    """Finite poses and rotations, edges between poses, and information that is positive."""
    parts = [graph.measured, graph.anchor_poses()]
    for poses in parts if graph.estimates is None else [*parts, graph.estimates]:
        sound_poses(poses)
    assert np.all(np.diff(graph.keys) > 0)
    assert graph.edges.min() >= 0
    assert graph.edges.max() < len(graph.keys)
    assert np.isfinite(graph.information**2).all()
    assert np.all(np.linalg.eigvalsh(graph.information) > 0)
    if CAMPAIGN:
        sound_poses(optimize_pose_graph(graph).minimum.poses)


def sound_poses(poses: Poses) -> None:
    """Rotations, and translations whose squares are finite."""
    assert np.isfinite(poses.translations**2).all()
    gram = poses.rotations @ poses.rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(gram, np.tile(np.eye(poses.dimension), (len(gram), 1, 1)), atol=1e-6)


def sound_problem(problem: BalProblem) -> None:
    """Finite numbers, and observations of cameras and points that there are."""
    found = problem.estimates
    for values in (found.translations, found.intrinsics, found.points, problem.pixels):
        assert np.isfinite(values**2).all()
    sound_poses(Poses(found.rotations, found.translations))
    for rows, count in ((problem.camera, problem.cameras), (problem.point, problem.points)):
        assert rows.min() >= 0
        assert rows.max() < count


def sound_table(table: Any) -> None:
    """Tables and lists whose numbers are finite."""
    if isinstance(table, dict):
        table = list(table.values())
    if isinstance(table, list):
        for value in table:
            sound_table(value)
    elif isinstance(table, float):
        assert np.isfinite(table)
