# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the tables of the documents hold: a function from figures to lines each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from benchmarks.baseline import Baseline, benchmark_of, text_of, value_of
from benchmarks.faults import ALGORITHMS as FAULTY
from benchmarks.faults import FAULTS, OF_TRACKS, SIGMA_BAR, fault_key
from benchmarks.flights import FLIGHTS, flight_is_held_out
from benchmarks.held_out import CLIP_S, SEEDS, SIMULATED_S
from benchmarks.kernels import SIZES
from benchmarks.suite import CORE, PEERS, RECURSIVE
from slam_graph.errors import DataError


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of the baseline as text."""

    baseline: Baseline

    def __call__(self, key: str, digits: int) -> str:
        """A figure with so many digits after the point.

        Raises:
            DataError: if the baseline does not have it.
        """
        value = _there(value_of(self.baseline, key), key)
        return f"{value:.{digits}f}" if math.isfinite(value) else "-"

    def text(self, key: str) -> str:
        """What a run said.

        Raises:
            DataError: if the baseline does not have it.
        """
        return _there(text_of(self.baseline, key), key)

    def has(self, key: str) -> bool:
        """Whether the baseline has a figure."""
        return value_of(self.baseline, key) is not None

    def all(self, keys: Sequence[str], digits: int, separator: str = " / ") -> str:
        """Several figures in one cell."""
        return separator.join(self(key, digits) for key in keys)


_Value = TypeVar("_Value")


def _there(value: _Value | None, key: str) -> _Value:
    """A value of the baseline.

    Raises:
        DataError: if the baseline does not have it.
    """
    if value is None:
        raise DataError(
            f"{key} is not in the baseline; run `python -m benchmarks.run --only "
            f"{benchmark_of(key)} --update-baseline`"
        )
    return value


def results(figures: Figures) -> Iterator[str]:
    """The table of the README and of the page of measured results."""
    yield "| recording | | msckf | swf | OpenVINS | Basalt | OKVIS2, causal |"
    yield "|---|---|---:|---:|---:|---:|---:|"
    position, orientation = ("position [m]", 4), ("orientation [deg]", 2)
    real = (("ate", *position), ("orientation", *orientation))
    simulated = (("position", *position), ("orientation", *orientation))
    others = ("openvins", "basalt", "okvis2")
    for name, benchmark, rows, shown in (
        ("V1_01, tracks, mono, 30 s (the demo)", "wheel_v101", real, others[:0]),
        ("MH_01, images, mono, 17 s", "mh01_mono", real, others[:1]),
        ("MH_01, images, stereo, 17 s", "mh01_stereo", real, others),
        (f"V1_01, {SIMULATED}, mono, 134 s", "openvins_sim_mono", simulated, others[:1]),
        (f"V1_01, {SIMULATED}, stereo, 134 s", "openvins_sim_stereo", simulated, others[:1]),
    ):
        systems = ("msckf", "swf", *shown)
        for row, (key, label, digits) in enumerate(rows):
            cells = [figures(f"{benchmark}.{system}.{key}", digits) for system in systems]
            yield line(name if row == 0 else "", label, *cells, width=7)
        if rows is simulated:
            pairs = [
                [f"{benchmark}.{system}.nees_{part}" for part in ("position", "orientation")]
                for system in systems
            ]
            cells = [figures.all(pair, 1) for pair in pairs]
            yield line("", "NEES, position / orientation (ideal 3)", *cells, width=7)
    yield from speed(figures)


SIMULATED = "simulated tracks"


def speed(figures: Figures) -> Iterator[str]:
    """The last rows of the table of the README; all of the causal part, start-up included."""
    cost, memory = (
        [figures(f"speed_mh01_stereo.{system}.{key}", digits) for system in ("msckf", "swf")]
        for key, digits in (("cost_mean", 1), ("peak_memory", 0))
    )
    yield line("MH_01, images, stereo, causal", "time a frame [flows]", *cost, width=7)
    yield line("", "peak memory [MB]", *memory, width=7)


def peers(figures: Figures) -> Iterator[str]:
    """Ours beside other systems in one run; what was not measured is left out."""
    yield "| | sensors | cost [flows] | causal: ATE [m] / orientation [deg] / covered [s] | final |"
    yield "|---|---|---:|---:|---:|"
    both = "two cameras, IMU"
    sensors = {**dict.fromkeys(CORE, both), "orbslam3": both, "cuvslam": "two cameras"}
    for name, used in sensors.items():
        key = f"peers.{name}"
        if not figures.has(f"{key}.cost"):
            continue
        cells = [
            " / ".join(figures(f"{key}.{kind}.{part}", digits) for part, digits in ERRORS)
            if figures.has(f"{key}.{kind}.ate")
            else ""
            for kind in ("causal", "final")
        ]
        yield line(OTHERS.get(name, f"`{name}`"), used, figures(f"{key}.cost", 1), *cells)


OTHERS = {"orbslam3": "ORB-SLAM3", "cuvslam": "cuVSLAM, CPU"}
ERRORS = (("ate", 4), ("orientation", 2), ("coverage", 1))


def kernels(figures: Figures) -> Iterator[str]:
    """Ways to reduce features to the poses, as multiples of GTSAM's Cholesky."""
    yield "| | " + " | ".join(f"{j} features × {i} poses" for j, i in SIZES.values()) + " |"
    yield "|---|" + "---:|" * len(SIZES)
    for way, label in WAYS.items():
        yield line(label, *(figures(f"kernels.{size}.{way}", 2) for size in SIZES))


WAYS = {
    "gtsam_cholesky": "GTSAM, Cholesky, ms CPU",
    "gtsam_linearize": "its linearisation",
    "gtsam_build": "making its factors, not included",
    "gtsam_qr": "GTSAM, QR",
    "rows_numpy": "null-space rows and QR, NumPy",
    "rows_compiled": "the same, rows compiled",
    "sum_numpy": "sum of Schur complements, NumPy",
    "sum_compiled": "the same, compiled: **the engine's**",
    "linearize": "its linearisation",
}


def growth(figures: Figures) -> Iterator[str]:
    """Cost of a frame minute by minute; algorithms that were not measured yet are left out."""
    yield "| | " + " | ".join(f"min {part}" for part in MINUTES) + " | 8 to 10 over 3 to 5 |"
    yield "|---|" + "---:|" * (len(MINUTES) + 1)
    for name in CORE:
        if figures.has(f"growth.{name}.growth"):
            cells = [figures(f"growth.{name}.cost_{part}", 2) for part in MINUTES]
            yield line(f"`{name}`", *cells, figures(f"growth.{name}.growth", 2))


MINUTES = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10)


def monte_carlo(figures: Figures) -> Iterator[str]:
    """NEES with and without first-estimates Jacobians."""
    yield "| | NEES pose | orientation | position | without: pose | orientation | position |"
    yield "|---|---:|---:|---:|---:|---:|---:|"
    for name in RECURSIVE:
        keys = [
            f"monte_carlo.{name}{variant}.nees_{part}"
            for variant in ("", "_no_fej")
            for part in ("pose", "orientation", "position")
        ]
        yield line(f"`{name}`", *(figures(key, 1) for key in keys))


def real_imu(figures: Figures) -> Iterator[str]:
    """Errors and NEES of every algorithm on flights with their real IMU."""
    flights = ("V1_02_medium", "V2_01_easy", "V2_02_medium", "MH_04_difficult")
    yield "| | V1_02 | V2_01 | V2_02, held out | MH_04, held out |"
    yield "|---|---|---|---|---|"
    for name in (*RECURSIVE, *PEERS):
        cells = []
        for flight in flights:
            run = f"real_imu.{flight}.{name}"
            nees = [f"{run}.nees_{part}" for part in ("position", "orientation")]
            errors = f"{figures(f'{run}.ate', 3)} / {figures(f'{run}.orientation', 2)}"
            cells.append(f"{errors} / {figures.all(nees, 0, ', ')}")
        yield line(f"`{name}`", *cells)


def _label(path: str) -> str:
    """The name of a flight, without how difficult it is."""
    name = "_".join(path.split("/")[-1].split("_")[:2])
    return f"{name}, held out" if flight_is_held_out(Path(path)) else name


def mono_real_imu(figures: Figures) -> Iterator[str]:
    """Errors, NEES and scale with one camera on flights with their real IMU, over seeds."""
    yield "| | `msckf` | `swf` | `okvis` | smoothed | scale |"
    yield "|---|---|---|---|---:|---:|"
    for path in FLIGHTS:
        flight = path.split("/")[-1]
        cells = []
        for name in CORE:
            run = f"mono_real_imu.{flight}.{name}"
            nees = [f"{run}.nees_{part}" for part in ("position", "orientation")]
            errors = f"{figures(f'{run}.ate', 3)} ({figures(f'{run}.ate_worst', 3)})"
            cells.append(f"{errors} / {figures.all(nees, 1, ', ')}")
        best = f"mono_real_imu.{flight}.{CORE[0]}"
        scale = f"{100 * float(figures(f'{best}.scale_error', 5)):.2f} %"
        yield line(_label(path), *cells, figures(f"{best}.smoothed", 4), scale)


def consistency_real(figures: Figures) -> Iterator[str]:
    """NEES of the first 30 s of flights with their real IMU, one camera and two."""
    yield line("", *map(_label, FLIGHTS))
    yield f"|---|{'---|' * len(FLIGHTS)}"
    parts = ("position", "orientation")
    for name in (*RECURSIVE, *PEERS, f"smoothed_{CORE[0]}"):
        cells = []
        for path in FLIGHTS:
            flight = f"consistency_real.{path.split('/')[-1]}"
            runs = [f"{flight}.{cameras}.{name}.nees_" for cameras in ("mono", "stereo")]
            both = [figures.all([run + part for part in parts], 1, ", ") for run in runs]
            cells.append(" / ".join(both))
        algorithm = name.removeprefix("smoothed_")
        yield line(f"`{algorithm}`" if algorithm == name else f"`{algorithm}`, smoothed", *cells)


def held_out(figures: Figures) -> Iterator[str]:
    """What no parameter was chosen on."""
    clip, simulated = f"{CLIP_S:g} s", f"{len(SEEDS)} simulated flights of {SIMULATED_S:g} s"
    yield line("", f"V2_02, {clip}", f"MH_04, {clip}", simulated)
    yield "|---|---:|---:|---:|"
    for name in ("msckf", "swf", "okvis"):
        cells = [
            f"{figures(f'held_out.{part}.{name}.{error}', 4)} / "
            f"{figures(f'held_out.{part}.{name}.orientation', 2)}"
            for part, error in (
                ("V2_02_medium", "ate"),
                ("MH_04_difficult", "ate"),
                ("seeds", "position"),
            )
        ]
        nees = [f"held_out.seeds.{name}.nees_{part}" for part in ("position", "orientation")]
        yield line(f"`{name}`", *cells[:-1], f"{cells[-1]} / {figures.all(nees, 1, ', ')}")


def faults(figures: Figures) -> Iterator[str]:
    """What becomes of runs with a fault in images."""
    yield from _faulty(figures, "faults", FAULTS)


def faults_tracks(figures: Figures) -> Iterator[str]:
    """What becomes of runs with a fault in tracks."""
    yield from _faulty(figures, "faults_tracks", OF_TRACKS)


def faults_said(figures: Figures) -> Iterator[str]:
    """What a run says of each fault in images, and whether it is back after it."""
    yield from _told(figures, "faults", FAULTS)


def faults_tracks_said(figures: Figures) -> Iterator[str]:
    """The same in tracks."""
    yield from _told(figures, "faults_tracks", OF_TRACKS)


def _told(figures: Figures, suite: str, struck: Iterable[str]) -> Iterator[str]:
    """A line for each fault, of runs under the default algorithm."""
    yield "| fault | status | what is said | error without → with [mm] | back |"
    yield "|---|---|---|---:|---|"
    without_mm = 1e3 * float(figures(f"{suite}.none.{TOLD}.error", 6))
    bar = SIGMA_BAR * float(figures(f"{suite}.none.{TOLD}.sigma_factor", 3))
    yield line("none", "", "", f"{without_mm:.1f}", f"bar: {bar:.1f} σ")
    for fault in struck:
        run = f"{suite}.{fault_key(fault)}.{TOLD}"
        with_mm = without_mm * float(figures(f"{run}.segment_ratio", 3))
        said = figures.text(f"{run}.said").replace("|", "\\|")
        errors = f"{without_mm:.1f} → {with_mm:.1f}"
        status = f"`{figures.text(f'{run}.status')}`"
        yield line(fault, status, said or "nothing", errors, _back(figures, run))


TOLD = "msckf"
"""The algorithm whose runs are told of line by line."""


def _back(figures: Figures, run: str) -> str:
    """Whether a run is back some time after a fault: in a new segment, or by its σ."""
    if figures(f"{run}.segments", 0) != "1":
        text = f"new segment, {figures(f'{run}.recovered_in', 1)} s"
    else:
        error, clean = (figures(f"{run}.{key}", 1) for key in ("sigmas", "sigmas_clean"))
        text = f"{error} σ; {clean} without"
    return text if figures(f"{run}.back", 0) == "1" else f"**no:** {text}"


def _faulty(figures: Figures, suite: str, struck: Iterable[str]) -> Iterator[str]:
    """Runs of a benchmark; algorithms that were not measured yet are left out."""
    names = [name for name in FAULTY if figures.has(f"{suite}.none.{name}.error")]
    yield "| fault | " + " | ".join(f"`{name}`" for name in names) + " |"
    yield "|---|" + "---|" * len(names)
    yield line("none [m]", *(figures(f"{suite}.none.{name}.error", 4) for name in names))
    for fault in struck:
        yield line(fault, *(_survived(figures, f"{suite}.{fault_key(fault)}.{n}") for n in names))


def _survived(figures: Figures, run: str) -> str:
    """How a run with a fault ended."""
    segments, recovered = figures(f"{run}.segments", 0), figures(f"{run}.recovered_in", 1)
    text = f"{figures(f'{run}.segment_ratio', 1)} ×"
    if segments != "1":
        text += f", {segments} segments, {recovered} s"
    back = f"{run}.back"  # algorithms that were not measured since lack it
    if figures.has(back) and figures(back, 0) == "0":
        text += ", **not back**"
    return text if figures(f"{run}.completed", 0) == "1" else f"{text}, not `ok`"


def verdict(figures: Figures) -> Iterator[str]:
    """False alarms and missed runs, held out apart."""
    yield "| | false alarms | missed |"
    yield "|---|---:|---:|"
    for part, label in (("chosen_on", "thresholds were chosen on"), ("held_out", "held out")):
        alarms = 100 * float(figures(f"verdict.{part}.false_alarms", 4))
        yield line(label, f"{alarms:.1f} %", figures(f"verdict.{part}.missed", 0))


def line(*cells: str, width: int = 0) -> str:
    """A line of a table, filled up with empty cells; an empty one is a single blank."""
    filled = (*cells, *("" for _ in range(width - len(cells))))
    return "|" + "|".join(f" {cell} " if cell else " " for cell in filled) + "|"


TABLES: dict[str, Callable[[Figures], Iterator[str]]] = {
    "results": results,
    "monte_carlo": monte_carlo,
    "real_imu": real_imu,
    "mono_real_imu": mono_real_imu,
    "consistency_real": consistency_real,
    "held_out": held_out,
    "peers": peers,
    "kernels": kernels,
    "growth": growth,
    "faults_said": faults_said,
    "faults_tracks_said": faults_tracks_said,
    "faults": faults,
    "faults_tracks": faults_tracks,
    "verdict": verdict,
}
"""By the name in the marker of a document."""
