# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The known formats of recordings, and `open_dataset`, which finds the format of a path."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from slam_graph.datasets.formats.eqvio import (
    DEMO,
    EqvioTracks,
    is_eqvio_file,
    wheel_tracks,
)
from slam_graph.datasets.formats.euroc import EurocSequence, TumViSequence, is_tum_vi
from slam_graph.datasets.formats.image_folder import ImageFolderSequence, is_image_folder
from slam_graph.datasets.formats.kitti_odometry import KittiOdometrySequence, is_kitti_odometry
from slam_graph.datasets.formats.kitti_raw import KittiRawSequence, is_kitti_raw
from slam_graph.datasets.formats.openvins_sim import OpenvinsSimulation
from slam_graph.datasets.formats.track_recording import TrackRecordingSequence, is_recording
from slam_graph.datasets.formats.tum_rgbd import TumRgbdSequence, is_tum_rgbd
from slam_graph.datasets.formats.video import VideoSequence, is_video
from slam_graph.datasets.rosbag.bag import is_bag
from slam_graph.datasets.rosbag.ros_sequence import RosBagSequence
from slam_graph.datasets.sequence import ReaderOptions, RecordedSequence
from slam_graph.datasets.streams.mask_images import MASKS
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.plugins import Registry


@dataclass(frozen=True, slots=True)
class Format:
    """A format of recordings.

    Attributes:
        open: opens the recording at a path: a subclass of `RecordedSequence`, or a function.
        recognises: whether a path looks like this format.
        looks_like: what `recognises` looks for, for messages.
        takes_sources: whether `ReaderOptions.sources` has a meaning.
        fallback: whether a path of which another format is recognised too is of the other one.
    """

    open: Callable[[Path, ReaderOptions], RecordedSequence]
    recognises: Callable[[Path], bool]
    looks_like: str
    takes_sources: bool = False
    fallback: bool = False


_AIDING = ("gnss", "poses", "odometry", MASKS)
"""Sensors that any recording may have, or a file beside it."""


def _is_euroc(path: Path) -> bool:
    return (path / "mav0").is_dir() or (path / "imu0").is_dir()


def _is_openvins_sim(path: Path) -> bool:
    return (path / "tracks.csv").is_file() and (path / "calib.yaml").is_file()


DATASETS: Registry[Format] = Registry(
    "slam_graph.datasets", "data set format", accepts=lambda part: isinstance(part, Format)
)
"""Formats by name. A path is of the first one that recognises it; those of plugins come last, but
before `fallback`."""

for _name, _format in {
    "tum_vi": Format(TumViSequence, is_tum_vi, "a folder with mav0 and dso/camchain.yaml"),
    "euroc": Format(EurocSequence, _is_euroc, "a folder with mav0/imu0 and mav0/cam0"),
    "kitti_raw": Format(KittiRawSequence, is_kitti_raw, "a folder with image_00 and oxts"),
    "kitti_odometry": Format(
        KittiOdometrySequence, is_kitti_odometry, "a folder with times.txt, calib.txt and image_0"
    ),
    "tum_rgbd": Format(TumRgbdSequence, is_tum_rgbd, "a folder with rgb.txt and rgb"),
    "rosbag": Format(
        RosBagSequence,
        is_bag,
        "a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag",
        takes_sources=True,
    ),
    "recording": Format(
        TrackRecordingSequence, is_recording, "a folder with meta.yaml, written by TrackRecorder"
    ),
    "openvins_sim": Format(
        OpenvinsSimulation, _is_openvins_sim, "a folder with calib.yaml, tracks.csv and imu.csv"
    ),
    "eqvio": Format(
        EqvioTracks, is_eqvio_file, f"a CSV file that begins with 'row_type,' (or '{DEMO}')"
    ),
    "video": Format(
        VideoSequence, is_video, "a video (.mp4, .avi, .mov, .mkv, …)", takes_sources=True
    ),
    "images": Format(
        ImageFolderSequence,
        is_image_folder,
        "a folder of images",
        takes_sources=True,
        fallback=True,
    ),
}.items():
    DATASETS.register(_name)(_format)


def open_dataset(
    path: str | Path,
    format: str | None = None,
    cameras: int | None = None,
    calibration: str | Path | None = None,
    groundtruth: str | Path | None = None,
    diagnostics: Diagnostics | None = None,
    sources: Mapping[str, str] | None = None,
    faults: Sequence[str] = (),
    imu: bool = True,
) -> RecordedSequence:
    """Open a recording.

    Args:
        path: file or folder; the word ``demo`` stands for the tracks in GTSAM's wheel.
        format: name in `DATASETS`; None to find it by the path.
        cameras: number of cameras to use, the first ones; None for all.
        calibration: Kalibr camera chain to use instead of the recording's calibration.
        groundtruth: EuRoC CSV, TUM file or EuRoC folder to use instead of the recording's own.
        diagnostics: where faults are counted.
        sources: where each sensor is, in formats that leave it open: topics of a ROS bag or files
            beside a video, e.g. ``{"imu": "/imu0", "cam0": "/cam0/image_raw"}``; in every format
            the files or topics of ``gnss`` and ``odometry``, the file of ``poses``, and the folder
            of ``masks``.
        faults: to put into it on purpose, such as ``imu_missing:at_s=6,duration_s=1``.
        imu: False to read it as if it had no IMU.

    Raises:
        DataError: if the path is not there, of no known format, or cannot be read.
        ConfigError: if a format or a fault is not known, or the plugin of a format does not load.
    """
    path = Path(path)
    if str(path) == DEMO and not path.exists():
        path = wheel_tracks()
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    name = _guess(path) if format is None else format
    chosen = DATASETS[name]
    aiding = {key: text for key, text in (sources or {}).items() if key in _AIDING}
    sources = {key: text for key, text in (sources or {}).items() if key not in _AIDING}
    if sources and not chosen.takes_sources:
        given = ", ".join(f"{sensor}={place}" for sensor, place in sources.items())
        raise DataError(f"{path}: format '{name}' knows its sensors; remove '{given}'")
    options = ReaderOptions(
        cameras,
        None if calibration is None else Path(calibration),
        None if groundtruth is None else Path(groundtruth),
        sources,
        diagnostics if diagnostics is not None else Diagnostics(),
        imu,
        aiding,
    )
    recording = chosen.open(path, options)
    if not faults:
        return recording
    from slam_graph.datasets.faults.injection import inject  # few want any

    return inject(recording, faults)


def _guess(path: Path) -> str:
    """The first format that recognises a path; plugins are loaded only if they are reached."""
    fallback = None
    for name, known in DATASETS.working():
        if known.recognises(path):
            if not known.fallback:
                return name
            fallback = fallback or name
    if fallback is not None:
        return fallback
    looked = "; ".join(f"{name}: {known.looks_like}" for name, known in DATASETS.working())
    failed = "".join(f"; {fault}" for fault in DATASETS.faults())
    raise DataError(f"{path}: not a recording of a known format; looked for {looked}{failed}")
