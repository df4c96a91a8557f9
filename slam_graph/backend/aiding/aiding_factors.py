# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes, known poses and odometry on their way into the cost of each step.

The estimator begins in a world of its own. It waits until the absolute measurements along its path
tell where that world is (`world_alignment.py`), and moves everything there once. From then on each
of them is a factor at the frame that follows it, and of lever arm and clock where these are
variables (`fix_calibration.py`). Odometry is a factor between consecutive frames from the
beginning.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.estimated_path import EstimatedPath, variances_of
from slam_graph.backend.aiding.fix_calibration import (
    FixVariables,
    SeenFixes,
    calibrated_factor,
)
from slam_graph.backend.aiding.fix_factors import (
    Fix,
    FixGate,
    PositionFix,
    fixes_of,
    pose_between,
    pose_key,
)
from slam_graph.backend.aiding.odometry_factors import OdometryFactors
from slam_graph.backend.aiding.world_alignment import WorldAlignment, align_world
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import State
from slam_graph.backend.visual_motion import moved_to
from slam_graph.backend.world_gauge import in_moved_world
from slam_graph.geometry import NavState
from slam_graph.sensors import AidingData

_MOST_FIXES = 300
"""Fixes that are remembered for the alignment."""
_TIMINGS = 3
"""Alignments, each at the times that the one before has found."""
_REVISED_M, _REVISED_NS = 0.01, 1_500_000_000
"""A step that moves the body by more than this (m) through lever arm and clock; images are not
compared with the motion for this long (ns) after it."""
_HISTORY_NS = 5_000_000_000
"""How long states are kept, for fixes that come late."""
_RECEIVED_NS = 10_000_000_000
"""How long what was received is kept, as the samples of the IMU are: frames since then may be taken
again."""


class Aiding:
    """Takes fixes, known poses and odometry, and makes factors of them.

    Args:
        config: settings.
        level: whether gravity is measured.
        calibrates: whether the engine takes lever arm and clock of the fixes as variables, and
            goes on in another unit of length.
        scaled_camera: body_T_camera of a camera whose unit of length is unknown; None for metres.

    Attributes:
        aligned: whether the world is that of the fixes.
        found: how it became that; None before.
        moved: new_T_old of its motions since then.
        used: whether there was anything to take so far.
        measured: whether the last step had a fix.
        gates: of the sources of fixes, by name.
        odometry: of wheels or legs.
        offset_s: time offset: added to the times of position fixes, beyond the given one.
        lever_arm_m: (3,) of the position fixes, body frame.
        variables: lever arm and clock, as far as they are estimated with the states; None if
            neither is.
    """

    def __init__(
        self,
        config: BackendConfig,
        level: bool,
        calibrates: bool = True,
        scaled_camera: gtsam.Pose3 | None = None,
    ) -> None:
        self._config, self._level, self._scaled_camera = config, level, scaled_camera
        self._calibrates, variables = calibrates, FixVariables(config.gnss)
        self.variables = variables if calibrates and variables.keys else None
        self.lever_arm_m = np.array(config.gnss.lever_arm_m)
        self._data = AidingData.empty()  # by the given offsets of time alone
        self.gates: defaultdict[str, FixGate] = defaultdict(FixGate)
        self.odometry = OdometryFactors(config.odometry)
        self.used, self.offset_s, self._offset_sigma_s = False, 0.0, 0.0
        self.measured = False
        self._shifted_s = 0.0  # added to the times of fixes that wait
        self._revised_ns = int(np.iinfo(np.int64).min) // 2  # never
        self.restart()

    @property
    def _has_use(self) -> bool:
        """Whether fixes may tell the world; GTSAM's smoothers cannot go on in another unit."""
        return self.used and (self._calibrates or self._scaled_camera is None)

    @property
    def _held(self) -> FloatArray:
        """Time offset (s) and lever arm (m) as they are now, (4,)."""
        return np.append(self.offset_s, self.lever_arm_m)

    def restart(self) -> None:
        """The estimate begins anew, in another world.

        It may begin with frames that were taken before: what was received of the last seconds waits
        again. What is older than the first state finds no place on its path.
        """
        self.aligned, self.moved = False, gtsam.Pose3()
        self.found: WorldAlignment | None = None
        self._path = EstimatedPath()
        self._shifted_s = self.offset_s
        self._waiting, self._offered = self._shifted(self._data), AidingData.empty()
        self._offered_ns = 0
        self._fixes: list[Fix] = []
        for gate in self.gates.values():
            gate.restart()

    def add(self, data: AidingData) -> None:
        """Take measurements that follow those before; none say that there will be some.

        They come with the frames: until there is a state, what is much older than they are goes.
        """
        self.used = True
        data = self._config.on_the_clock(data)
        if not self._path.states:
            self._forget_before(data)
        self._data = AidingData.concatenate([self._data, data])
        self.odometry.take(self._data)
        self._waiting = AidingData.concatenate([self._waiting, self._shifted(data)])

    def _forget_before(self, data: AidingData) -> None:
        """Forget what no frame will ask for any more when some measurements come."""
        kinds = data.fix_stamps_ns, data.pose_stamps_ns, data.odometry_stamps_ns
        begins_ns = [int(stamps_ns[0]) for stamps_ns in kinds if len(stamps_ns)]
        if begins_ns:
            oldest_ns = min(begins_ns) - _RECEIVED_NS
            self._data = self._data.within(oldest_ns, None)
            self._waiting = self._waiting.within(oldest_ns, None)

    def _shifted(self, data: AidingData) -> AidingData:
        """Measurements with the time offset that those that wait have."""
        return data.shifted(round(self._shifted_s * 1e9))

    # --- factors ---------------------------------------------------------------------------------

    def factors(
        self,
        state: State,
        frames: tuple[int, int],
        stamps_ns: tuple[int, int],
        known: FloatArray | None,
        prior: SquareRootInformation | None = None,
    ) -> list[gtsam.NonlinearFactor]:
        """Factors of what was measured from one frame to the next.

        Args:
            state: with the poses of both, and the velocity at the last frame.
            frames: indices of the last and the new one.
            stamps_ns: their times.
            known: (6, 6) covariance of the new pose as it is predicted; None if it is not known.
            prior: on the variables up to the last frame, if lever arm or clock are among them.
        """
        self._data = self._data.within(stamps_ns[0] - _RECEIVED_NS, None)
        self.odometry.take(self._data)
        first, last = (state.frames.atPose3(pose_key(i)) for i in frames)
        speed = float(np.linalg.norm(state.frames.atVector(V(frames[0]))))
        factors, self.measured = self.odometry.factors(frames, stamps_ns, speed), False
        if not self.aligned:
            return factors
        unknown = self._follow(state, prior)
        judged: list[tuple[Fix, Fix, SeenFixes | None, float]] = []
        for fix in self._due(stamps_ns):
            share = (fix.stamp_ns - stamps_ns[0]) / (stamps_ns[1] - stamps_ns[0])
            then = (
                pose_between(first, last, share) if share > 0.0 else self._path.pose(fix.stamp_ns)
            )
            if then is None:
                continue
            here, seen = fix.moved(then, last), None
            if unknown is not None and isinstance(fix, PositionFix) and fix.is_timed:
                seen = self._seen(fix, share, then, (first, last), stamps_ns)
                here = self._of_unsure_sensor(here, seen, last, unknown)
            else:
                here = self._of_unsure_time(here, (first, last), stamps_ns)
            weight = 1.0 if known is None else self.gates[fix.source].weight(here, last, known)
            judged.append((fix, here, seen, weight))
        wrong = {fix.stamp_ns for fix, *_, weight in judged if fix.is_of_pose and weight == 0.0}
        key = pose_key(frames[1])
        for fix, here, seen, weight in judged:
            # a tag that is taken for another one is wrong in position and orientation
            if weight == 0.0 or (fix.is_of_pose and fix.stamp_ns in wrong):
                continue
            self.measured = True
            if seen is None or self.variables is None:
                factors.append(here.factor(key, weight))
            else:
                noise, held = fix.covariance / weight, self._held
                factors.append(calibrated_factor(key, seen, noise, self.variables, held))
        return factors

    def _follow(self, state: State, prior: SquareRootInformation | None) -> FloatArray | None:
        """Take over lever arm and clock from the state.

        Returns:
            The covariance (n, n) of those that are variables; None if none are.
        """
        variables = self.variables
        if variables is None or prior is None:
            return None
        found = variables.in_values(state.frames, self._held)
        if self._path.states:
            last = self._path.states[-1]
            change_s = abs(float(found[0]) - self.offset_s)
            change_m = float(np.linalg.norm(found[1:] - self.lever_arm_m))
            if change_m + change_s * float(np.linalg.norm(last.velocity)) > _REVISED_M:
                self._revised_ns = last.stamp_ns
        self.offset_s, self.lever_arm_m = float(found[0]), found[1:]
        return prior.covariance_of(variables.keys)

    def in_moved_world(self, state: NavState, motion: gtsam.Pose3) -> NavState:
        """The last state where fixes have moved it with its world, and the path before it as well.

        Args:
            state: the last one.
            motion: new_T_old of the worlds.
        """
        self._path.states = in_moved_world(self._path.states, motion)
        self.moved = motion.compose(self.moved)
        self._revised_ns = state.stamp_ns
        return in_moved_world([state], motion)[0]

    def was_revised(self, stamp_ns: int) -> bool:
        """Whether world, lever arm or clock were corrected so much lately that the body jumped."""
        return stamp_ns - self._revised_ns < _REVISED_NS

    def calibration(
        self, state: State, information: SquareRootInformation
    ) -> AidingData.Calibration | None:
        """Lever arm and clock now; None if they are no variables.

        Args:
            state: after a step.
            information: about an increment of the estimates.
        """
        variables = self.variables
        if variables is None or not self.aligned:
            return None
        covariance = self._follow(state, information)
        assert covariance is not None
        return variables.calibration(self._held, covariance)

    def _seen(
        self,
        fix: PositionFix,
        share: float,
        then: gtsam.Pose3,
        poses: tuple[gtsam.Pose3, gtsam.Pose3],
        stamps_ns: tuple[int, int],
    ) -> SeenFixes:
        """A fix as it is seen from the last of two poses, between which or before which it was."""
        first, last = poses
        if share > 0.0:
            velocity = fix.velocity(first, last, (stamps_ns[1] - stamps_ns[0]) * 1e-9)
        else:
            velocity = self._path.velocity(fix)
        return SeenFixes.of([fix], [(then, last)], velocity, self.offset_s)

    def _of_unsure_sensor(
        self, fix: Fix, seen: SeenFixes, pose: gtsam.Pose3, unknown: FloatArray
    ) -> Fix:
        """A fix with the noise that its lever arm and clock add, for the gate."""
        assert self.variables is not None
        R = pose.rotation().matrix()[None]
        J = seen.jacobians(R, self._held)[1][0]
        J = J[:, self.variables.columns]
        return replace(fix, covariance=fix.covariance + J @ unknown @ J.T)

    def _due(self, stamps_ns: tuple[int, int]) -> list[Fix]:
        """The fixes up to a new frame that no frame up to the last one has taken.

        GTSAM's smoothers predict frames that they do not keep: what was due for one is due again.
        """
        later_ns = round((self.offset_s - self._shifted_s) * 1e9)
        since_ns, stamp_ns = stamps_ns
        if self._offered_ns > since_ns:
            self._waiting = AidingData.concatenate([self._offered, self._waiting])
        waiting = self._waiting.shifted(later_ns)
        self._offered = waiting.within(None, stamp_ns).shifted(-later_ns)
        self._offered_ns = stamp_ns
        self._waiting = waiting.within(stamp_ns, None).shifted(-later_ns)
        return fixes_of(self._offered.shifted(later_ns), self._config, self.lever_arm_m)

    def _of_unsure_time(
        self, fix: Fix, poses: tuple[gtsam.Pose3, gtsam.Pose3], stamps_ns: tuple[int, int]
    ) -> Fix:
        """A fix with the noise that an offset of its clock which is not known well adds."""
        if not isinstance(fix, PositionFix) or not fix.is_timed or self._offset_sigma_s == 0.0:
            return fix
        velocity = fix.velocity(*poses, (stamps_ns[1] - stamps_ns[0]) * 1e-9)
        along = self._offset_sigma_s * velocity
        return replace(fix, covariance=fix.covariance + np.outer(along, along))

    def by_odometry(self, before: NavState, predicted: NavState) -> NavState | None:
        """A predicted state where the odometry has it; None without odometry of this time.

        Args:
            before: the last state.
            predicted: the new one, by constant velocity.
        """
        moved = self.odometry.between(before.stamp_ns, predicted.stamp_ns)
        if moved is None:
            return None
        motion = gtsam.Pose3(gtsam.Rot3.Expmap(moved[0]), moved[1])
        return moved_to(before, predicted, before.world_T_body.compose(motion))

    # --- the world -------------------------------------------------------------------------------

    def alignment(self, state: NavState | None) -> WorldAlignment | None:
        """Note the state of a frame; where its world is, as soon as the fixes tell it.

        Args:
            state: of the newest frame; None without one.
        """
        if state is None or not self._has_use or not self._path.append(state):
            return None
        if self.aligned:  # for fixes that come late
            if state.stamp_ns - self._path.states[0].stamp_ns > 2 * _HISTORY_NS:
                self._path.forget_before(state.stamp_ns - _HISTORY_NS)
            return None
        due = self._due((state.stamp_ns, state.stamp_ns))
        self._fixes = [*self._fixes, *due][-_MOST_FIXES:]
        return self._aligned(state) if due else None

    def _aligned(self, state: NavState) -> WorldAlignment | None:
        """Where the world is, by the fixes so far."""
        sigma_s, offset_s = self._config.gnss.time_offset_sigma_s, 0.0
        now = np.asarray(state.world_T_body.translation())
        found: WorldAlignment | None = None
        for _ in range(_TIMINGS if sigma_s > 0.0 else 1):
            pairs = [self._path.at(fix, round(offset_s * 1e9)) for fix in self._fixes]
            # older fixes tell less of the world: the path has drifted since
            drifted = [pair.after_drift(*variances_of(state)) for pair in pairs if pair is not None]
            expected_s = -self.offset_s - offset_s
            offset = expected_s, sigma_s
            unknown = self._expected_arm(), self._scaled_camera
            found = align_world(drifted, now, self._level, offset, *unknown)
            if found is None:
                return None
            offset_s += found.offset_s
        assert found is not None
        offset_ns = round(offset_s * 1e9)
        timed = [self._path.at(fix, offset_ns) for fix in self._fixes if fix.is_timed]
        if found.is_vague([pair for pair in timed if pair is not None]):
            return None
        return replace(found, offset_s=offset_s)

    def _expected_arm(self) -> tuple[FloatArray, float] | None:
        """What is to be added to the lever arm, with its standard deviation; None if it is held."""
        gnss = self._config.gnss
        if self.variables is None or gnss.lever_arm_sigma_m == 0.0:
            return None
        return np.array(gnss.lever_arm_m) - self.lever_arm_m, gnss.lever_arm_sigma_m

    def settle(self, found: WorldAlignment) -> list[NavState]:
        """Go on in the world of the fixes; all states so far in that world, the newest last."""
        states = found.settled(self._path.states)
        self.aligned, self._fixes, self._path.states = True, [], list(states)
        self.found = found
        self.offset_s, self._offset_sigma_s = self.offset_s + found.offset_s, found.offset_sigma_s
        self.lever_arm_m = self.lever_arm_m + found.arm_m
        self._waiting = self._waiting.shifted(round(found.offset_s * 1e9))
        self._shifted_s += found.offset_s
        return states

    def variables_found(self, found: WorldAlignment) -> tuple[tuple[int, ...], gtsam.Values | None]:
        """Keys and values of lever arm and clock, as far as they become variables."""
        variables = self.variables
        if variables is None:
            return (), None
        values = np.append(self.offset_s + found.offset_s, self.lever_arm_m + found.arm_m)
        return variables.keys, variables.values(values)
