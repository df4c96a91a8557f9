# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`metrics.json` read back: whatever is used of it is there, and of its type.

The models say what is used; every version wrote it, unless it has a default. Other keys may have
any value.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slam_graph.errors import DataError
from slam_graph.files import Files

_Time = Annotated[int, Field(gt=-Files.LARGEST_STAMP_NS, lt=Files.LARGEST_STAMP_NS)]
"""A time in ns; differences of two of them fit into 64 bits."""

_Alignment = Literal["none", "yaw", "se3", "sim3"]
"""Alignments that errors of runs are given for."""

_Count = Annotated[int, Field(ge=0, le=Files.LARGEST)]
_Amount = Annotated[float, Field(ge=0.0, le=Files.LARGEST)]


class _Table(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)


class _Statistics(_Table):
    rmse: _Amount


class _Errors(_Table):
    translation_m: _Statistics
    rotation_deg: _Statistics


class _Aligned(_Table):
    ate: _Errors | None = None


class _Accuracy(_Table):
    none: _Aligned = _Aligned()
    yaw: _Aligned = _Aligned()
    se3: _Aligned = _Aligned()
    sim3: _Aligned = _Aligned()


class _Dataset(_Table):
    name: str
    format: str
    content: str
    start_ns: _Time = 0
    end_ns: _Time = 0
    imu_samples: _Count = 0


class _Extent(_Table):
    start_ns: _Time
    end_ns: _Time = 0
    frames: _Count
    estimated_frames: _Count
    coverage: _Amount
    recorded_s: _Amount
    initialization_s: float | None
    start_was_given: bool = False
    alignment: _Alignment = "yaw"
    unmeasured: _Alignment = "yaw"
    scale: str = ""
    world_breaks_ns: list[_Time] = []


class _Timing(_Table):
    frames_per_s: _Amount | None
    real_time_factor: float | None


class _Adjustment(_Table):
    seconds: _Amount
    accuracy: _Accuracy | None


class _Loops(_Table):
    accepted: _Count
    accuracy: _Accuracy | None
    world_breaks_ns: list[_Time] = []


class _Localization(_Table):
    accuracy: _Accuracy | None = None
    alignment: _Alignment = "yaw"


class _World(_Table):
    of_fixes: bool = False
    of_truth: bool = False


class _Metrics(_Table):
    dataset: _Dataset
    algorithm: str
    cameras: _Count
    seed: int
    status: str
    message: str
    extent: _Extent
    accuracy: _Accuracy | None
    final_ba: _Adjustment | None
    loop_closure: _Loops | None
    localization: _Localization | None
    timing: _Timing
    warnings: dict[str, _Count]
    peak_memory_mb: _Amount | None
    world: _World = _World()
    versions: dict[str, str] = {}


def read_metrics(path: Path) -> dict[str, Any]:
    """The content of `metrics.json`.

    Raises:
        DataError: if the file is missing, is not JSON, or does not hold the metrics of a run.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not JSON ({error})") from error
    fault = fault_of_metrics(table)
    if fault is not None:
        raise DataError(
            f"{path}: not the metrics of a run ({fault}); the file is damaged, run again"
        )
    assert isinstance(table, dict)
    return table


def fault_of_metrics(table: object) -> str | None:
    """What is wrong with the content of `metrics.json`, in one line; None if nothing is."""
    try:
        _Metrics.model_validate(table)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        where = ".".join(map(str, first["loc"]))
        if first["type"] == "missing":
            return f"no '{where}'"
        return f"{where[:60]}: {first['msg']}" if where else str(first["msg"])
    return None
