# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A scene in the formats of COLMAP (text) and nerfstudio (`transforms.json`)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.results.scene import COLMAP_OFFSET_PX, Scene
from slam_graph.sensors import Camera, Rig

SCENE_FORMATS = ("colmap", "nerfstudio")

_MODELS = {"none": "PINHOLE", "radtan": "OPENCV", "equidistant": "OPENCV_FISHEYE"}
"""Names of the camera models in both formats; their coefficients are in the same order there."""

_NO_POINT = -1
"""In place of the number of a point, for an observation of which there is none."""

_DISTORTION = {
    "PINHOLE": (),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From a camera that looks along z with y down to one that looks along -z with y up."""


def write_colmap(folder: Path, scene: Scene) -> list[Path]:
    """Write `cameras.txt`, `images.txt` and `points3D.txt`; the poses are camera_T_world.

    Args:
        folder: made if it is missing.
        scene: with its images beside, in the folder that COLMAP is told as `--image_path`.

    Raises:
        DataError: if COLMAP has no such camera model.
    """
    Files.make_folder(folder)
    files = {
        "cameras.txt": _camera_lines(scene),
        "images.txt": _image_lines(scene),
        "points3D.txt": _point_lines(scene),
    }
    for name, lines in files.items():
        Files.write_text(folder / name, lines)
    return [folder / name for name in files]


def write_nerfstudio(folder: Path, scene: Scene, images: str = "images") -> list[Path]:
    """Write `transforms.json` and the points as `points.ply`.

    Args:
        folder: made if it is missing.
        scene: with its images below the folder.
        images: name of the folder of images, below `folder`.

    Raises:
        DataError: if nerfstudio has no such camera model, or the cameras have different ones.
    """
    Files.make_folder(folder)
    models = {_model(mounted.camera) for mounted in scene.cameras}
    if len(models) > 1:
        raise DataError("nerfstudio takes one camera model for all cameras, and these have several")
    frames = [
        {
            "file_path": f"{images}/{image.name}",
            "transform_matrix": (image.world_T_camera.matrix() @ _OPENGL).tolist(),
            **_intrinsics(scene.cameras[image.camera].camera),
        }
        for image in scene.images
    ]
    model = models.pop()
    table = {
        "camera_model": "OPENCV" if model == "PINHOLE" else model,
        "ply_file_path": "points.ply",
        "frames": frames,
    }
    Files.write_text(folder / "transforms.json", [json.dumps(table, indent=1), "\n"])
    _write_cloud(folder / "points.ply", scene)
    return [folder / "transforms.json", folder / "points.ply"]


def require_models(rig: Rig) -> None:
    """Refuse a rig with a camera that no format has a model for.

    Raises:
        DataError: naming the camera model.
    """
    for mounted in rig.cameras:
        _model(mounted.camera)


def _model(camera: Camera) -> str:
    """COLMAP's name of a camera model.

    Raises:
        DataError: if it has none.
    """
    if camera.distortion not in _MODELS:
        raise DataError(
            f"camera model '{camera.distortion}' cannot be exported; COLMAP and nerfstudio have "
            f"{', '.join(_MODELS)}"
        )
    return _MODELS[camera.distortion]


def _parameters(camera: Camera) -> list[float]:
    """fx, fy, cx, cy and the coefficients, with COLMAP's origin of pixels."""
    centre = (camera.cx + COLMAP_OFFSET_PX, camera.cy + COLMAP_OFFSET_PX)
    return [camera.fx, camera.fy, *centre, *camera.coefficients]


def _intrinsics(camera: Camera) -> dict[str, Any]:
    """The intrinsics of a frame of nerfstudio."""
    names = ("fl_x", "fl_y", "cx", "cy", *_DISTORTION[_model(camera)])
    values = (float(value) for value in _parameters(camera))
    return {"w": camera.width, "h": camera.height, **dict(zip(names, values, strict=True))}


def _camera_lines(scene: Scene) -> Iterator[str]:
    yield "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    for number, mounted in enumerate(scene.cameras, 1):
        camera = mounted.camera
        values = " ".join(f"{value:.12g}" for value in _parameters(camera))
        yield f"{number} {_model(camera)} {camera.width} {camera.height} {values}\n"


def _image_lines(scene: Scene) -> Iterator[str]:
    yield "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
    yield "# POINTS2D[] as (X, Y, POINT3D_ID)\n"
    known = scene.known
    for number, image in enumerate(scene.images, 1):
        pose = image.world_T_camera.inverse()
        q: Any = pose.rotation().toQuaternion()  # an Eigen type that the stubs do not know
        values = (q.w(), q.x(), q.y(), q.z(), *pose.translation())
        numbers = " ".join(f"{value:.12g}" for value in values)
        yield f"{number} {numbers} {image.camera + 1} {image.name}\n"
        ids = np.where(known[image.points], image.points + 1, _NO_POINT)
        rows = zip(image.pixels + COLMAP_OFFSET_PX, ids, strict=True)
        yield " ".join(f"{u:.4f} {v:.4f} {point}" for (u, v), point in rows) + "\n"


def _point_lines(scene: Scene) -> Iterator[str]:
    """Points with the images that see them; the error is the mean reprojection error in pixels."""
    tracks: list[list[str]] = [[] for _ in scene.points]
    errors = np.zeros(len(scene.points))
    for number, image in enumerate(scene.images, 1):
        if not len(image.points):
            continue
        camera = scene.cameras[image.camera].camera
        in_camera = image.world_T_camera.inverse().matrix()
        with np.errstate(all="ignore"):  # of points that are not known
            seen = scene.points[image.points] @ in_camera[:3, :3].T + in_camera[:3, 3]
            distances = np.linalg.norm(camera.project(seen) - image.pixels, axis=1)
        errors[image.points] += np.nan_to_num(distances)
        for row, point in enumerate(image.points.tolist()):
            tracks[point].append(f"{number} {row}")
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    lists = (scene.points.tolist(), scene.grey.tolist(), scene.known.tolist())
    rows = zip(*lists, errors, tracks, strict=True)
    for number, ((x, y, z), grey, known, error, track) in enumerate(rows, 1):
        if not known:
            continue
        mean = error / max(len(track), 1)
        line = f"{number} {x:.9g} {y:.9g} {z:.9g} {grey} {grey} {grey} {mean:.4g}"
        yield " ".join([line, *track]) + "\n"


def _write_cloud(path: Path, scene: Scene) -> None:
    """The points as a PLY file with float coordinates and colours."""
    kept = scene.known
    vertices = np.empty(int(kept.sum()), [("place", "<f4", 3), ("colour", "u1", 3)])
    vertices["place"] = scene.points[kept]
    vertices["colour"] = scene.grey[kept, None]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    with Files.appearing(path) as partial:
        partial.write_bytes("\n".join([*header, "end_header\n"]).encode() + vertices.tobytes())
