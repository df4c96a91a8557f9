# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Exports for COLMAP and nerfstudio: what OpenCV projects by them is what was observed."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

import slam_graph as sg
from slam_graph.cli.main import app
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.errors import ConfigError, DataError
from slam_graph.results.scene import Scene, SceneImage
from slam_graph.results.scene_files import write_colmap


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds of rendered images of one camera, as a recording."""
    folder = tmp_path_factory.mktemp("scene") / "flight"
    sg.simulate(kind="images", duration_s=3.0, rate_hz=8.0, cameras=1, seed=3).save(folder)
    return folder


@pytest.fixture(scope="module")
def result(flight: Path) -> Path:
    """A run on it that saved a map."""
    folder = flight.parent / "result"
    found = sg.run(flight, overrides={"map.enabled": True})
    found.check()
    found.save(folder)
    return folder


@pytest.fixture(scope="module")
def scene(flight: Path, result: Path) -> Path:
    folder = flight.parent / "scene"
    sg.load_result(result).export(folder, sg.open_dataset(flight))
    return folder


def rows(path: Path) -> list[list[str]]:
    lines = path.read_text().splitlines()
    return [line.split() for line in lines if not line.startswith("#")]


def test_the_model_of_colmap_projects_to_what_was_observed(scene: Path, result: Path) -> None:
    model = scene / "sparse" / "0"
    ((_, name, *numbers),) = rows(model / "cameras.txt")
    assert name == "OPENCV"
    fx, fy, cx, cy, *distortion = map(float, numbers[2:])
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    points = {int(row[0]): np.array(row[1:4], float) for row in rows(model / "points3D.txt")}
    tracks = {int(row[0]): row[8:] for row in rows(model / "points3D.txt")}
    images = rows(model / "images.txt")
    known = sg.load_result(result).slam_map
    assert known is not None
    assert len(images) > 2 * len(known) > 4
    assert np.mean([len(seen) > 30 for seen in images[1::2]]) > 0.9, "observations: 3 words each"
    errors, observations = [], 0
    for head, seen in zip(images[::2], images[1::2], strict=True):
        qw, qx, qy, qz, *t = map(float, head[1:8])
        angle = 2 * np.arctan2(np.linalg.norm([qx, qy, qz]), qw)
        axis = np.array([qx, qy, qz]) / max(np.linalg.norm([qx, qy, qz]), 1e-12)
        assert cv2.imread(str(scene / "images" / head[9])).shape == (480, 752, 3)
        if not seen:
            continue
        table = np.array(seen, float).reshape(-1, 3)
        observations += len(table)
        X = np.array([points[int(number)] for number in table[:, 2]])
        pixels = cv2.projectPoints(X, angle * axis, np.array(t), K, np.array(distortion))[0]
        errors += np.linalg.norm(pixels[:, 0] - table[:, :2], axis=1).tolist()
        number, row = head[0], len(table) - 1
        pairs = np.array(tracks[int(table[row, 2])]).reshape(-1, 2).tolist()
        assert [number, str(row)] in pairs
    assert sum(len(track) for track in tracks.values()) == 2 * observations
    assert np.median(errors) < 1.0


def test_images_have_the_poses_that_were_asked_for(
    flight: Path, result: Path, tmp_path: Path
) -> None:
    """Points of a map fit the poses that it was made of, and no others."""
    saved = sg.load_result(result)
    assert saved.exported_poses()[0] == "smoothed"
    words = ("export", result, "--recording", flight, "--colmap", tmp_path / "a", "--which")
    refused = CliRunner().invoke(app, [*map(str, words), "causal"])
    assert isinstance(refused.exception, DataError)
    assert "give --which smoothed" in str(refused.exception)
    assert not (tmp_path / "a").exists()
    plain = shutil.copytree(result, tmp_path / "plain")
    (plain / "map.slam").unlink()
    texts = set()
    for which in ("causal", "smoothed"):
        sg.load_result(plain).export(
            tmp_path / which, sg.open_dataset(flight), ["colmap"], which=which
        )
        texts.add((tmp_path / which / "sparse" / "0" / "images.txt").read_text())
    assert len(texts) == 2
    with pytest.raises(DataError, match="no trajectory of the kind 'loop'"):
        sg.load_result(plain).export(tmp_path, sg.open_dataset(flight), which="loop")


def test_poses_of_images_are_those_of_the_calibration_at_the_end(
    flight: Path, result: Path, tmp_path: Path
) -> None:
    """A clock that was corrected and a mounting and focal length that were estimated."""
    plain = shutil.copytree(result, tmp_path / "plain")
    (plain / "map.slam").unlink()
    rig, trajectory = sg.load_result(plain).rig, sg.load_result(plain).best_trajectory
    first = rig.cameras[0]
    turned = first.body_T_camera.compose(gtsam.Pose3(gtsam.Rot3.Rx(0.03), np.zeros(3)))
    camera = replace(first.camera, fx=first.camera.fx + 5.0)
    estimated = replace(first, camera=camera, body_T_camera=turned, time_offset_s=0.06)
    write_kalibr(replace(rig, cameras=(estimated,)), plain / "calibration_estimated.yaml")
    sg.load_result(plain).export(tmp_path / "scene", sg.open_dataset(flight), ["colmap"])
    model = tmp_path / "scene" / "sparse" / "0"
    assert float(rows(model / "cameras.txt")[0][4]) == pytest.approx(camera.fx)
    images = [line for line in rows(model / "images.txt") if line and line[-1].endswith(".png")]
    assert len(images) > 5
    for _, *numbers, _, name in images:
        stamp_ns = int(Path(name).stem) + 60_000_000
        q, t = numbers[:4], np.array(numbers[4:7], float)
        camera_T_world = gtsam.Pose3(gtsam.Rot3.Quaternion(*map(float, q)), t)
        expected = trajectory.at(stamp_ns).compose(turned)
        assert camera_T_world.inverse().equals(expected, 1e-6)


def test_two_formats_are_not_written_into_one_file(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    other = tmp_path / "folder" / ".." / "poses"
    words = ("export", tmp_path, "--euroc", tmp_path / "poses", "--kitti", other)
    refused = CliRunner().invoke(app, [*map(str, words)]).exception
    assert isinstance(refused, ConfigError)
    assert "--kitti and --euroc name the same file" in str(refused)


def references(model: Path) -> tuple[set[tuple[int, int, int]], set[tuple[int, int, int]]]:
    """(image, observation, point) as the images have them, and as the points have them."""
    images, points = rows(model / "images.txt"), rows(model / "points3D.txt")
    of_images = {
        (int(head[0]), row, int(point))
        for head, seen in zip(images[::2], images[1::2], strict=True)
        for row, point in enumerate(seen[2::3])
        if int(point) != -1
    }
    of_points = {
        (int(image), int(row), int(point[0]))
        for point in points
        for image, row in zip(point[8::2], point[9::2], strict=True)
    }
    return of_images, of_points


def test_images_and_points_refer_to_each_other(scene: Path, tmp_path: Path) -> None:
    """Also where the place of a point is not known: COLMAP has -1 for such an observation."""
    of_images, of_points = references(scene / "sparse" / "0")
    assert len(of_images) > 100
    assert of_images == of_points
    camera = sg.simulate(duration_s=0.1, cameras=1).rig.cameras
    pixels = np.arange(8.0).reshape(4, 2)
    pose = gtsam.Pose3()
    seen = [SceneImage(f"{k}.png", 0, pose, pixels, np.array([2, 0, 3, 1])) for k in range(2)]
    points = np.array([[0, 0, 2], [np.nan, 0, 2], [1, 0, 2], [0, np.inf, 2]], np.float64)
    made = Scene(camera, seen, points, np.full(4, 128))
    write_colmap(tmp_path, made)
    of_images, of_points = references(tmp_path)
    assert of_images == of_points == {(n, row, p) for n in (1, 2) for row, p in ((0, 3), (1, 1))}
    assert [len(line) for line in rows(tmp_path / "images.txt")[1::2]] == [12, 12]


def test_nerfstudio_has_the_same_cameras(scene: Path) -> None:
    """Poses, intrinsics and files."""
    table = json.loads((scene / "transforms.json").read_text())
    heads = rows(scene / "sparse" / "0" / "images.txt")[::2]
    assert [f["file_path"] for f in table["frames"]] == [f"images/{head[9]}" for head in heads]
    ((_, model, width, height, *values),) = rows(scene / "sparse" / "0" / "cameras.txt")
    intrinsics = dict(
        zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"), values, strict=True)
    )
    assert table["camera_model"] == model == "OPENCV"
    for frame, head in zip(table["frames"], heads, strict=True):
        assert cv2.imread(str(scene / frame["file_path"])).shape[:2] == (frame["h"], frame["w"])
        assert (frame["w"], frame["h"]) == (int(width), int(height))
        for name, value in intrinsics.items():
            np.testing.assert_allclose(frame[name], float(value), rtol=1e-10, atol=1e-12)
        pose = np.array(frame["transform_matrix"])
        qw, qx, qy, qz, *t = map(float, head[1:8])
        R = cv2.Rodrigues(pose[:3, :3] @ np.diag([1.0, -1.0, -1.0]))[0]
        np.testing.assert_allclose(pose[:3, 3], -(_turn(qw, qx, qy, qz).T @ t), atol=1e-9)
        np.testing.assert_allclose(cv2.Rodrigues(R)[0], _turn(qw, qx, qy, qz).T, atol=1e-9)
    assert (scene / table["ply_file_path"]).read_bytes().startswith(b"ply\n")


def _turn(w: float, x: float, y: float, z: float) -> np.ndarray:
    """The matrix of a unit quaternion."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_without_a_map_keyframes_are_chosen_by_motion(
    flight: Path, result: Path, tmp_path: Path
) -> None:
    for file in result.iterdir():
        if file.is_file() and file.name != "map.slam":
            (tmp_path / file.name).write_bytes(file.read_bytes())
    saved = sg.load_result(tmp_path)
    assert saved.slam_map is None
    saved.export(tmp_path / "scene", sg.open_dataset(flight), ["nerfstudio"])
    frames = json.loads((tmp_path / "scene" / "transforms.json").read_text())["frames"]
    centres = np.array([np.array(frame["transform_matrix"])[:3, 3] for frame in frames])
    assert 5 < len(frames) < 32
    assert np.linalg.norm(np.diff(centres, axis=0), axis=1).max() < 1.0
    assert not (tmp_path / "scene" / "sparse").exists()


def test_the_command_writes_what_is_asked_for(flight: Path, result: Path, tmp_path: Path) -> None:
    def call(*words: object) -> tuple[int, str, BaseException | None]:
        done = CliRunner().invoke(app, ["export", str(result), *map(str, words)])
        return done.exit_code, done.output, done.exception

    files = {name: tmp_path / f"poses.{name}" for name in ("tum", "kitti", "euroc")}
    options = [word for name, path in files.items() for word in (f"--{name}", path)]
    code, printed, _ = call(*options, "--which", "causal")
    assert code == 0
    assert printed.split() == [str(path) for path in files.values()]
    causal = sg.load_result(result).trajectory
    assert all(len(rows(path)) == len(causal) for path in files.values())
    files["tum"].unlink()
    files["kitti"].write_text("of the user")
    _, printed, error = call(*options)
    assert printed == ""
    assert "replace it by --force" in str(error)
    assert not files["tum"].exists()
    assert files["kitti"].read_text() == "of the user"
    assert call(*options, "--force")[0] == 0
    assert len(rows(files["kitti"])) > 1
    assert call("--tum", os.devnull)[0] == 0
    code, _, _ = call("--colmap", tmp_path / "c", "--recording", flight)
    assert code == 0
    assert (tmp_path / "c" / "sparse" / "0" / "points3D.txt").is_file()
    assert isinstance(call()[2], ConfigError)
    assert isinstance(call("--colmap", tmp_path / "d")[2], ConfigError)
    assert isinstance(call("--tum", tmp_path / "e", "--which", "loop")[2], DataError)
    assert isinstance(call("--colmap", tmp_path / "d", "--recording", "demo")[2], DataError)
