# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the readers of results: trajectories, states, tables, points, metrics.

As `test_parser_properties`: what is written is read again, and anything is judged.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import (
    ANYTHING,
    NAMES,
    edited,
    examples,
    finite,
    instead,
    parsed,
    poses,
    rows_of,
    stamps,
    trajectories,
    vectors,
)
from sound import sound_stamps, sound_trajectory

import slam_graph as sg
from slam_graph.experiment.batch_summary import _measured
from slam_graph.experiment.batch_task import MARK, SCHEMA_VERSION, _read_mark
from slam_graph.experiment.comparison_report import _cells, _row
from slam_graph.experiment.comparison_results import read_result, write_result
from slam_graph.geometry import NavState, StateHistory
from slam_graph.results import SavedRun
from slam_graph.results.map_output import read_ply, write_ply
from slam_graph.results.result_files import (
    LOOP_COLUMNS,
    read_states,
    read_table,
    read_tum,
    state_lines,
)

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]


# --- what is written ------------------------------------------------------------------------------


@st.composite
def histories(draw: st.DrawFn) -> StateHistory:
    """One to a few states, some of them without a covariance."""
    history = StateHistory()
    for stamp_ns in draw(stamps(fewest=1)).tolist():
        sigmas = draw(st.none() | st.lists(st.floats(0.0, 1e8), min_size=15, max_size=15))
        velocity, accel_bias, gyro_bias = (np.array(draw(vectors(3, 1e8))) for _ in range(3))
        covariance = None if sigmas is None else np.diag(np.square(sigmas))
        history.append(
            NavState(
                stamp_ns,
                draw(poses()),
                velocity,
                accel_bias=accel_bias,
                gyro_bias=gyro_bias,
                covariance=covariance,
            )
        )
    return history


@examples()
@given(history=histories())
def test_states(folder: Path, history: StateHistory) -> None:
    """Nine digits of velocities, biases and standard deviations; NaN where these are not known."""
    path = folder / "states.csv"
    path.write_text("".join(state_lines(history)))
    times, columns = read_states(path)
    written = history.trajectory()
    np.testing.assert_array_equal(times, written.stamps_ns)
    parts = (written.velocities, written.accel_biases, written.gyro_biases, history.sigmas())
    wanted = np.hstack([part for part in parts if part is not None])
    found = np.column_stack(list(columns.values()))
    np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-300)


@examples()
@given(points=st.lists(vectors(3, 1e18), max_size=6), red=st.booleans())
def test_points(folder: Path, points: list[list[float]], red: bool) -> None:
    """To the bit; of a cloud with cameras nothing is read as points."""
    path, written = folder / "map.ply", np.array(points).reshape(-1, 3)
    write_ply(path, written, written[:1] if red else None)
    found = parsed(read_ply, path)
    assert (found is None) == red
    if found is not None:
        np.testing.assert_array_equal(found, written)


@examples()
@given(
    rows=st.lists(
        st.tuples(st.integers(1 - 2**62, 2**62 - 1), finite(1e17) | st.just(np.nan)),
        max_size=6,
        unique_by=lambda row: row[0],
    ),
    title=st.sampled_from(["a_ms", "b", "joint_x"]),
)
def test_tables(folder: Path, rows: list[tuple[int, float]], title: str) -> None:
    """Numbers to the bit, and nothing for NaN."""
    rows = sorted(rows)
    path = folder / "timing.csv"
    lines = [f"{stamp},{'' if np.isnan(value) else repr(value)}" for stamp, value in rows]
    path.write_text("\n".join([f"stamp_ns,{title}", *lines]) + "\n")
    table = read_table(path, ["stamp_ns"], "a table")
    assert table["stamp_ns"].tolist() == [stamp for stamp, _ in rows]
    np.testing.assert_array_equal(table[title], [value for _, value in rows])


# --- what is there may be any ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def result() -> sg.RunResult:
    """A short run with ground truth."""
    return sg.run(sg.simulate(trajectory="figure8", duration_s=1.5, rate_hz=10.0, seed=1))


@pytest.fixture(scope="module")
def saved(result: sg.RunResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its files with tables of three rows, with loops and a mark of a batch."""
    folder = tmp_path_factory.mktemp("saved") / "run"
    result.save(folder)
    for pattern, titles in (("*.tum", 0), ("*.csv", 1)):
        for file in folder.glob(pattern):
            file.write_text("".join(file.read_text().splitlines(keepends=True)[: 3 + titles]))
    for name in ("trajectory_loop.tum", "trajectory_map.tum"):
        shutil.copy(folder / "trajectory.tum", folder / name)
    ends = ",".join(map(str, result.trajectory.stamps_ns[:2]))
    (folder / "loops.csv").write_text(f"{','.join(LOOP_COLUMNS)}\n{ends},1\n{ends},0\n")
    mark = {
        "schema_version": SCHEMA_VERSION,
        "name": "a",
        "data": "a",
        "status": "ok",
        "settings_hash": "1",
    }
    (folder / MARK).write_text(json.dumps(mark))
    return folder


def check_run(folder: Path) -> None:
    """Finite trajectories and tables in the order of time; NaN where nothing is known."""
    run = SavedRun(folder)
    for path in (run.trajectory, run.smoothed, run.loop_closed, run.in_map, run.groundtruth):
        if path is not None and len(path):
            sound_trajectory(path)
    for table in (run.timing, run.by_frame):
        sound_stamps(table["stamp_ns"])
        for values in table.values():
            assert np.isfinite(np.square(values[~np.isnan(values)], dtype=np.float64)).all()
    sound_stamps(run.keyframes_ns, *run.loop_ends_ns.reshape(-1, 1))
    assert np.isfinite(run.points**2).all()
    for text in (repr(run), run.status, run.message, str(run._facts())):
        assert isinstance(text, str)
    run._view()
    _measured(run.metrics)


TEXTS = (
    *("trajectory.tum", "trajectory_smoothed.tum", "trajectory_loop.tum", "groundtruth.tum"),
    *("states.csv", "states_smoothed.csv", "frames.csv", "timing.csv", "loops.csv"),
)


@pytest.mark.parametrize("name", TEXTS)
@examples(40)
@given(data=st.data())
def test_edited_files_of_a_run(saved: Path, name: str, data: st.DataObject) -> None:
    file = saved / name
    text = file.read_text()
    first, separator = text.splitlines()[0], "," if name.endswith("csv") else " "
    rows = rows_of(separator, first.count(separator) + 1).map(
        lambda rows: f"{first}\n{rows}".encode("utf-8", "surrogatepass")
    )
    with instead(file, data.draw(edited(text) | edited(text) | rows | ANYTHING)):
        parsed(check_run, saved)


@examples()
@given(data=st.data())
def test_any_points(saved: Path, data: st.DataObject) -> None:
    whole = bytearray((saved / "map.ply").read_bytes())
    start = whole.index(b"end_header\n") + 11
    for _ in range(data.draw(st.integers(1, 4))):
        number = np.array(data.draw(st.floats())).tobytes()
        at = start + 8 * data.draw(st.integers(0, (len(whole) - start) // 8 - 1))
        whole[at : at + 8] = number
    cut = data.draw(st.integers(0, len(whole)) | st.just(len(whole)))
    with instead(saved / "map.ply", bytes(whole[:cut])):
        parsed(check_run, saved)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | NAMES | st.just(10**400),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=4,
)
"""What JSON may have, and Python's reader takes: NaN, infinity and numbers without end too."""


@st.composite
def altered(draw: st.DrawFn, table: dict[str, Any]) -> bytes:
    """JSON in which one to three values, at any depth, are others or missing."""
    table = json.loads(json.dumps(table))
    for _ in range(draw(st.integers(1, 3))):
        inside: Any = table
        while inside:
            key = draw(st.sampled_from(list(inside)))
            if isinstance(inside[key], dict) and inside[key] and draw(st.integers(0, 4)):
                inside = inside[key]
                continue
            if draw(st.booleans()):
                inside[key] = draw(VALUES)
            else:
                del inside[key]
            break
    return json.dumps(table).encode()


@examples(150)
@given(data=st.data())
def test_metrics_with_other_values(saved: Path, data: st.DataObject) -> None:
    file = saved / "metrics.json"
    with instead(file, data.draw(altered(json.loads(file.read_text())) | ANYTHING)):
        parsed(check_run, saved)


class Done:
    """A run of a comparison, the settings of which are those that are wanted."""

    def __init__(self, result: Path) -> None:
        self.result = result

    def is_done(self) -> bool:
        return read_result(self.result) is not None


@examples(100)
@given(data=st.data())
def test_a_comparison_with_other_values(
    result: sg.RunResult, folder: Path, data: st.DataObject
) -> None:
    """It is done again, or has a row in the report."""
    path = folder / "msckf.json"
    if not path.exists():
        write_result(path, result, {"data": "a", "algorithm": "b", "seed": 0, "settings_hash": "1"})
    with instead(path, data.draw(altered(json.loads(path.read_text())))):
        cells = _cells(_row("flight", "msckf", [Done(path)]))  # type: ignore[list-item]
    assert all(isinstance(cell, str) for cell in cells)


@examples(100)
@given(data=st.data())
def test_marks_of_a_batch_with_other_values(saved: Path, data: st.DataObject) -> None:
    file = saved / MARK
    with instead(file, data.draw(altered(json.loads(file.read_text())) | ANYTHING)):
        mark = _read_mark(saved)
    assert mark is None or isinstance(mark, dict)


@examples()
@given(path=trajectories(columns=(7,), least=1 - 2**61, end=2**61), content=ANYTHING)
def test_trajectories_of_results(folder: Path, path: Any, content: bytes) -> None:
    """An empty file is a trajectory without poses."""
    file = folder / "path.tum"
    file.write_bytes(b"")
    assert len(read_tum(file)) == 0
    file.write_text("".join(path.tum_lines()))
    found = read_tum(file)
    np.testing.assert_array_equal(found.stamps_ns, path.stamps_ns)
    np.testing.assert_allclose(found.positions, path.positions, rtol=1e-6, atol=1e-6)
    file.write_bytes(content)
    parsed(read_tum, file)
