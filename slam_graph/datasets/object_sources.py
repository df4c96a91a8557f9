# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a recording knows of moving objects: their masks, and their true poses."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from slam_graph.datasets.streams.mask_images import MASKS, LabelImage, MaskFolder, sampled
from slam_graph.datasets.streams.object_truth import (
    OBJECT_TRUTH,
    object_truth_file,
    read_object_truth,
)

if TYPE_CHECKING:
    from slam_graph.arrays import IntArray
    from slam_graph.geometry import Trajectory
    from slam_graph.sensors import FeatureObservations, Rig


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
