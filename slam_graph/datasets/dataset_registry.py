# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The known formats, and which one a path is of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from slam_graph.datasets.formats.eqvio import EqvioTracks, is_eqvio_file, wheel_tracks
from slam_graph.datasets.formats.euroc import EurocSequence
from slam_graph.datasets.formats.image_folder import ImageFolderSequence, is_image_folder
from slam_graph.datasets.formats.kitti_odometry import KittiOdometrySequence, is_kitti_odometry
from slam_graph.datasets.formats.kitti_raw import KittiRawSequence, is_kitti_raw
from slam_graph.datasets.formats.openvins_sim import OpenvinsSimulation
from slam_graph.datasets.formats.track_recording import TrackRecordingSequence, is_recording
from slam_graph.datasets.formats.tum_rgbd import TumRgbdSequence, is_tum_rgbd
from slam_graph.datasets.formats.tum_vi import TumViSequence, is_tum_vi
from slam_graph.datasets.formats.video import VideoSequence, is_video
from slam_graph.datasets.rosbag.bag import is_bag
from slam_graph.datasets.rosbag.ros_sequence import RosBagSequence
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError

DEMO = "demo"
"""The name that stands for the recording that comes with GTSAM."""


class Opener(Protocol):
    """How every format is opened: the arguments that their classes share."""

    def __call__(
        self,
        path: Path,
        cameras: int | None = None,
        calibration: Path | None = None,
        groundtruth: Path | None = None,
        diagnostics: Diagnostics | None = None,
    ) -> RecordedSequence:
        """Open the recording at `path`."""
        ...


@dataclass(frozen=True, slots=True)
class Format:
    """A format of recordings.

    Attributes:
        open: makes a sequence of a path.
        recognises: whether a path looks like this format.
        looks_like: what `recognises` looks for, for messages.
        with_sources: makes an opener that is told where each sensor is; None for formats in which
            that is known.
    """

    open: Opener
    recognises: Callable[[Path], bool]
    looks_like: str
    with_sources: Callable[[Mapping[str, str]], Opener] | None = None


def _is_euroc(path: Path) -> bool:
    return (path / "mav0").is_dir() or (path / "imu0").is_dir()


def _is_openvins_sim(path: Path) -> bool:
    return (path / "tracks.csv").is_file() and (path / "calib.yaml").is_file()


DATASETS: dict[str, Format] = {
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
        lambda sources: partial(RosBagSequence, sources=sources),
    ),
    "recording": Format(
        TrackRecordingSequence, is_recording, "a folder with meta.yaml, as our recorder writes it"
    ),
    "openvins_sim": Format(
        OpenvinsSimulation, _is_openvins_sim, "a folder with calib.yaml, tracks.csv and imu.csv"
    ),
    "eqvio": Format(
        EqvioTracks, is_eqvio_file, f"a CSV file that begins with 'row_type,' (or '{DEMO}')"
    ),
    "video": Format(
        VideoSequence,
        is_video,
        "a video (.mp4, .avi, .mov, .mkv, …)",
        lambda sources: partial(VideoSequence, sources=sources),
    ),
    "images": Format(
        ImageFolderSequence,
        is_image_folder,
        "a folder of images",
        lambda sources: partial(ImageFolderSequence, sources=sources),
    ),
}
"""Every format by its name; a path is of the first one that recognises it."""


def open_dataset(
    path: str | Path,
    format: str | None = None,
    cameras: int | None = None,
    calibration: Path | None = None,
    groundtruth: Path | None = None,
    diagnostics: Diagnostics | None = None,
    sources: Mapping[str, str] | None = None,
) -> RecordedSequence:
    """Open a recording.

    Args:
        path: file or folder; the word ``demo`` stands for the tracks in GTSAM's wheel.
        format: name in `DATASETS`; None to guess it from the path.
        cameras: use only the first so many; None for all.
        calibration: Kalibr camera chain to use instead of the recording's calibration.
        groundtruth: EuRoC CSV, TUM file or EuRoC folder to use instead of the recording's own.
        diagnostics: where faults are counted.
        sources: where each sensor is, in formats that leave it open: topics of a ROS bag or files
            beside a video, e.g. ``{"imu": "/imu0", "cam0": "/cam0/image_raw"}``.

    Raises:
        DataError: if the path is not there, of no known format, or cannot be read.
    """
    path = Path(path)
    if str(path) == DEMO and not path.exists():
        path = wheel_tracks()
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    return _opener(path, format, sources or {})(
        path,
        cameras=cameras,
        calibration=calibration,
        groundtruth=groundtruth,
        diagnostics=diagnostics,
    )


def _opener(path: Path, name: str | None, sources: Mapping[str, str]) -> Opener:
    """How to open a path, given where its sensors are."""
    name = _guess(path) if name is None else name
    if name not in DATASETS:
        raise DataError(f"unknown data set format '{name}'; known: {', '.join(DATASETS)}")
    chosen = DATASETS[name]
    if not sources:
        return chosen.open
    if chosen.with_sources is None:
        given = ", ".join(f"{sensor}={place}" for sensor, place in sources.items())
        raise DataError(f"{path}: format '{name}' knows its sensors; '{given}' has no meaning here")
    return chosen.with_sources(sources)


def _guess(path: Path) -> str:
    """The first format that recognises a path."""
    for name, known in DATASETS.items():
        if known.recognises(path):
            return name
    looked = "; ".join(f"{key}: {known.looks_like}" for key, known in DATASETS.items())
    raise DataError(f"{path}: not a recording of a known format; looked for {looked}")
