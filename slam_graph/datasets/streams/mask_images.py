# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Masks of objects in the images of the first camera, as a segmentation network makes them.

A folder of label images (PNG, 8 or 16 bits, 0 where nothing is), each named by the stamp of its
frame in ns; or of boxes, `boxes.csv`: stamp (ns), label, left, top, right, bottom in pixels. With
`classes.csv` (label, name) labels have names. Frames without a mask have none.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets.streams.csv_rows import read_rows
from slam_graph.datasets.streams.images import decoded
from slam_graph.errors import DataError

MASKS = "masks"
"""Name of the folder beside a recording."""

BOXES, CLASSES = "boxes.csv", "classes.csv"

_BOX = [("stamp", "<i8"), ("label", "<i8"), ("box", "<f8", (4,))]
_BORDER_PX = 2
"""So near to the border of a mask a feature may be on either side: it has no label."""

LabelImage = NDArray[np.uint16]


class Masks:
    """Masks by the stamps of frames; this base class has none.

    Attributes:
        classes: name of the class by label.
    """

    def __init__(self) -> None:
        self.classes: dict[int, str] = {}

    def labels(self, stamp_ns: int, pixels: FloatArray, size: tuple[int, int]) -> IntArray | None:
        """Labels (N,) of the masks at pixels (N, 2); None for a frame without a mask.

        Args:
            stamp_ns: of the frame.
            pixels: of the first camera.
            size: width and height of its images.

        Raises:
            DataError: if the label image cannot be read, or is of another size.
        """
        image = self.image(stamp_ns, size)
        return None if image is None else sampled(image, pixels)

    def image(self, stamp_ns: int, size: tuple[int, int]) -> LabelImage | None:
        """The label image (height, width) of a frame; None without one."""
        return None


class MaskFolder(Masks):
    """Masks in a folder; see the module.

    Args:
        folder: of label images or boxes.

    Raises:
        DataError: if there is no such folder, or nothing of this in it, or a file is damaged.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder of masks")
        self._folder = folder
        self._images = {int(p.stem): p for p in folder.glob("*.png") if p.stem.isdigit()}
        self._boxes = _read_boxes(folder / BOXES) if (folder / BOXES).is_file() else None
        if (folder / CLASSES).is_file():
            self.classes = _read_classes(folder / CLASSES)
        if not self._images and self._boxes is None:
            raise DataError(
                f"{folder}: holds neither {BOXES} nor label images named by stamps in ns "
                "(1403636579763555584.png)"
            )

    def image(self, stamp_ns: int, size: tuple[int, int]) -> LabelImage | None:
        """The label image (height, width) of a frame; None without one."""
        if stamp_ns in self._images:
            return self._read(self._images[stamp_ns], size)
        if self._boxes is None:
            return None
        rows = self._boxes[self._boxes["stamp"] == stamp_ns]
        if len(rows) == 0:
            return None
        image = np.zeros((size[1], size[0]), np.uint16)
        for row in rows:
            left, top, right, bottom = (round(float(value)) for value in row["box"])
            image[max(top, 0) : bottom + 1, max(left, 0) : right + 1] = row["label"]
        return image

    def _read(self, path: Path, size: tuple[int, int]) -> LabelImage:
        try:
            image = decoded(path.read_bytes(), cv2.IMREAD_UNCHANGED)
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror})") from error
        if isinstance(image, str):
            raise DataError(f"{path}: {image}")
        if image.shape != (size[1], size[0]) or image.dtype not in (np.uint8, np.uint16):
            raise DataError(
                f"{path}: a label image has one channel of 8 or 16 bits and the size of the image, "
                f"{size[0]} x {size[1]}; this one has shape {image.shape} and type {image.dtype}"
            )
        return image.astype(np.uint16)


def sampled(image: LabelImage, pixels: FloatArray) -> IntArray:
    """Labels (N,) at pixels (N, 2); 0 where a pixel nearby has another label."""
    height, width = image.shape
    column = np.clip(np.round(pixels[:, 0]).astype(np.int64), 0, width - 1)
    row = np.clip(np.round(pixels[:, 1]).astype(np.int64), 0, height - 1)
    label = image[row, column].astype(np.int64)
    for shift in (-_BORDER_PX, _BORDER_PX):
        beside = image[row, np.clip(column + shift, 0, width - 1)]
        above = image[np.clip(row + shift, 0, height - 1), column]
        label[(beside != image[row, column]) | (above != image[row, column])] = 0
    return label


def _read_boxes(path: Path) -> NDArray[np.void]:
    blocks = [rows.parse(_BOX, "stamp, label and box") for rows in read_rows(path)]
    table = np.concatenate(blocks) if blocks else np.zeros(0, np.dtype(_BOX))
    if not np.isfinite(table["box"]).all() or np.any(
        (table["label"] < 1) | (table["label"] > 65535)
    ):
        raise DataError(f"{path}: a box is not finite, or its label is not from 1 to 65535")
    return table


def _read_classes(path: Path) -> dict[int, str]:
    classes = {}
    for number, line in enumerate(
        path.read_text(encoding="utf-8", errors="replace").splitlines(), 1
    ):
        label, _, name = line.partition(",")
        if not line.strip() or line.startswith("#"):
            continue
        if not label.strip().isdigit() or not name.strip():
            raise DataError(f"{path}:{number}: expected a label and a name, got '{line[:40]}'")
        classes[int(label)] = " ".join(name.split())
    return classes
