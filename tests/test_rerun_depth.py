# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Depth images in Rerun: back-projected as Rerun does it, they are what was measured."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from rerun_rows import Row, rows_of
from scipy.spatial import cKDTree

import slam_graph as sg
from slam_graph.arrays import FloatArray
from slam_graph.sensors import Camera, CameraFrame, DepthSensor
from slam_graph.simulation import simulate
from slam_graph.simulation.simulator import euroc_rig
from slam_graph.visualization import RerunRecording
from slam_graph.visualization.rerun_depth import DepthView
from slam_graph.visualization.rerun_stream import RerunStream

NORMAL, DISTANCE = np.array([0.2, -0.3, 0.9]), 2.5
"""A plane in the frame of the camera, m."""

CAMERAS = {
    "none": Camera(517.3, 516.5, 318.6, 255.3, "none", (), 640, 480),
    "radtan": Camera(458.0, 457.0, 367.0, 248.0, "radtan", (-0.28, 0.07, 2e-4, 2e-5), 752, 480),
    "equidistant": Camera(190.0, 190.0, 254.0, 256.0, "equidistant", (3e-3, 7e-4, 0, 0), 512, 512),
}


def plane_seen_by(camera: Camera) -> Any:
    """(height, width) depth of the plane, NaN where a pixel does not see it."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays, seen = camera.visible(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    depth = DISTANCE / (np.column_stack([rays, np.ones(len(rays))]) @ NORMAL)
    depth[~seen | (depth < 0.3) | (depth > 10.0)] = np.nan
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def points_in_world(row: Row) -> FloatArray:
    """The cloud that Rerun makes of a depth image: pixel (0, 0) is at (0, 0) in its calibration."""
    units = cv2.imdecode(np.frombuffer(bytes(row["blob"][0]), np.uint8), cv2.IMREAD_UNCHANGED)
    K = np.reshape(row["image_from_camera"][0], (3, 3)).T
    v, u = np.nonzero(units)
    z = units[v, u] / row["meter"][0]
    local = np.column_stack([(u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1], z])
    R = np.reshape(row["mat3x3"][0], (3, 3)).T
    return np.asarray(local @ R.T + row["translation"][0])


@pytest.mark.parametrize("lens", CAMERAS)
def test_a_plane_stays_a_plane_through_every_lens(lens: str, tmp_path: Path) -> None:
    camera, rig = CAMERAS[lens], euroc_rig()
    mounted = replace(rig.cameras[0], camera=camera)
    rig = replace(rig, cameras=(mounted,), depth=DepthSensor())
    stream = RerunStream("save", "plane", tmp_path / "plane.rrd")
    world_T_body = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.0), np.array([4.0, -2.0, 1.0]))
    view = DepthView(stream, "world/depth", rig)
    stream.at(0, 0)
    view.show(CameraFrame(0, (None,), plane_seen_by(camera)), world_T_body)
    stream.close()
    (row,) = rows_of(tmp_path / "plane.rrd")["/world/depth"]
    points = points_in_world(row)
    camera_T_world = (world_T_body * mounted.body_T_camera).inverse()
    local = points @ camera_T_world.rotation().matrix().T + camera_T_world.translation()
    off = np.abs(local @ NORMAL - DISTANCE)
    assert len(points) > 5000
    # the nearest pixel, at most half a pixel off in either direction, in millimetres
    by_ray = camera.distort(local[:, :2] / local[:, 2:])[1]
    half_px = np.sqrt(0.5) * np.linalg.norm(np.linalg.inv(by_ray), ord=2, axis=(1, 2))
    allowed = 1e-3 + local[:, 2] * np.linalg.norm(NORMAL[:2]) * half_px
    assert np.all(off < (1e-3 if lens == "none" else allowed))


def test_frames_without_depth_take_the_last_one_away_once(tmp_path: Path) -> None:
    camera = CAMERAS["none"]
    rig = euroc_rig()
    rig = replace(
        rig, cameras=(replace(rig.cameras[0], camera=camera),), depth=DepthSensor.kinect()
    )
    stream = RerunStream("save", "gaps", tmp_path / "gaps.rrd")
    view, depth = DepthView(stream, "world/depth", rig), plane_seen_by(camera)
    for frame, has_depth in enumerate([False, True, True, False, False, True]):
        stream.at(frame, frame)
        view.show(CameraFrame(frame, (None,), depth if has_depth else None))
    stream.close()
    rows = rows_of(tmp_path / "gaps.rrd")["/world/depth"]
    assert [row["frame"] for row in rows if "blob" in row] == [1, 2, 5]
    assert [row["frame"] for row in rows if "is_recursive" in row] == [3]


def test_a_run_shows_depth_where_the_walls_are(tmp_path: Path) -> None:
    depth = {"sensor": "stereo", "noise_scale": 0.0}
    sequence = simulate(
        trajectory="figure8", kind="images", duration_s=2.0, rate_hz=10.0, cameras=1, depth=depth
    )
    viewer = RerunRecording("save", "depth", tmp_path / "depth.rrd").viewer()
    result = sg.run(sequence, viewer=viewer, final_ba={"enabled": False})
    assert not result.warnings["viewer_failed"]
    rows = rows_of(tmp_path / "depth.rrd")["/world/depth"]
    assert len(rows) == len(result.trajectory)
    first, last = points_in_world(rows[0]), points_in_world(rows[-1])
    assert np.linalg.norm(np.subtract(rows[0]["translation"], rows[-1]["translation"])) > 0.2
    # both are of the same room: points are some 4 cm apart in each
    assert np.median(cKDTree(first).query(last)[0]) < 0.04


def test_a_recording_without_depth_has_none(tmp_path: Path) -> None:
    sequence = simulate(kind="images", duration_s=1.0, rate_hz=10.0, cameras=1)
    with RerunRecording("save", "plain", tmp_path / "plain.rrd") as recording:
        recording.show_recording(sequence)
    assert not rows_of(tmp_path / "plain.rrd")["/world/body/depth"]
    assert len(rows_of(tmp_path / "plain.rrd")["/world/body/cam0/image"]) > 5
