# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: one protocol (`sequence`), a reader per format, and `open_dataset`.

Calibration files are read and written in `calibration/`.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "DATASETS",
    "EurocWriter",
    "Format",
    "ReaderOptions",
    "RecordedSequence",
    "Rows",
    "Sequence",
    "SequenceInfo",
    "TrackRecorder",
    "check_sequence",
    "dataset_from_arrays",
    "kalibr_text",
    "open_dataset",
    "read_groundtruth",
    "read_kalibr",
    "rig_from_kalibr",
]

if TYPE_CHECKING:
    from slam_graph.datasets.calibration.kalibr_calibration import (
        kalibr_text,
        read_kalibr,
        rig_from_kalibr,
    )
    from slam_graph.datasets.data_checks import check_sequence
    from slam_graph.datasets.dataset_registry import DATASETS, Format, open_dataset
    from slam_graph.datasets.formats.euroc_writer import EurocWriter
    from slam_graph.datasets.formats.track_recorder import TrackRecorder
    from slam_graph.datasets.groundtruth import read_groundtruth
    from slam_graph.datasets.memory_sequence import dataset_from_arrays
    from slam_graph.datasets.sequence import ReaderOptions, RecordedSequence, Sequence, SequenceInfo
    from slam_graph.datasets.streams.csv_rows import Rows
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "calibration.kalibr_calibration": ("kalibr_text", "read_kalibr", "rig_from_kalibr"),
            "data_checks": ("check_sequence",),
            "dataset_registry": ("DATASETS", "Format", "open_dataset"),
            "formats.euroc_writer": ("EurocWriter",),
            "formats.track_recorder": ("TrackRecorder",),
            "groundtruth": ("read_groundtruth",),
            "memory_sequence": ("dataset_from_arrays",),
            "sequence": ("ReaderOptions", "RecordedSequence", "Sequence", "SequenceInfo"),
            "streams.csv_rows": ("Rows",),
        },
    )
