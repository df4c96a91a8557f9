# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: one protocol (`sequence`), a reader per format, and `open_dataset`."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "DATASETS",
    "EurocSequence",
    "EurocWriter",
    "Extent",
    "Format",
    "FrameStream",
    "ReaderOptions",
    "RecordedSequence",
    "Rows",
    "Sequence",
    "SequenceInfo",
    "TrackRecorder",
    "TrackRecordingSequence",
    "check_sequence",
    "convert_to_euroc",
    "dataset_from_arrays",
    "open_dataset",
    "parse",
    "read_groundtruth",
    "refuse_existing",
    "within",
]

if TYPE_CHECKING:
    from slam_graph.datasets.data_checks import check_sequence
    from slam_graph.datasets.dataset_registry import DATASETS, Format, open_dataset
    from slam_graph.datasets.formats.euroc import EurocSequence
    from slam_graph.datasets.formats.euroc_writer import (
        EurocWriter,
        convert_to_euroc,
        refuse_existing,
    )
    from slam_graph.datasets.formats.track_recorder import TrackRecorder
    from slam_graph.datasets.formats.track_recording import TrackRecordingSequence
    from slam_graph.datasets.groundtruth import read_groundtruth
    from slam_graph.datasets.memory_sequence import dataset_from_arrays
    from slam_graph.datasets.sequence import (
        Extent,
        FrameStream,
        ReaderOptions,
        RecordedSequence,
        Sequence,
        SequenceInfo,
        within,
    )
    from slam_graph.datasets.streams.csv_rows import Rows, parse
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "data_checks": ("check_sequence",),
            "dataset_registry": ("DATASETS", "Format", "open_dataset"),
            "formats.euroc": ("EurocSequence",),
            "formats.euroc_writer": ("EurocWriter", "convert_to_euroc", "refuse_existing"),
            "formats.track_recorder": ("TrackRecorder",),
            "formats.track_recording": ("TrackRecordingSequence",),
            "groundtruth": ("read_groundtruth",),
            "memory_sequence": ("dataset_from_arrays",),
            "sequence": (
                "Extent",
                "FrameStream",
                "ReaderOptions",
                "RecordedSequence",
                "Sequence",
                "SequenceInfo",
                "within",
            ),
            "streams.csv_rows": ("Rows", "parse"),
        },
    )
