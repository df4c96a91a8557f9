# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Supervision: is the estimate sane, how did the run end, and when may Ctrl-C interrupt it?"""

from __future__ import annotations

import logging
import math
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from operator import attrgetter

import numpy as np

from slam_graph.backend import Estimator, Innovations
from slam_graph.config import RunConfig
from slam_graph.errors import EstimationError, SlamGraphError
from slam_graph.geometry import NavState
from slam_graph.pipeline.stage import COMPLETED, Stage
from slam_graph.results import RunResult

_LONGEST_GAP_S = 0.5
"""A gap between two frames whose features were tested counts as at most this much time."""

_GOOD_SHARE = 0.05
"""Share of the features that is rejected while an estimate is good: some percent."""
_LOOKED_BACK = 3.0
"""Tests are kept for so many further intervals, to find the beginning of a disagreement."""

logger = logging.getLogger(__name__)


class DivergenceError(EstimationError):
    """The estimate is beyond what is physically possible, or contradicts the images."""


def check_sane(state: NavState, config: RunConfig) -> None:
    """Refuse a state that cannot be true.

    Raises:
        DivergenceError: naming what is beyond its limit.
    """
    limits = config.limits
    variances = np.zeros(15) if state.covariance is None else np.diag(state.covariance)
    pose, biases = state.world_T_body.matrix().ravel(), (state.gyro_bias, state.accel_bias)
    if not np.isfinite(np.concatenate([pose, state.velocity, *biases, variances])).all():
        raise DivergenceError(f"diverged at frame {state.stamp_ns}: the state is not finite")
    sigma_m = math.sqrt(max(float(variances[3:6].max()), 0.0))
    for what, value, limit in (
        ("speed of {} m/s", float(np.linalg.norm(state.velocity)), limits.max_speed),
        ("position sigma of {} m", sigma_m, limits.max_position_sigma_m),
        ("gyroscope bias of {} rad/s", float(np.abs(state.gyro_bias).max()), limits.max_gyro_bias),
        (
            "accelerometer bias of {} m/s²",
            float(np.abs(state.accel_bias).max()),
            limits.max_accel_bias,
        ),
    ):
        if value > limit:
            raise DivergenceError(
                f"diverged at frame {state.stamp_ns}: {what.format(f'{value:.3g}')} "
                f"(the limit is {limit:g})"
            )


@dataclass(frozen=True, slots=True)
class _Test:
    """How many features of a frame the gate has tested and rejected.

    Attributes:
        stamp_ns: of the frame.
        tested_s: time with tested features up to it.
        tested, rejected: numbers of features.
    """

    stamp_ns: int
    tested_s: float
    tested: int
    rejected: int


class Agreement:
    """Whether the images still agree with the state, by the share that the χ² gate rejects.

    If state and covariance are right, the gate rejects a few percent of the features. Where it
    rejects most of them for seconds, the state is wrong and its covariance too small. It cannot
    recover then: the features that would correct it are those that are rejected.

    Only time in which features are tested counts, and a gap between two tests counts little: after
    a pause, such as blank images, an estimate has time to recover.
    """

    def __init__(self, config: RunConfig) -> None:
        self._limits = config.limits
        self._tests: deque[_Test] = deque()
        self._tested_s = 0.0
        self._last_ns: int | None = None
        self._earlier_ns: int | None = None  # of the newest test that is not kept any more

    def check(self, stamp_ns: int, innovations: Innovations) -> None:
        """Add the tests of the next frame.

        Raises:
            DivergenceError: if too much was rejected for too long.
        """
        if innovations.tested == 0:
            return
        if self._last_ns is not None:
            self._tested_s += min((stamp_ns - self._last_ns) * 1e-9, _LONGEST_GAP_S)
        self._last_ns = stamp_ns
        new = _Test(stamp_ns, self._tested_s, innovations.tested, innovations.rejected)
        self._tests.append(new)
        begin_s = self._tested_s - self._limits.disagreement_s
        while self._tests[0].tested_s < begin_s - _LOOKED_BACK * self._limits.disagreement_s:
            self._earlier_ns = self._tests.popleft().stamp_ns
        if self._tests[0].tested_s > begin_s:
            return
        late = bisect_right(self._tests, begin_s, key=attrgetter("tested_s"))
        recent = list(islice(self._tests, late - 1, None))
        share = sum(test.rejected for test in recent) / sum(test.tested for test in recent)
        if share > self._limits.max_rejected_share:
            raise DivergenceError(
                f"diverged at frame {stamp_ns}: images contradict the state, {share:.0%} of "
                f"what was seen in {self._limits.disagreement_s:g} s was rejected (the limit is "
                f"{self._limits.max_rejected_share:.0%})"
            )

    def agreed_until(self) -> int | None:
        """Time of the last frame before the images contradicted the state; None if they always did.

        The most likely time at which the share of rejected features changed from that of a good
        state to one beyond the limit (a maximum of cumulated log-likelihood ratios: Page 1954).
        """
        good, bad = _GOOD_SHARE, self._limits.max_rejected_share
        kept, lost = np.log((1.0 - bad) / (1.0 - good)), np.log(bad / good)
        tests = list(self._tests)
        ratio, highest, first = 0.0, 0.0, len(tests)
        for k in reversed(range(len(tests))):
            rejected = tests[k].rejected
            ratio += rejected * lost + (tests[k].tested - rejected) * kept
            if ratio >= highest:
                highest, first = ratio, k
        return tests[first - 1].stamp_ns if first else self._earlier_ns


@contextmanager
def outcome(result: RunResult, estimator: Estimator) -> Iterator[None]:
    """Run the block and note in the result how it ended; `RunResult.check` raises it later."""
    began = time.perf_counter()
    ending = result.ending
    try:
        yield
        _judge(result, estimator)
    except KeyboardInterrupt as interrupt:
        ending.status, ending.message = "interrupted", "interrupted before the end"
        ending.error = interrupt
    except DivergenceError as error:
        ending.status, ending.message, ending.error = "diverged", str(error), error
    except SlamGraphError as error:
        ending.status, ending.message, ending.error = "failed", str(error), error
    except Exception as error:
        logger.exception("internal error")
        ending.status, ending.error = "failed", error
        ending.message = f"internal error: {type(error).__name__}: {error}"
    ending.wall_s = time.perf_counter() - began
    level = logging.INFO if ending.status == "ok" else logging.ERROR
    done = f"{result.logs.frames} frames in {ending.wall_s:.1f} s"
    logger.log(level, "%s", ending.message or done)


def finish(stages: Iterable[Stage], result: RunResult) -> None:
    """Finish all stages; Ctrl-C ends the one at work, and those that come after are short then."""
    waiting = deque(stages)
    while waiting:
        try:
            while waiting:
                waiting.popleft().finish()
        except KeyboardInterrupt as interrupt:
            ending = result.ending
            if ending.status in COMPLETED:  # what went wrong before says more
                ending.status, ending.error = "interrupted", interrupt
                ending.message = "interrupted after the last frame"


def _judge(result: RunResult, estimator: Estimator) -> None:
    """Whether a run that came to its end reached what was asked for."""
    asked, ending = result.config.min_coverage, result.ending
    lost = result.segments.lost
    if not estimator.initialized and lost:
        message = f"{lost}; the run did not start again: waiting for {estimator.waiting_for}"
        ending.status, ending.message, ending.error = "diverged", message, DivergenceError(message)
    elif not estimator.initialized:
        ending.status = "not_initialized"
        ending.message = (
            f"never initialised in {result.logs.frames} frames: waiting for {estimator.waiting_for}"
        )
    elif result.coverage < asked:
        ending.status = "low_coverage"
        ending.message = (
            f"the estimate covers {result.coverage:.1%} of the {result.input.recorded_s:.1f} s "
            f"asked for, less than min_coverage = {asked:.1%}"
        )
