# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""YAML values that know their file and line, so that faults of calibration files can be located."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
import yaml

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.settings import ConfigTree

ROTATION_TOLERANCE = 1e-3
"""Largest element of R Rᵀ - I for which R counts as a rotation; files may have four digits only."""

FARTHEST_M = 1e9
"""Largest coordinate of a pose in a file, m; the Earth has 6.4e6."""

MAX_OFFSET_S = 1e8
"""Largest offset between clocks, s: three years, as of a clock that was never set."""


@dataclass(frozen=True, slots=True)
class YamlValue:
    """One value of a YAML file.

    Attributes:
        path: of the file.
        node: of the parsed file.
        key: of the value.
    """

    path: Path
    node: yaml.Node
    key: str = ""

    @property
    def where(self) -> str:
        """File, line and key, for messages."""
        return f"{self.path}:{self.node.start_mark.line + 1}" + (
            f": {self.key[:60]}" if self.key else ""
        )

    def items(self) -> Iterator[tuple[str, YamlValue]]:
        """Keys and values of a mapping, in the order of the file."""
        if not isinstance(self.node, yaml.MappingNode):
            raise DataError(f"{self.where}: expected a mapping of keys to values")
        for key, value in self.node.value:
            yield str(key.value), YamlValue(self.path, value, str(key.value))

    def get(self, key: str) -> YamlValue | None:
        """The value of a key, or None if there is no such key."""
        return next((value for name, value in self.items() if name == key), None)

    def require(self, *keys: str) -> YamlValue:
        """The value of the first of `keys` that is there; an error if none is."""
        for key in keys:
            value = self.get(key)
            if value is not None:
                return value
        raise DataError(f"{self.where}: missing key '{' or '.join(keys)}'")

    def text(self) -> str:
        """A scalar as text."""
        if not isinstance(self.node, yaml.ScalarNode):
            raise DataError(f"{self.where}: expected a single value")
        return str(self.node.value)

    def number(self) -> float:
        """A finite number, also in a notation that YAML 1.1 takes for text, like ``2e-3``."""
        try:
            value = float(self.text())
        except ValueError:
            raise DataError(f"{self.where}: '{self.text()[:60]}' is not a number") from None
        if not np.isfinite(value):
            raise DataError(f"{self.where}: '{self.text()[:60]}' is not a finite number")
        return value

    def positive(self) -> float:
        """A number above 0 whose square is one too, such as a standard deviation."""
        value = self.number()
        if not (value > 0.0 and 0.0 < value * value < np.inf):
            raise DataError(f"{self.where}: '{self.text()[:60]}' is not a usable number above 0")
        return value

    def seconds(self) -> float:
        """A time offset, in s; one beyond `MAX_OFFSET_S` is refused."""
        value = self.number()
        if abs(value) > MAX_OFFSET_S:
            raise DataError(f"{self.where}: {value:g} s cannot be the offset of two clocks")
        return value

    def elements(self) -> list[YamlValue]:
        """The elements of a list."""
        if not isinstance(self.node, yaml.SequenceNode):
            raise DataError(f"{self.where}: expected a list")
        return [YamlValue(self.path, node, self.key) for node in self.node.value]

    def numbers(self, count: int | None = None) -> list[float]:
        """A list of numbers; of length `count`, unless that is None."""
        values = [element.number() for element in self.elements()]
        if count is not None and len(values) != count:
            raise DataError(f"{self.where}: expected {count} numbers, got {len(values)}")
        return values

    def pose(self) -> gtsam.Pose3:
        """A homogeneous matrix: rows of rows, 16 numbers, or OpenCV's mapping with ``data``."""
        if isinstance(self.node, yaml.MappingNode):
            values = self.require("data").numbers(16)
        else:
            elements = self.elements()
            nested = elements and isinstance(elements[0].node, yaml.SequenceNode)
            values = [v for e in elements for v in e.numbers(4)] if nested else self.numbers()
        if len(values) != 16:
            raise DataError(f"{self.where}: expected a 4x4 matrix, got {len(values)} numbers")
        return pose_from_matrix(np.reshape(values, (4, 4)), self.where)


def read_yaml(path: str | Path) -> YamlValue:
    """Read a YAML file, also one that starts with OpenCV's ``%YAML:1.0``.

    Raises:
        DataError: if the file is missing, not YAML, or not a mapping.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        raise DataError(f"{path}: calibration cannot be read ({reason})") from None
    return parse_yaml(text, path)


def parse_yaml(text: str, path: str | Path) -> YamlValue:
    """Read the text of a YAML file.

    Args:
        text: its content.
        path: of the file, for messages.

    Raises:
        DataError: if it is not YAML, or not a mapping.
    """
    if text.startswith("%YAML"):
        text = "#" + text
    node = ConfigTree.nodes(text, path, DataError)
    if not isinstance(node, yaml.MappingNode):
        raise DataError(f"{path}: expected a mapping of keys to values, the file has none")
    return YamlValue(Path(path), node)


def pose_from_matrix(matrix: FloatArray, where: str) -> gtsam.Pose3:
    """A pose from a 4x4 homogeneous matrix.

    Args:
        matrix: (4, 4).
        where: what the matrix is and where it stands (file, line), for the error message.

    Raises:
        DataError: if the matrix is not 4x4, not finite, its rotation part is not a rotation, or
            its translation is beyond `FARTHEST_M`.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
        raise DataError(f"{where}: expected a finite 4x4 matrix, got shape {matrix.shape}")
    R = matrix[:3, :3]
    defects, dets = rotation_defects(R[None])
    if not defects[0] <= ROTATION_TOLERANCE or dets[0] < 0:
        raise DataError(
            f"{where}: the upper left 3x3 block is not a rotation "
            f"(|R Rᵀ - I| = {defects[0]:.2g}, det = {dets[0]:.3g})"
        )
    if not np.abs(matrix[:3, 3]).max() <= FARTHEST_M:
        raise DataError(f"{where}: a translation of more than {FARTHEST_M:g} m")
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(R), matrix[:3, 3])


def rotation_defects(R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest element (N,) of |R Rᵀ - I|, and determinant (N,), of matrices (N, 3, 3) of a file."""
    with np.errstate(all="ignore"):  # the numbers may be damaged
        defects = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        return np.asarray(defects), np.asarray(np.linalg.det(R))
