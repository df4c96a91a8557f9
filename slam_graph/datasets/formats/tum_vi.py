# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""TUM-VI as it is downloaded in EuRoC's layout: ``mav0``, and its calibration in ``dso``.

Schubert et al., "The TUM VI Benchmark for Evaluating Visual-Inertial Odometry", IROS 2018. Two
fisheye cameras of 512 or 1024 pixels at 20 Hz, an IMU at 200 Hz, and poses of the IMU from motion
capture in ``mav0/mocap0`` (of the long sequences at their start and end only). The ``sensor.yaml``
files of EuRoC are not there: the cameras are in ``dso/camchain.yaml``, the noise of the IMU in
``dso/imu_config.yaml``, both as Kalibr writes them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from slam_graph.datasets.formats.euroc import EurocSequence
from slam_graph.datasets.sequence import ReaderOptions

CHAIN = Path("dso") / "camchain.yaml"


def _find_root(path: Path) -> Path | None:
    """The folder with ``mav0`` and ``dso`` that a path stands for, or None."""
    for folder in (path, path.resolve().parent):
        if (folder / CHAIN).is_file() and (folder / "mav0").is_dir():
            return folder
    return None


def is_tum_vi(path: Path) -> bool:
    """Whether this is the folder of a TUM-VI sequence, or its ``mav0``."""
    return path.is_dir() and _find_root(path) is not None


class TumViSequence(EurocSequence):
    """A sequence of TUM-VI, 512 or 1024 pixels wide.

    Its images have 16 bits, of which the upper 8 are kept.

    Args:
        path: the folder with ``mav0`` and ``dso``, or ``mav0``.
        options: what else is asked for.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "tum_vi"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        root = _find_root(path) or path
        super().__init__(root, replace(options, calibration=options.calibration or root / CHAIN))
