# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Supervision: how did the run end, and when may Ctrl-C interrupt it?"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Literal

from slam_graph.backend import Estimator
from slam_graph.errors import SlamGraphError
from slam_graph.interrupts import Interrupts
from slam_graph.pipeline.divergence import DivergenceError
from slam_graph.pipeline.stage import COMPLETED, Stage
from slam_graph.results import RunResult

logger = logging.getLogger(__name__)


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
    except Exception as error:
        ending.status, ending.error, ending.message = "failed", error, _reported(error)
    ending.wall_s = time.perf_counter() - began
    level = logging.INFO if ending.status == "ok" else logging.ERROR
    done = f"{result.logs.frames} frames in {ending.wall_s:.1f} s"
    logger.log(level, "%s", ending.message or done)


def finish(stages: Iterable[Stage], result: RunResult, interrupts: Interrupts.Deferral) -> None:
    """Finish all stages; Ctrl-C ends the one at work, and those that come after are short then.

    A stage that fails does not keep the others from finishing.

    Args:
        stages: in the order in which they finish.
        result: its ending notes the first thing that goes wrong.
        interrupts: Ctrl-C takes effect within stages only.
    """
    ending = result.ending

    def note(status: Literal["interrupted", "failed"], error: BaseException, message: str) -> None:
        if ending.status in COMPLETED:  # what went wrong before says more
            ending.status, ending.error, ending.message = status, error, message

    late = "interrupted after the last frame"
    for stage in stages:
        if interrupts.take():  # between two stages
            note("interrupted", KeyboardInterrupt(), late)
        try:
            with interrupts.at_once():
                stage.finish()
        except KeyboardInterrupt as interrupt:
            note("interrupted", interrupt, late)
        except Exception as error:
            note("failed", error, _reported(error))
    if interrupts.take():
        note("interrupted", KeyboardInterrupt(), late)


def _reported(error: Exception) -> str:
    """The message of an error; one that nobody expected is logged with its traceback."""
    if isinstance(error, SlamGraphError):
        return str(error)
    logger.exception("internal error")
    return f"internal error: {type(error).__name__}: {error}"


def _judge(result: RunResult, estimator: Estimator) -> None:
    """Whether a run that came to its end reached what was asked for."""
    asked, ending = result.config.min_coverage, result.ending
    lost = result.segments.lost
    if not estimator.initialized:
        ending.waiting_for = f": waiting for {estimator.waiting_for}"
    if not estimator.initialized and lost:
        message = f"{lost}; the run did not start again{ending.waiting_for}"
        ending.status, ending.message, ending.error = "diverged", message, DivergenceError(message)
    elif not estimator.initialized:
        ending.status = "not_initialized"
        ending.message = f"never initialised in {result.logs.frames} frames{ending.waiting_for}"
    elif result.coverage < asked:
        ending.status = "low_coverage"
        ending.message = (
            f"the estimate covers {result.coverage:.1%} of the {result.input.recorded_s:.1f} s "
            f"asked for, less than min_coverage = {asked:.1%}"
        )
