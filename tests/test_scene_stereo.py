# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Exports of two cameras: poses and lenses of both, judged by OpenCV on the exported images.

Matches between the two images of a keyframe are found by OpenCV alone, without poses or points, so
that they are independent of what was exported.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from map_flights import World

import slam_graph as sg
from slam_graph.results.scene import Scene, SceneImage
from slam_graph.results.scene_files import write_colmap, write_nerfstudio
from slam_graph.results.scene_points import refined_points
from slam_graph.sensors import Camera, RigCamera

PIXEL_CENTRE = 0.5
"""In COLMAP and nerfstudio the centre of the top left pixel is there; in OpenCV it is 0."""


@dataclass(frozen=True)
class Exported:
    """An image as one of the formats describes it: `camera_R_world`, `camera_t_world`, lens."""

    camera: int
    name: str
    R: np.ndarray
    t: np.ndarray
    K: np.ndarray
    lens: np.ndarray
    fisheye: bool
    seen: np.ndarray

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) by OpenCV."""
        turn = cv2.Rodrigues(self.R)[0]
        if self.fisheye:
            return cv2.fisheye.projectPoints(points[:, None], turn, self.t, self.K, self.lens)[0][
                :, 0
            ]
        return cv2.projectPoints(points, turn, self.t, self.K, self.lens)[0][:, 0]

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Normalised coordinates (N, 2) of pixels (N, 2) by OpenCV."""
        undistort = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
        return undistort(np.ascontiguousarray(pixels)[:, None], self.K, self.lens)[:, 0]


def matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """The camera matrix in the pixels of OpenCV."""
    return np.array([[fx, 0, cx - PIXEL_CENTRE], [0, fy, cy - PIXEL_CENTRE], [0, 0, 1]])


def rows(path: Path) -> list[list[str]]:
    lines = path.read_text().splitlines()
    return [line.split() for line in lines if not line.startswith("#")]


def turn(qw: float, *q: float) -> np.ndarray:
    """The matrix of a quaternion by OpenCV."""
    length = float(np.linalg.norm(q))
    return cv2.Rodrigues(2 * np.arctan2(length, qw) * np.array(q) / max(length, 1e-12))[0]


def of_colmap(model: Path) -> list[Exported]:
    """All images of a model in text format."""
    cameras = {row[0]: row for row in rows(model / "cameras.txt")}
    lines, found = rows(model / "images.txt"), []
    for head, seen in zip(lines[::2], lines[1::2], strict=True):
        _, name, _, _, *values = cameras[head[8]]
        numbers = [float(value) for value in values]
        found.append(
            Exported(
                int(head[8]) - 1,
                head[9],
                turn(*map(float, head[1:5])),
                np.array(head[5:8], float),
                matrix(*numbers[:4]),
                np.array(numbers[4:]),
                name == "OPENCV_FISHEYE",
                np.array(seen, float).reshape(-1, 3),
            )
        )
    return found


def of_nerfstudio(file: Path) -> list[Exported]:
    """All frames; a camera of OpenGL looks along -z with y up."""
    table, found = json.loads(file.read_text()), []
    fisheye = table["camera_model"] == "OPENCV_FISHEYE"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    for frame in table["frames"]:
        world_T_camera = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        camera_T_world = np.linalg.inv(world_T_camera)
        name = frame["file_path"].removeprefix("images/")
        found.append(
            Exported(
                int(name[3]),
                name,
                camera_T_world[:3, :3],
                camera_T_world[:3, 3],
                matrix(*(frame[key] for key in ("fl_x", "fl_y", "cx", "cy"))),
                np.array([frame[name] for name in names]),
                fisheye,
                np.zeros((0, 3)),
            )
        )
    return found


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both formats of a run with two cameras on rendered images, with its map."""
    root = tmp_path_factory.mktemp("stereo")
    flight = sg.simulate(kind="images", duration_s=4.0, rate_hz=8.0, cameras=2, seed=3)
    flight.save(root / "flight")
    result = sg.run(root / "flight", overrides={"map.enabled": True})
    result.check()
    result.save(root / "result")
    sg.load_result(root / "result").export(root / "scene", sg.open_dataset(root / "flight"))
    return root / "scene"


def pairs(images: list[Exported]) -> list[tuple[Exported, Exported]]:
    """Images of both cameras at the same times."""
    at = {(image.camera, Path(image.name).name): image for image in images}
    return [(image, at[1, name]) for (camera, name), image in at.items() if camera == 0]


@pytest.mark.slow
def test_points_project_to_where_both_cameras_have_seen_them(scene: Path) -> None:
    model = scene / "sparse" / "0"
    points = {int(row[0]): np.array(row[1:4], float) for row in rows(model / "points3D.txt")}
    images = of_colmap(model)
    assert {image.camera for image in images} == {0, 1}
    assert len(pairs(images)) == len(images) // 2 > 4
    for camera in (0, 1):
        errors = []
        for image in images:
            if image.camera == camera and len(image.seen):
                X = np.array([points[int(number)] for number in image.seen[:, 2]])
                found = image.seen[:, :2] - PIXEL_CENTRE
                errors.append(np.linalg.norm(image.project(X) - found, axis=1))
        assert len(np.concatenate(errors)) > 100
        assert np.median(np.concatenate(errors)) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("file", ["sparse/0", "transforms.json"])
def test_matches_that_opencv_finds_lie_on_the_epipolar_lines(scene: Path, file: str) -> None:
    """And depths by triangulation are positive: the baseline has the right sign."""
    images = of_colmap(scene / file) if file == "sparse/0" else of_nerfstudio(scene / file)
    distances, depths = [], []
    for left, right in pairs(images):
        first, second = matches(*(scene / "images" / image.name for image in (left, right)))
        if not len(first):
            continue
        R = right.R @ left.R.T
        t = right.t - R @ left.t
        a, b = left.rays(first), right.rays(second)
        lines = np.column_stack([a, np.ones(len(a))]) @ (skew(t) @ R).T
        off = np.abs(np.sum(lines * np.column_stack([b, np.ones(len(b))]), axis=1))
        distances.append(right.K[0, 0] * off / np.linalg.norm(lines[:, :2], axis=1))
        cameras = np.eye(3, 4), np.column_stack([R, t])
        X = cv2.triangulatePoints(*cameras, a.T, b.T)
        depths.append(X[2] / X[3])
    assert len(np.concatenate(distances)) > 200
    assert np.median(np.concatenate(distances)) < 0.5
    assert np.mean(np.concatenate(depths) > 0.0) > 0.95


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def matches(left: Path, right: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of corners in two images, tracked there and back."""
    a, b = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in (left, right))
    corners = cv2.goodFeaturesToTrack(a, 150, 0.01, 12)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    there, found, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None, maxLevel=5)
    back, again, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, maxLevel=5)
    same = np.linalg.norm(back - corners, axis=2)[:, 0] < 0.3
    good = same & (found[:, 0] == 1) & (again[:, 0] == 1)
    return corners[good, 0].astype(float), there[good, 0].astype(float)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("none", []),
        ("radtan", [-0.28, 0.07, 2e-4, 2e-5]),
        ("equidistant", [-0.01, 0.012, -0.008, 0.002]),
    ],
)
def test_every_lens_is_that_of_opencv_by_its_name(
    model: str, coefficients: list[float], tmp_path: Path
) -> None:
    """The same points in the same pixels, in both formats, for cameras that differ."""
    rng = np.random.default_rng(2)
    mounted, images = [], []
    points = rng.uniform((-2, -2, 3), (2, 2, 6), (40, 3))
    for number in range(2):
        K = (458.0 + number, 457.0, 367.0, 248.0 - number)
        camera = Camera(*K, model, tuple(coefficients), 752, 480)
        pose = gtsam.Pose3.Expmap(np.append(rng.normal(0, 0.1, 3), (0.11 * number, 0, 0)))
        mounted.append(RigCamera(camera, pose))
        inside = pose.transformTo(points.T).T
        seen = camera.project(inside)
        images.append(SceneImage(f"cam{number}/1.png", number, pose, seen, np.arange(40)))
    made = Scene(tuple(mounted), images, points, np.full(40, 99))
    write_colmap(tmp_path, made)
    write_nerfstudio(tmp_path, made)
    for exported in of_colmap(tmp_path):
        expected = exported.seen[:, :2] - PIXEL_CENTRE
        np.testing.assert_allclose(exported.project(points), expected, atol=1e-3)
    table = json.loads((tmp_path / "transforms.json").read_text())
    if model == "none":  # nerfstudio takes missing coefficients as zero
        assert table["camera_model"] == "OPENCV"
        return
    for exported, image in zip(of_nerfstudio(tmp_path / "transforms.json"), images, strict=True):
        np.testing.assert_allclose(exported.project(points), image.pixels, atol=1e-6)


def test_points_go_where_their_observations_meet() -> None:
    """An observation pulls no more the farther off it is; a point that is not known stays so."""
    known = World().map()
    rng = np.random.default_rng(7)
    exact = refined_points(known)
    off = rng.normal(0.0, 0.01, known.points.shape)
    moved = refined_points(replace(known, points=exact + off))
    counts = np.bincount(known.features[known.features >= 0], minlength=len(exact))
    often = counts > 2
    assert often.sum() > 20
    before, after = (np.linalg.norm(d, axis=1)[often] for d in (off, moved - exact))
    assert np.median(after) < 0.2 * np.median(before)
    row = int(np.flatnonzero(known.features == np.argmax(counts))[0])
    pulls = []
    for error in (0.02, 0.3):
        wrong = known.normalized.copy()
        wrong[row] += error
        pulled = refined_points(replace(known, points=exact, normalized=wrong))
        pulls.append(float(np.linalg.norm(pulled - exact, axis=1).max()))
    assert pulls[1] < 2.0 * pulls[0], "an error that is 15 times as large"
    nowhere = exact.copy()
    nowhere[0] = np.nan
    assert np.isnan(refined_points(replace(known, points=nowhere))[0]).all()
