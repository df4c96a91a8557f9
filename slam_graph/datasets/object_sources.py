# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a recording knows of moving objects: their masks, and their true poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slam_graph.datasets.streams.mask_images import (
    MASKS,
    LabelImage,
    MaskFolder,
    classes_text,
    sampled,
)
from slam_graph.datasets.streams.object_truth import (
    OBJECT_TRUTH,
    object_truth_file,
    read_object_truth,
)

if TYPE_CHECKING:
    from slam_graph.arrays import IntArray
    from slam_graph.geometry import Trajectory
    from slam_graph.sensors import FeatureFrame, FeatureObservations, Rig


class ObjectSources:
    """Masks and true poses of objects, found beside a recording or named.

    Attributes:
        rig: the sensors.
        named_aiding: where ``masks`` are, if it was said.
    """

    rig: Rig
    named_aiding: dict[str, str]

    def object_truth(self) -> dict[int, Trajectory]:
        """True poses of moving objects by their numbers, at the stamps of frames; none if unknown.

        Raises:
            DataError: if `objects_truth.csv` cannot be read.
        """
        for folder in self._folders():
            if (folder / OBJECT_TRUTH).is_file():
                return read_object_truth(folder / OBJECT_TRUTH)
        return {}

    def object_truth_file(self) -> dict[str, str]:
        """Name and text of a file with these poses; empty without any."""
        return object_truth_file(self.object_truth())

    @property
    def masks(self) -> int:
        """Number of masks: those in the folder that was named, or in `masks` beside the recording.

        Raises:
            DataError: if they cannot be read.
        """
        return 0 if self._mask_folder is None else len(self._mask_folder)

    @property
    def mask_classes(self) -> dict[int, str]:
        """Name of the class by label."""
        return {} if self._mask_folder is None else self._mask_folder.classes

    def classes_file(self) -> dict[str, str]:
        """Name and text of a file with these classes; empty without any."""
        return classes_text(self.mask_classes)

    def labels_over_time(self) -> LabelsOverTime | None:
        """What gives tracks the labels of the masks, frame by frame; None without masks.

        Raises:
            DataError: if the masks cannot be read.
        """
        return LabelsOverTime(self) if self.masks else None

    def label_image(self, stamp_ns: int) -> LabelImage | None:
        """The label image (height, width) of the first camera in a frame; None without one.

        Raises:
            DataError: if it cannot be read, or is of another size.
        """
        camera = self.rig.cameras[0].camera
        folder = self._mask_folder
        return None if folder is None else folder.image(stamp_ns, (camera.width, camera.height))

    def labels(self, stamp_ns: int, seen: FeatureObservations) -> IntArray | None:
        """Labels (N,) of the masks that features are in; None for a frame without a mask.

        Args:
            stamp_ns: of the frame.
            seen: N features in the first camera.

        Raises:
            DataError: as `label_image`.
        """
        image = self.label_image(stamp_ns)
        return None if image is None else sampled(image, seen.pixels)

    @cached_property
    def _mask_folder(self) -> MaskFolder | None:
        return self._found_masks()

    def _found_masks(self) -> MaskFolder | None:
        if MASKS in self.named_aiding:
            return MaskFolder(Path(self.named_aiding[MASKS]))
        folders = (folder / MASKS for folder in self._folders() if (folder / MASKS).is_dir())
        found = next(folders, None)
        return None if found is None else MaskFolder(found)

    def _folders(self) -> Iterator[Path]:
        """Where files of a recording may be: in it or beside it."""
        path: Path | None = getattr(self, "path", None)
        if path is not None:
            yield from (path, path.parent)


class LabelsOverTime:
    """Labels of tracks: of the masks of a frame, or of the last ones where a frame has none.

    Args:
        recording: that has masks.

    Attributes:
        masks: number of all masks.
        frames: number of frames with a mask so far.
    """

    def __init__(self, recording: ObjectSources) -> None:
        self._recording = recording
        self.masks, self.frames = recording.masks, 0
        self._known: dict[int, int] = {}

    def labelled(self, frame: FeatureFrame) -> FeatureFrame:
        """The frame with the labels of its features in the first camera, also of those that move.

        Raises:
            DataError: if a mask cannot be read.
        """
        seen, static = frame.whole.cameras[0], len(frame.cameras[0])
        found = self._recording.labels(frame.stamp_ns, seen)
        self.frames += found is not None
        labels = self._before(seen.ids) if found is None else found
        self._known = dict(zip(seen.ids.tolist(), labels.tolist(), strict=True))
        return replace(
            frame,
            cameras=_with_labels(frame.cameras, labels[:static]),
            moving=_with_labels(frame.moving, labels[static:]),
        )

    def _before(self, ids: IntArray) -> IntArray:
        """Labels (N,) that tracks (N,) had in the frame before; 0 for new ones."""
        return np.array([self._known.get(number, 0) for number in ids.tolist()], np.int64)


def _with_labels(
    cameras: tuple[FeatureObservations, ...], labels: IntArray
) -> tuple[FeatureObservations, ...]:
    """The observations of all cameras, those of the first one with labels."""
    return (replace(cameras[0], labels=labels), *cameras[1:]) if cameras else ()
