# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The estimator: IMU samples and feature frames in, states out, whichever engine solves for them.

It checks the input, detects standstill and finds the first state. From then on every frame is one
step of its engine: this package's own loop (`engine.py`) or one of GTSAM's smoothers
(`gtsam_smoothers/`). See docs/engine.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import ClassVar, TypeAlias

import numpy as np

from slam_graph.arrays import IntArray, ascending_union
from slam_graph.backend.aiding.aiding_factors import Aiding
from slam_graph.backend.aiding.regauging import regauged
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.calibrated_projection import CalibratedProjection
from slam_graph.backend.cost.feature_tracks import Outcome
from slam_graph.backend.cost.imu_factor import Propagation
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.zero_velocity import StandstillDetector
from slam_graph.backend.depth_camera import with_depth_camera, with_depth_observed
from slam_graph.backend.dynamics import Dynamics
from slam_graph.backend.engine import SquareRootEngine
from slam_graph.backend.engine_protocol import Engine, EngineContext, StepReport
from slam_graph.backend.estimator_knowledge import EstimatorKnowledge
from slam_graph.backend.gtsam_smoothers.smoother_engine import SmootherEngine
from slam_graph.backend.initialization import clock_change
from slam_graph.backend.initialization.first_state import start_from
from slam_graph.backend.initialization.start_calibration import FoundCalibration, StartCalibration
from slam_graph.backend.initialization.start_up import StartUp
from slam_graph.backend.online_calibration import MAX_EARLY_NS, CalibrationVariables
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.backend.rigid_motion_watch import RigidMotionWatch
from slam_graph.backend.solve.single_thread import SingleThread
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData, Rig

_HISTORY_NS, _MAX_AHEAD_NS = 10_000_000_000, 10_000_000_000
"""How long IMU samples are kept, and how much later than the last sample a frame may be."""
_ROUNDS, _REPEATED_S = 3, 1e-3
"""Most beginnings with a corrected time offset; another is made if its estimate moved by more."""


class Estimator(EstimatorKnowledge):
    """A visual-inertial estimator under the policies of one algorithm.

    Feed it IMU samples and feature frames in the order of time; every frame gives the state then.

    Attributes:
        window: the variables and what is known of them; None as long as there is no state.
        rig: the sensors, as calibrated or corrected at the start.
        replayed: the states that supersede all before, if the last frame led to a new beginning.
        states: all that the last frame led to: one, none, or several where frames have waited.
        solved_ns: stamp of the last frame that was taken, on the clock of the cameras.
        report: what is known of the last step besides the state.
        aiding: takes position fixes and odometry up to the next frame.
        clock_changes: those that are corrected in the IMU samples.
        LEAD_NS: a given state may be so much older than the first frame: the IMU reaches so far.
    """

    ClockChanges: TypeAlias = clock_change.ClockChanges
    LEAD_NS: ClassVar[int] = 1_000_000_000

    def __init__(
        self,
        rig: Rig,
        algorithm: AlgorithmConfig,
        config: BackendConfig | None = None,
        diagnostics: Diagnostics | None = None,
    ) -> None:
        """Choose the engine and wait for input.

        Args:
            rig: calibrated sensors.
            algorithm: its policies; `engine` says what solves the problem.
            config: settings that do not depend on the algorithm.
            diagnostics: counts warnings.

        Raises:
            ConfigError: if the engine cannot do what the settings ask for.
        """
        config, self.diagnostics = config or BackendConfig(), diagnostics or Diagnostics()
        self._real_rig = rig
        self.clock_change: clock_change.ClockChange | None = None
        self.clock_changes = clock_change.ClockChanges()
        dynamics = self._dynamics = Dynamics.of(with_depth_camera(rig), algorithm, config)
        rig, algorithm, config = dynamics.rig, dynamics.algorithm, dynamics.config
        own = algorithm.engine == "square_root"
        make: Callable[[EngineContext], Engine] = SquareRootEngine if own else SmootherEngine
        self._make_engine = make
        self._check = StartCalibration(rig, config)
        self.aiding = Aiding(config, rig.has_imu, own, rig.scaled_camera)
        self._given: NavState | None = None
        self._before: NavState | None = None
        self._held: deque[FeatureFrame] | None = None
        self._measured, self._corrected = True, False
        self._output_ns = self.solved_ns = np.iinfo(np.int64).min
        self.report, self._single_thread, self.times_ns = StepReport(), SingleThread(), {}
        self.rig, self.algorithm, self.config = rig, algorithm, config
        self._variables, self._start_mode = config.calibration, config.initialization.mode
        self.replayed: list[NavState] | None = None
        self.states: list[NavState] = []
        self._motions = RigidMotionWatch(rig, config, self.diagnostics)
        self._begin(ImuBuffer())

    def _begin(self, imu: ImuBuffer) -> None:
        """Begin without a state, with the rig and the settings as they are now."""
        rig, config, diagnostics = self.rig, self.config, self.diagnostics
        calibration = CalibrationVariables(rig, self._variables)
        projection = CalibratedProjection(calibration) if calibration.keys else RigProjection(rig)
        propagation = Propagation(rig.imu, config, diagnostics, guesses=not rig.has_imu)
        context = EngineContext(
            rig, self.algorithm, config, diagnostics, calibration, projection, propagation, imu
        )
        self._context, self._engine = context, self._make_engine(context)
        self._start_up = StartUp(context, self._start_mode, self._before, self._measured)
        propagation.aiding = self.aiding
        self.aiding.restart()
        self._standstill = StandstillDetector(config.zero_velocity)
        self._latest_ns, self.window = np.iinfo(np.int64).min, None

    # --- input -----------------------------------------------------------------------------------

    def start(self, state: NavState, with_rate: bool = False) -> None:
        """Begin from a known state.

        Args:
            state: with its covariance.
            with_rate: whether its gyroscope bias stands for the angular rate, without an IMU.

        Raises:
            EstimationError: if the state has no covariance.
        """
        if state.covariance is None:
            raise EstimationError("a start state needs a covariance")
        state = self._given = state if with_rate else self._dynamics.given(state)
        self._context.propagation.restart()
        self.window = start_from(state, self.config, self._context.calibration)
        self._start_up.begin_with(state, self.window)
        self._engine = self._make_engine(self._context)  # nothing is left of an earlier start
        self.aiding.restart()

    def begin_segment(self, before: NavState | None, measured: bool = True) -> None:
        """Forget the state, which is lost, and start again with the frames that follow.

        After a change of the clock, samples since then are put on the old clock, and the frames
        since then are taken again; `states` has what they led to.

        Args:
            before: the last good state; the new start is put where the IMU predicts it from there.
            measured: whether the IMU has measured what happened since.
        """
        self._given, self._start_mode = None, "auto"
        self._before, self._measured = before, measured
        change, self.clock_change = self.clock_change, None
        held, imu = self._held or (), self._context.imu
        frames = [] if change is None else [*change.after(self._check.recent), *held]
        self._check.forget()
        self._motions.forget()
        if change is not None:
            self.clock_changes = self.clock_changes.and_then(change)
            imu.data = change.corrected(imu.data)
        if change is not None or self._held is not None:
            self._held = deque(frames)
        self.states, self.replayed, self.report = [], None, StepReport()
        with self._single_thread.held():
            self._begin(imu)
            if frames:
                self.states = self._take_held()

    def add_imu(self, imu: ImuData) -> None:
        """Add IMU samples that follow those already given; others are counted and left out."""
        if not self.rig.has_imu:  # they mean nothing
            return
        if left_out := self._context.imu.add(self.clock_changes.corrected(imu)):
            message = f"{left_out} IMU samples are not finite or not in order"
            self.diagnostics.warn("imu_rejected", message)

    def add_motion(self, known: ImuData) -> None:
        """Add what is known of the motion without an IMU: an ideal one's samples, no gravity."""
        self._context.imu.add(known)

    def assume_pixel_noise(self, sigma_px: float) -> None:
        """Take observations for so noisy, unless that is estimated; GTSAM's smoothers ignore it."""
        self._context.pixels.assume(sigma_px)

    def add_frame(self, frame: FeatureFrame) -> NavState | None:
        """Take the features of one time and estimate the state then.

        In the first motion the time offset of the cameras is compared with the gyroscope. If it
        contradicts the calibration, the estimator begins anew with the frames of the last seconds.
        From then on, and after a change of the clock, a frame waits until the IMU has reached it.

        Returns:
            The causal estimate with its covariance, stamped on the clock of the IMU; of an earlier
            frame where that one has waited (`states` has all). None as long as there is no state,
            for a frame that does not follow those before, and for one that waits.
        """
        with self._single_thread.held():
            self.replayed = self.clock_change = None
            self.report, self.times_ns = StepReport(), {}
            if self._held is None:
                state = self._take(frame)
                if self.replayed is None:
                    self.states = [] if state is None else [state]
                return state
            self._held.append(frame)
            self.states = self._take_held()
            return self._new(self.states)

    def finish(self) -> list[NavState]:
        """States at frames that still wait, when no more IMU samples come; in `states` too."""
        with self._single_thread.held():
            self.replayed, self.clock_change, self.times_ns = None, None, {}
            self.states = self._take_held(MAX_EARLY_NS)
            return self.states

    def _take(self, frame: FeatureFrame) -> NavState | None:
        """The state at a frame; all of them anew once fixes tell where their world is."""
        state = self._solve(frame)
        if state is not None and self._moves_since_start(state):
            return self._without_what_moves()
        found = None if self.window is None else self.aiding.alignment(state)
        if self.window is None or found is None:
            return state if self.window is None else self._moved_by_fixes(self.window, state)
        self.window = regauged(self.window, found, *self.aiding.variables_found(found))
        self._engine = self._make_engine(self._context)
        self._context.propagation.restart()
        self._start_up.settle()
        self.replayed = self.states = self.aiding.settle(found)
        return self.replayed[-1]

    def _solve(self, frame: FeatureFrame) -> NavState | None:
        """Estimate the state at a frame."""
        self.report, self.solved_ns = StepReport(), frame.stamp_ns
        imu, calibration = self._context.imu, self._context.calibration
        self._dynamics.extend(imu, frame.stamp_ns + round(self.rig.end_offset_s * 1e9))
        state = None if self.window is None else self.window.state
        stamp_ns = calibration.stamp(frame.stamp_ns, state, imu)
        if not self._latest_ns < stamp_ns <= imu.newest_ns() + _MAX_AHEAD_NS:
            message = f"frame at {frame.stamp_ns} ns does not follow the frames and the IMU"
            self.diagnostics.warn("frame_out_of_order", message)
            return None
        self._latest_ns = self.times_ns[frame.stamp_ns] = stamp_ns
        self._motions.keep(frame)
        imu.forget_before(self._check.needed_since_ns(stamp_ns) - _HISTORY_NS)
        frame = with_depth_observed(frame, self._real_rig)
        frame, bad = frame.usable(len(self.rig.cameras))
        if bad:
            self.diagnostics.warn("feature_not_finite", f"{bad} of them at {frame.stamp_ns} ns")
        found = self._check.add(frame, imu, self.window is not None, self._standstill.dynamic)
        if isinstance(found, FoundCalibration):
            return self._begin_anew(found)
        self.clock_change = found or self.clock_change
        self._context.propagation.noise.watch_vibration(imu, stamp_ns)
        still_sigma = self._standstill.add_frame(imu, stamp_ns, frame)
        whole, frame = frame, self._motions.used(frame).without(self._standstill.dynamic)
        if self.window is None:
            self.window = self._try_to_start(stamp_ns, frame)
        elif stamp_ns > self.window.stamp_ns:
            stepped = self._engine.step(self.window, stamp_ns, frame, still_sigma, self.report)
            solved = self._dynamics.reported(stepped)
            return self._reviewed(whole, solved, still_sigma is not None)
        elif stamp_ns == self.window.stamp_ns:
            self._context.add_observations(self.window, frame)
            self._context.note(frame)
        if self.window is None or stamp_ns < self.window.stamp_ns:
            return None
        return self._dynamics.reported(self.window.current(self.window.prior))

    def _moves_since_start(self, state: NavState) -> bool:
        """Whether the last frame shows that something has moved since the start; it is left out."""
        motions, window = self._motions, self.window
        if not motions.wanted or window is None:
            return False
        again = motions.compare(state, self.motion, self.assumed_noise_px)
        window.tracks.remove(Outcome.DYNAMIC, motions.moving_now)
        return again

    def _without_what_moves(self) -> NavState | None:
        """The last state of an estimate that begins again without what moves."""
        given, frames, states = self._given, self._motions.begin_again(), list[NavState]()
        self._begin(self._context.imu)
        if given is not None:
            self.start(given, with_rate=True)
        for frame in frames:
            states = self._with_next(states, frame)
        self.states = self.replayed = states
        return states[-1] if states else None

    def _with_next(self, states: list[NavState], frame: FeatureFrame) -> list[NavState]:
        """States with that at the next frame, or those that supersede all before."""
        superseded, state = self.replayed, self._take(frame)
        if self.replayed is not superseded:
            return list(self.replayed or ())
        return states if state is None else [*states, state]

    def _begin_anew(self, found: FoundCalibration) -> NavState | None:
        """Start again with another calibration, from the frames of the last seconds."""
        self.diagnostics.warn("calibration_corrected", found.message)
        self.rig, self._corrected = found.rig, True
        if self.algorithm.engine == "square_root":  # GTSAM's smoothers take it as it is
            self._variables = found.variables
        given, frames = self._given, [*self._check.recent, *(self._held or ())]
        if given is not None and given.stamp_ns < frames[0].stamp_ns - self.LEAD_NS:
            # the IMU alone would have to lead from there to here
            given, self._given, self._start_mode = None, None, "auto"
        if self.window is not None:
            self._output_ns = self.window.stamp_ns
        for rounds_left in reversed(range(_ROUNDS)):
            self._check.forget()
            self._begin(self._context.imu)
            if given is not None:
                self.start(given)
            self._held = deque(frames)
            states = self._take_held()
            better = self.calibration
            if not rounds_left or better is None:
                break
            change_s = better.rig.cameras[0].time_offset_s - self.rig.cameras[0].time_offset_s
            if abs(change_s) <= _REPEATED_S:
                break
            # the first linearisation points were those of an offset some milliseconds off
            self.rig = better.rig
        self.states = self.replayed = states
        return self._new(states)

    def _new(self, states: list[NavState]) -> NavState | None:
        """The last of some states if it is later than those before."""
        if not states or states[-1].stamp_ns <= self._output_ns:
            return None
        self._output_ns = states[-1].stamp_ns
        return states[-1]

    def _take_held(self, early_ns: int = 0) -> list[NavState]:
        """States at the frames whose time the IMU has reached, or will within `early_ns`."""
        states: list[NavState] = []
        while self._held:
            offset_ns = round(self.rig_now.cameras[0].clock_offset_s * 1e9)
            if self._held[0].stamp_ns + offset_ns > self._context.imu.newest_ns() + early_ns:
                break
            states = self._with_next(states, self._held.popleft())
        if self.replayed is not None:
            self.replayed = states
        return states

    def _try_to_start(self, stamp_ns: int, frame: FeatureFrame) -> Window | None:
        """The first window, if this frame makes a start possible."""
        if not self._check.mounted:
            return None
        with self.report.timed("start"):
            window = self._start_up.try_to_start(stamp_ns, frame)
        if window is not None:
            self._standstill.add_dynamic(self._start_up.outliers)
            self._context.note(frame)
        return window

    def _reviewed(self, frame: FeatureFrame, state: NavState, still: bool) -> NavState:
        """The state, or that of a new window if what followed the start leads to one."""
        if not self._start_up.doubtful:
            return state
        # they move, all but those that did not fit the start: it may be what was wrong
        known = np.setdiff1d(self._standstill.dynamic, self._start_up.outliers)
        with self.report.timed("start"):
            window = self._start_up.better(frame, self._standstill.dynamic, state, still)
        if window is None:
            return state
        self._standstill.dynamic = ascending_union(known, self._start_up.outliers)
        self.window, self._engine = window, self._make_engine(self._context)
        self._context.propagation.restart()
        state = window.current(window.prior)
        if self._start_up.contradicted:
            self.aiding.restart()
            self.replayed = self.states = [state]
        return state

    def _moved_by_fixes(self, window: Window, state: NavState | None) -> NavState | None:
        """The state, moved with its world as far as fixes ask for it and the steps did not."""
        if state is None or not self.aiding.aligned:
            return state
        level, measured = self.rig.has_imu, self.aiding.measured
        self.window, motion = self._engine.regauged(window, level, measured)
        return state if motion is None else self.aiding.in_moved_world(state, motion)

    def exclude(self, ids: IntArray) -> None:
        """Do not use features (N,) any more: they move. What is in the prior of them stays."""
        self._standstill.add_dynamic(ids)
        if self.window is not None and len(ids):
            self.window.tracks.remove(Outcome.DYNAMIC, ids)
