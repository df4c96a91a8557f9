# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Several runs in `slam-graph view`: each judged by its own truth, named so that they differ."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slam_graph.arrays import FloatArray
    from slam_graph.geometry import Trajectory
    from slam_graph.results import SavedRun
    from slam_graph.visualization import RerunRecording

_Show = Callable[["RerunRecording"], None]

_OWN_TRUTH = (
    "These are runs of different recordings: each is in the world of its own ground truth, and "
    "its errors are against that."
)


def runs_compared(folders: list[Path]) -> _Show:
    """Several runs, each in the world of its own truth; without truths, in that of the first run.

    Raises:
        DataError: if a folder is none of a run, or the runs have nothing in common: without their
            truths they must be of one recording.
    """
    from slam_graph.errors import DataError
    from slam_graph.results import load_result

    saved = [load_result(folder) for folder in folders]
    one = all(_same_recording(run, saved[0]) for run in saved)
    truths = [run.groundtruth for run in saved]
    lacking = [folder for folder, truth in zip(folders, truths, strict=True) if truth is None]
    if lacking and not one:
        raise DataError(
            f"{lacking[0]}: cannot be compared: it has no ground truth, and the runs are of "
            "different recordings"
        )
    if len(lacking) < len(folders):  # one recording: those without a truth take another's
        shared = next(truth for truth in truths if truth is not None)
        references = [shared if truth is None else truth for truth in truths]
    else:
        references = [saved[0].trajectory] * len(saved)
    what = "error" if len(lacking) < len(folders) else "difference"
    starts_ns = [int(run.trajectory.stamps_ns[0]) for run in saved if len(run.trajectory)]
    runs: dict[str, dict[str, FloatArray]] = {}
    for name, folder, run, reference in zip(
        _names(folders, saved), folders, saved, references, strict=True
    ):
        own_ns = int(run.metrics["extent"]["start_ns"])
        start_ns = min(starts_ns, default=0) if one else own_ns
        try:
            runs[name] = _compared(run, reference, what, start_ns)
        except DataError as error:
            raise DataError(f"{folder}: cannot be compared: {error}") from error
    true_paths: dict[str, FloatArray] = {}
    for run in saved:
        label = "ground truth" if one else f"ground truth of {_recording(run)}"
        if run.groundtruth is not None:
            true_paths.setdefault(label, run.groundtruth.positions)
    note = "" if one else _OWN_TRUTH
    return lambda recording: recording.show_comparison(runs, true_paths, note)


def _recording(run: SavedRun) -> str:
    """The name of the recording of a run."""
    return str(run.metrics["dataset"]["name"])


def _same_recording(run: SavedRun, other: SavedRun) -> bool:
    """Whether two runs are of one recording, as far as their metrics tell, and share some time."""
    keys = ("name", "start_ns", "end_ns", "imu_samples")
    first, second = run.metrics["dataset"], other.metrics["dataset"]
    spans = [one.metrics["extent"] for one in (run, other)]
    return all(first.get(key) == second.get(key) for key in keys) and max(
        span["start_ns"] for span in spans
    ) <= min(span.get("end_ns", span["start_ns"]) for span in spans)


def _names(folders: list[Path], saved: list[SavedRun]) -> list[str]:
    """Names of runs: their algorithms where these differ, else as much of their folders as does."""
    algorithms = [str(run.metrics["algorithm"]) for run in saved]
    if len(set(algorithms)) == len(algorithms):
        return algorithms
    places = [run.folder.resolve() for run in saved]
    choices = (
        [place.parent.name for place in places],
        [place.name for place in places],
        ["/".join(place.parts[-2:]) for place in places],
        [str(folder) for folder in folders],
    )
    for names in choices:
        if len(set(names)) == len(names):
            return names
    return [f"{name} ({number})" for number, name in enumerate(choices[-1], start=1)]


def _compared(
    run: SavedRun, reference: Trajectory, what: str, start_ns: int
) -> dict[str, FloatArray]:
    """The path of a run in the world of a reference, and its errors.

    See `RerunRecording.show_comparison`.
    """
    import numpy as np

    from slam_graph.evaluation import ape

    estimate, camera = run.trajectory, run.scaled_camera
    if camera is not None:  # its path is scaled, and not that of the body
        reference, estimate = reference.mounted(camera), estimate.mounted(camera)
    breaks = run.metrics["extent"].get("world_breaks_ns", [])
    mode = run.unmeasured
    position = ape(reference, estimate, "trans_part", mode, breaks_ns=breaks)
    rotation = ape(reference, estimate, "angle_deg", mode, breaks_ns=breaks)
    moved = position.alignment.apply(estimate)
    return {
        "path": moved.positions,
        "time_s": np.asarray((position.stamps_ns - start_ns) * 1e-9, np.float64),
        f"position {what} [m]": position.values,
        f"orientation {what} [deg]": rotation.values,
    }
