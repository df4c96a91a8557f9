# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Masks of objects in the images of the first camera, as a segmentation network makes them.

A folder of label images (PNG, 8 or 16 bits, 0 where nothing is), each named by the time of its
frame, in ns or in seconds with a decimal point; or of boxes, `boxes.csv`: stamp (ns), label, left,
top, right, bottom in pixels. With `classes.csv` (label, name) labels have names. A mask is of the
frame that is not more than a millisecond away. Frames without a mask have none.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets.streams.csv_rows import check_times, read_rows
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.image_files import ImageFile

MASKS = "masks"
"""Name of the folder beside a recording."""

BOXES, CLASSES = "boxes.csv", "classes.csv"

_BOX = [("stamp", "<i8"), ("label", "<i8"), ("box", "<f8", (4,))]
LARGEST_LABEL = 65535
_NEAREST_NS = 1_000_000
"""A mask and its frame have the same time up to this, as stamps in seconds are rounded."""
_BORDER = np.ones((5, 5), np.uint8)
"""A feature so near to the border of a mask (2 px) may be on either side: it has no label."""
_TIME_NAME = re.compile(r"[0-9]{1,19}|[0-9]{1,10}\.[0-9]{1,9}")

LabelImage = NDArray[np.uint16]


class MaskFolder:
    """Masks in a folder; see the module.

    Args:
        folder: of label images or boxes.

    Attributes:
        classes: name of the class by label.

    Raises:
        DataError: if there is no such folder, or nothing of this in it, or a file is damaged.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder of masks")
        images = {_time_ns(path): path for path in folder.glob("*.png")}
        self._images = {stamp_ns: path for stamp_ns, path in images.items() if stamp_ns is not None}
        boxes = _read_boxes(folder / BOXES) if (folder / BOXES).exists() else None
        self._boxes = np.zeros(0, np.dtype(_BOX)) if boxes is None else boxes
        self.classes = read_classes(folder)
        if not self._images and boxes is None:
            raise DataError(
                f"{folder}: holds neither {BOXES} nor label images named by the times of frames in "
                "ns (1403636579763555584.png)"
            )
        named_ns = np.array([*self._images], np.int64)  # an empty list would be of floats
        self._stamps_ns = np.unique(np.concatenate([named_ns, self._boxes["stamp"]]))

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def image(self, stamp_ns: int, size: tuple[int, int]) -> LabelImage | None:
        """The label image (height, width) of a frame; None without one.

        Args:
            stamp_ns: of the frame.
            size: width and height of its images.

        Raises:
            DataError: if the label image cannot be read, or is of another size.
        """
        apart_ns = np.abs(self._stamps_ns - stamp_ns)
        nearest = int(np.argmin(apart_ns)) if len(apart_ns) else 0
        if len(apart_ns) == 0 or apart_ns[nearest] > _NEAREST_NS:
            return None
        named_ns = int(self._stamps_ns[nearest])
        if named_ns in self._images:
            return _read_image(self._images[named_ns], size)
        return _drawn(self._boxes[self._boxes["stamp"] == named_ns], size)


def sampled(image: LabelImage, pixels: FloatArray) -> IntArray:
    """Labels (N,) at pixels (N, 2); 0 where another label is within 2 px."""
    height, width = image.shape
    inside = cv2.erode(image, _BORDER) == cv2.dilate(image, _BORDER)
    column = np.clip(np.round(pixels[:, 0]).astype(np.int64), 0, width - 1)
    row = np.clip(np.round(pixels[:, 1]).astype(np.int64), 0, height - 1)
    return np.where(inside[row, column], image[row, column], 0).astype(np.int64)


def _time_ns(path: Path) -> int | None:
    """The time that a file is named by; None if it is named otherwise."""
    if not _TIME_NAME.fullmatch(path.stem):
        return None
    stamp_ns = int(Decimal(path.stem) * 10**9) if "." in path.stem else int(path.stem)
    return stamp_ns if stamp_ns < Files.LARGEST_STAMP_NS else None


def _drawn(boxes: NDArray[np.void], size: tuple[int, int]) -> LabelImage:
    """The label image of boxes; later ones are in front."""
    width, height = size
    image = np.zeros((height, width), np.uint16)
    for row in boxes:
        left, top, right, bottom = np.clip(row["box"], -1, [width, height, width, height])
        columns = slice(max(math.ceil(left), 0), math.floor(right) + 1)
        image[max(math.ceil(top), 0) : math.floor(bottom) + 1, columns] = row["label"]
    return image


def _read_image(path: Path, size: tuple[int, int]) -> LabelImage:
    try:
        image = ImageFile.decode(path.read_bytes(), cv2.IMREAD_UNCHANGED)
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


def _read_boxes(path: Path) -> NDArray[np.void]:
    blocks = []
    for rows in read_rows(path):
        blocks.append(rows.parse(_BOX, "stamp, label and box"))
        check_times(rows, blocks[-1]["stamp"])
    table = np.concatenate(blocks) if blocks else np.zeros(0, np.dtype(_BOX))
    box, label = table["box"], table["label"]
    if not np.isfinite(box).all() or np.any((label < 1) | (label > LARGEST_LABEL)):
        raise DataError(f"{path}: a box is not finite, or its label is not 1 to {LARGEST_LABEL}")
    if np.any(box[:, :2] > box[:, 2:]):
        raise DataError(
            f"{path}: the left or top of a box is beyond its right or bottom; columns are stamp, "
            "label, left, top, right, bottom"
        )
    return table


def read_classes(folder: Path) -> dict[int, str]:
    """Names of the classes by label, of the file in a folder; empty without one.

    Raises:
        DataError: if it cannot be read.
    """
    path = folder / CLASSES
    if not path.exists():
        return {}
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    classes = {}
    for number, line in enumerate(lines, 1):
        label, _, name = line.partition(",")
        if not line.strip() or line.startswith("#"):
            continue
        known = re.fullmatch(r"[0-9]{1,5}", label.strip()) and int(label) <= LARGEST_LABEL
        if not known or not name.strip():
            raise DataError(f"{path}:{number}: expected a label and a name, got '{line[:40]}'")
        classes[int(label)] = " ".join(name.split())
    return classes


def classes_text(classes: Mapping[int, str]) -> dict[str, str]:
    """Name and text of a file with the names of classes by label; empty without any."""
    lines = "".join(f"{label},{name}\n" for label, name in classes.items())
    return {CLASSES: lines} if lines else {}
