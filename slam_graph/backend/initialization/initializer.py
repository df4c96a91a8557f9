# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Initialization: the first window, from standstill or in motion.

A start is tried at every frame until one succeeds. A start in motion has two parts: a first guess
(`dynamic_start.py`), and its refinement as a batch problem (`dynamic_refinement.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.backend.backend_config import UnknownScale
from slam_graph.backend.cost.zero_velocity import StandstillDetector
from slam_graph.backend.engine_protocol import EngineContext
from slam_graph.backend.initialization.dynamic_refinement import (
    MAX_SCALE_SIGMA,
    ROUGH_SCALE_SIGMA,
    DynamicRefinement,
)
from slam_graph.backend.initialization.dynamic_start import (
    StartFrames,
    StartGuess,
    guess_states,
)
from slam_graph.backend.initialization.first_state import start_from, state_at_rest
from slam_graph.backend.initialization.start_diagnosis import MIN_FEATURES, Refusal, likeliest_cause
from slam_graph.backend.window import Window
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame

STATIC_DISPARITY_PX = 1.5
"""Largest median disparity at a static start: larger than that of a later standstill, because
running motors shake the image."""
RETRY_S = 0.2
"""Time between two attempts to start in motion; each takes as long as many frames."""
_PATIENT_ATTEMPTS = 6
"""With each attempt after so many whose steps did not converge the time doubles; one that fails for
another reason takes one of them back. They are among the costliest, and what is wrong then is no
lack of motion: before none of 250 starts with a right calibration there were more than two in a
row, and with focal lengths that are 10 % too long, where an estimate is still of use, five."""
_MOST_DOUBLINGS = 3
"""More attempts in vain than lead to so many doublings do not count."""
_LONGEST_RETRY_S = 1.2
"""Longest time between two attempts."""
FRAME_SPACING_S = 0.15
"""Time between the frames of a start in motion."""
_SLACK_NS = 100_000_000
"""How much longer than the window frames are kept; and as much longer as it takes where there is no
frame of that time, as with few frames a second, or in a gap."""
_LONGEST = 2.0
"""Frames older than so many windows are not kept whatever is missing after them."""


class Initializer:
    """Collects frames and tries to start from them.

    Attributes:
        scale_sigma: relative standard deviation of the scale of a start in motion; None before it,
            and for a start from standstill.
        leaves_frame: whether the start has not used the features of its last frame.
    """

    leaves_frame = False

    def __init__(
        self, context: EngineContext, mode: str, unknown_scale: UnknownScale | None = None
    ) -> None:
        """Start with no frames.

        Args:
            context: shared with the engine; `context.imu` has the samples up to each frame.
            mode: which starts are tried, as in `initialization.mode`.
            unknown_scale: takes the place of `initialization.unknown_scale`.
        """
        self.scale_sigma: float | None = None
        self._refusal = Refusal("frames", "the first frames")
        self._latest: tuple[int, FeatureFrame] | None = None
        self._context = context
        self._config = context.config.initialization
        self._mode = mode
        waits = (unknown_scale or self._config.unknown_scale) == "wait"
        sigma = MAX_SCALE_SIGMA if waits else ROUGH_SCALE_SIGMA
        self._max_scale_sigma = sigma
        self._refinement = DynamicRefinement(context, sigma)
        self._stamps_ns: list[int] = []
        self._frames: list[FeatureFrame] = []
        self._tried_ns: int | None = None
        self._in_vain = 0
        self._solved: tuple[StartFrames, StartGuess] | None = None
        self._rng = np.random.default_rng(0)
        self._standstill = StandstillDetector(
            context.config.zero_velocity, STATIC_DISPARITY_PX, enabled=True
        )

    @property
    def outliers(self) -> IntArray:
        """Ids (N,) of features that did not fit the last start in motion, ascending."""
        return self._refinement.outliers

    def try_to_start(self, stamp_ns: int, frame: FeatureFrame) -> Window | None:
        """Take the next frame and start if it is possible.

        Args:
            stamp_ns: time of the frame on the clock of the IMU.
            frame: its features.
        """
        outcome: Window | Refusal = Refusal("frames", "a state to start from (mode 'given')")
        self._latest = stamp_ns, frame
        if self._mode in ("auto", "static"):
            self._standstill.add_frame(self._context.imu, stamp_ns, frame)
            outcome = self._at_rest(stamp_ns)
        if self._mode in ("auto", "motion") and isinstance(outcome, Refusal):
            outcome = self._in_motion(stamp_ns, frame)
        if isinstance(outcome, Refusal):
            self._refusal = outcome
            return None
        return outcome

    def solved_from(self, states: Mapping[int, NavState]) -> Window | None:
        """The last start in motion once more, from an estimate; None if that does not fit better.

        Args:
            states: the estimate by its times, among them those of the frames of that start.
        """
        if self._solved is None:
            return None
        frames, guess = self._solved
        if any(stamp_ns not in states for stamp_ns in frames.stamps_ns):
            return None
        estimated = [states[stamp_ns] for stamp_ns in frames.stamps_ns]
        refinement = DynamicRefinement(self._context, self._max_scale_sigma)
        found = refinement.refine(frames, replace(guess, states=estimated))
        if isinstance(found, Refusal) or not refinement.fits_better_than(self._refinement):
            return None
        self._refinement = refinement
        return found

    def waiting_for(self, calibration: str | None) -> str:
        """What a start still needs, and the likeliest cause of the lack.

        Args:
            calibration: what contradicts the calibration, if something does.
        """
        needs = self._refusal.needs
        if self._latest is None:
            return needs
        stamp_ns, frame = self._latest
        imu, noise = self._context.imu, self._context.config.noise
        cause = likeliest_cause(
            self._refusal, self._frames, frame, imu, stamp_ns, noise, calibration
        )
        return f"{needs}; likeliest cause: {cause}" if cause else needs

    def _at_rest(self, stamp_ns: int) -> Window | Refusal:
        """A start from standstill, or what it waits for."""
        since_ns, needed_s = self._standstill.since_ns, self._config.static_window_s
        if since_ns is None or stamp_ns - since_ns < round(needed_s * 1e9):
            return Refusal("rest", f"a still period of {needed_s:g} s")
        samples = self._context.imu.between(since_ns, stamp_ns)
        state = state_at_rest(samples, stamp_ns, self._config.prior)
        return start_from(state, self._context.config, self._context.calibration)

    def _in_motion(self, stamp_ns: int, frame: FeatureFrame) -> Window | Refusal:
        """A start in motion, or what it waits for."""
        imu, length_s = self._context.imu, self._config.motion_window_s
        length_ns = round(length_s * 1e9)
        if imu.covers(stamp_ns) and len(frame.cameras[0]) >= MIN_FEATURES:
            self._stamps_ns.append(stamp_ns)
            self._frames.append(frame)
        self._forget(stamp_ns, length_ns)
        if not self._stamps_ns or stamp_ns - self._stamps_ns[0] < length_ns:
            return Refusal("frames", f"{length_s:g} s of frames with IMU samples")
        tried_ns = self._tried_ns
        if tried_ns is not None and stamp_ns - tried_ns < round(self._retry_s() * 1e9):
            return self._refusal
        self._tried_ns = stamp_ns
        outcome = self._attempt()
        lasting = isinstance(outcome, Refusal) and outcome.lasting
        in_vain = self._in_vain + (1 if lasting else -1)
        self._in_vain = min(max(in_vain, 0), _PATIENT_ATTEMPTS + _MOST_DOUBLINGS)
        return outcome

    def _retry_s(self) -> float:
        """Time from the last attempt to the next."""
        doublings = max(self._in_vain - _PATIENT_ATTEMPTS, 0)
        return min(RETRY_S * 2.0**doublings, _LONGEST_RETRY_S)

    def _attempt(self) -> Window | Refusal:
        """A start from the frames of the window, or what it lacks."""
        context = self._context
        frames = StartFrames.thinned(self._stamps_ns, self._frames, FRAME_SPACING_S)
        turning = context.calibration.turning(frames.stamps_ns, frames.frames, context.imu)
        guess = guess_states(
            frames,
            context.imu,
            context.projection.moving(turning),
            context.config.noise,
            self._rng,
        )
        if isinstance(guess, Refusal):
            return guess
        found, self._solved = self._refinement.refine(frames, guess), (frames, guess)
        self.scale_sigma = None if isinstance(found, Refusal) else self._refinement.scale_sigma
        return found

    def _forget(self, stamp_ns: int, length_ns: int) -> None:
        """Forget frames before the window, but the last of them if none is at its beginning."""
        stamps_ns, imu = self._stamps_ns, self._context.imu
        while stamps_ns and not imu.covers(stamps_ns[0]):
            del stamps_ns[0], self._frames[0]
        while stamps_ns and stamps_ns[0] < stamp_ns - length_ns - _SLACK_NS:
            spanned = len(stamps_ns) > 1 and stamps_ns[1] <= stamp_ns - length_ns
            if not spanned and stamps_ns[0] >= stamp_ns - _LONGEST * length_ns:
                break
            del stamps_ns[0], self._frames[0]
