# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict on runs: how many good ones are called suspect, and how many wrong ones are not.

Good recordings run as they are; a false alarm is one that does not end `ok`, other than by what it
lacks. Then runs have a wrong calibration, or an IMU in wrong units. Such a run is *missed* if it
ends `ok`, and its error is more than three times that of the run that is right, or its orientation
is off by more than 3°. Both errors are those after alignment in yaw and position.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from benchmarks.flights import FLIGHTS, KIND, flown_by_camera, in_parallel, without_start
from benchmarks.metric import EXACT, Metric, info
from benchmarks.recordings import FIRST_HELD_OUT_SEED, is_held_out
from benchmarks.running import Errors, Run
from benchmarks.suite import CORE, Benchmark, Outcome
from benchmarks.wrong_setups import WRONG_SETUPS, WronglySetUp
from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.formats.eqvio import DEMO
from slam_graph.errors import DataError
from slam_graph.simulation import simulate

CLIP_S = 20.0
IMAGES = "euroc/MH_01_easy_17s"
TRACKS = "openvins_sim/euroc_V1_01"
TRUTH = "euroc_inertial/V1_01_easy"
"""Of the demo."""
SEEDS = 2
"""Seeds of a flight; one of those that are held out."""
PATHS, PATH_SEEDS = ("figure8", "random"), 1
"""Generated flights, and their seeds."""
CLIPS_AT_S = (0.0, 40.0, 80.0)
"""Where clips of the simulated recording begin."""
WORSE, TURNED_DEG = 3.0, 3.0
"""A run is wrong if its error is so many times that of the right one, or if it is turned so far."""
FALSE_ALARMS_BAR = 0.01


@dataclass(frozen=True, slots=True)
class Trial:
    """A run that is to be judged.

    Attributes:
        recording: path below the folder of recordings, or the name of a generated flight.
        cameras: one or two.
        algorithm: its name.
        seed: of a simulated camera, else 0.
        at_s: where in the recording it begins.
        wrong: key of `WRONG_SETUPS`; empty for a good run.
    """

    recording: str
    cameras: int
    algorithm: str
    seed: int = 0
    at_s: float = 0.0
    wrong: str = ""

    @property
    def held_out(self) -> bool:
        """Whether no parameter may be chosen on it."""
        recorded = self.recording not in (*PATHS, DEMO) and is_held_out(self.recording)
        return recorded or self.seed >= FIRST_HELD_OUT_SEED

    @property
    def name(self) -> str:
        """What a reader calls it."""
        part = f" from {self.at_s:g} s" if self.at_s else ""
        words = (self.recording.split("/")[-1] + part, KIND[self.cameras], self.algorithm)
        return ", ".join(filter(None, [*words, f"seed {self.seed}", self.wrong]))

    def open(self, data: Path) -> RecordedSequence:
        """The recording, with what is wrong."""
        recording = self._recorded(data)
        return WronglySetUp(recording, WRONG_SETUPS[self.wrong]) if self.wrong else recording

    def _recorded(self, data: Path) -> RecordedSequence:
        if self.recording == DEMO:
            return open_dataset(DEMO, groundtruth=data / TRUTH)
        if self.recording in (IMAGES, TRACKS):
            return open_dataset(data / self.recording, cameras=self.cameras)
        if self.recording in PATHS:
            sequence = simulate(
                trajectory=self.recording,
                cameras=self.cameras,
                duration_s=CLIP_S,
                seed=self.seed,
            )
        else:
            sequence = flown_by_camera(
                data / self.recording, self.cameras, self.seed, duration_s=CLIP_S
            )
        return without_start(sequence)


@dataclass(frozen=True, slots=True)
class Judged:
    """What came of a trial.

    Attributes:
        status: of the run, `ok` if nothing was wrong with it.
        message: what was said.
        errors: of the causal estimate after alignment in yaw; NaN without one.
        frames: how many were processed.
    """

    status: str
    message: str
    errors: Errors
    frames: int

    def harmed_beside(self, clean: Judged) -> bool:
        """Whether there is no estimate, or one whose error is too large beside the right one's."""
        within = self.errors.position_m <= WORSE * clean.errors.position_m
        return not (within and self.errors.orientation_deg <= TURNED_DEG)  # NaN is neither

    @property
    def is_named(self) -> bool:
        """Whether a cause is named."""
        return "slam-graph doctor" in self.message

    def described(self, trial: Trial) -> str:
        """Name and errors of a trial."""
        errors = self.errors
        return f"{trial.name}: {errors.position_m:.3f} m, {errors.orientation_deg:.1f}°"


def judge(data: Path, trial: Trial) -> Judged:
    """Run a trial."""
    logging.getLogger("slam_graph").setLevel(logging.CRITICAL)  # what is said is expected
    overrides = (f"start_s={trial.at_s}",)
    run = Run(trial.open(data), trial.algorithm, trial.cameras, None, overrides, CLIP_S)
    return judged(run)


def judged(run: Run) -> Judged:
    """What came of a run."""
    result, errors = run.result, Errors.unknown()
    if len(result.history):
        with suppress(DataError):  # if it is too short to be judged
            errors = Errors.of(run.truth, result.trajectory, "yaw")
    return Judged(result.status, result.message, errors, result.logs.frames)


def good_trials(algorithms: Iterable[str] = CORE) -> list[Trial]:
    """Recordings as they are."""
    trials = []
    for name in algorithms:
        trials.append(Trial(DEMO, 1, name))
        for cameras in (1, 2):
            trials.append(Trial(IMAGES, cameras, name))
            trials += [Trial(TRACKS, cameras, name, at_s=at_s) for at_s in CLIPS_AT_S]
            for first in (0, FIRST_HELD_OUT_SEED):
                for path in PATHS:
                    seeds = range(first, first + PATH_SEEDS)
                    trials += [Trial(path, cameras, name, seed) for seed in seeds]
            for flight in FLIGHTS:
                held = range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + 1)
                seeds = held if is_held_out(flight) else range(SEEDS)
                trials += [Trial(flight, cameras, name, seed) for seed in seeds]
    return trials


CLEAN_OF_WRONG = (
    Trial(IMAGES, 2, "msckf"),
    Trial("euroc_inertial/V1_02_medium", 2, "swf"),
    Trial("euroc_inertial/V1_02_medium", 2, "okvis"),
    Trial("tumvi_inertial/room1", 1, "msckf"),
    Trial("euroc_inertial/V2_02_medium", 2, "msckf", FIRST_HELD_OUT_SEED),
)
"""Good runs that are repeated with every wrong set-up."""


def wrong_trials() -> list[tuple[Trial, Trial]]:
    """Runs with a wrong set-up, each after the one that is right."""
    return [
        (clean, Trial(clean.recording, clean.cameras, clean.algorithm, clean.seed, 0.0, wrong))
        for clean in CLEAN_OF_WRONG
        for wrong, setup in WRONG_SETUPS.items()
        if setup.cameras <= clean.cameras
    ]


def measure(data: Path) -> Outcome:
    """False alarms among good runs, and wrong runs that are not noticed; held out apart."""
    good, pairs = good_trials(), wrong_trials()
    cleans = [clean for clean in dict.fromkeys(clean for clean, _ in pairs) if clean not in good]
    trials = [*good, *cleans, *(wrong for _, wrong in pairs)]
    found = in_parallel(judge, [(data, trial) for trial in trials])
    return summed_up(dict(zip(trials, found, strict=True)))


def summed_up(found: dict[Trial, Judged]) -> Outcome:
    """Figures of all trials."""
    outcome = Outcome()
    for held_out in (False, True):
        good = [t for t in good_trials() if t.held_out == held_out]
        pairs = [(c, w) for c, w in wrong_trials() if w.held_out == held_out]
        alarms = [t for t in good if found[t].status in ("suspect", "failed")]
        harmed = [(c, w) for c, w in pairs if found[w].harmed_beside(found[c])]
        missed = [w for c, w in harmed if found[w].status == "ok"]
        refused = [w for _, w in pairs if found[w].status == "failed"]
        rate = len(alarms) / max(len(good), 1)
        outcome.add(
            "held_out" if held_out else "chosen_on",
            [
                info("good", len(good), "runs"),
                Metric("false_alarms", rate, "of the good", "lower", FALSE_ALARMS_BAR, EXACT),
                info("wrong", len(pairs), "runs"),
                info("harmed", len(harmed), "runs"),
                Metric("missed", len(missed), "runs", "lower", 0.0, EXACT),
                info("named", sum(found[w].is_named for _, w in pairs), "runs"),
                info("refused", len(refused), "runs"),
            ],
            held_out=held_out,
        )
        outcome.notes += [f"false alarm: {t.name}: {found[t].message}" for t in alarms]
        outcome.notes += [
            f"good, but {found[t].status}: {t.name}: {found[t].message}"
            for t in good
            if found[t].status not in ("ok", "suspect", "failed")
        ]
        outcome.notes += [f"missed: {found[t].described(t)}" for t in missed]
    return outcome


BENCHMARKS = {
    "verdict": Benchmark(
        "good runs that are called suspect, and runs with a wrong set-up that are not",
        (IMAGES, TRACKS, TRUTH, *FLIGHTS),
        measure,
    )
}
