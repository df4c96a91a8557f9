# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What shows that an estimate is lost: an impossible state, and contradictions over time."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.config import RunConfig
from slam_graph.errors import EstimationError
from slam_graph.geometry import NavState
from slam_graph.kernels.ascending import are_among
from slam_graph.sensors import FeatureFrame

_KNOWN_VELOCITY, _LESS_KNOWN = 0.5, 3.0
"""Standard deviation of a velocity, m/s, and the factor by which it may exceed the one before
samples of the IMU were missing, once there are samples again. Where features have known depths it
is below 0.05 soon, and 2 to 10 where they have none."""
_SAMPLED_FRAMES = 4
"""It is unknown if none of so many frames with samples knows it. GTSAM's smoothers take what a
frame sees with the next one."""
_LONGEST_GAP_S = 0.5
"""A gap between two frames whose features were tested counts as at most this much time."""

_GOOD_SHARE = 0.05
"""Share of the features that is rejected while an estimate is good: some percent."""
_LOOKED_BACK = 3.0
"""Tests are kept for so many further intervals, to find the beginning of a disagreement."""
_BAD_SHARE = 0.9
"""Share of a lost estimate, at most, however large the limit."""
_CORRECTED_S, _FEWEST_CORRECTIONS = 0.5, 5
"""Corrections of the velocity are summed over so long, and over so many."""
_MOST_CORRECTED = 1.2
"""The state is lost if the mean of their squares is larger, in variances of the prediction: it is
at most one if covariances are right. Good runs have up to 0.8 where tracks were broken, and those
that take another velocity over 1.9 or more. It tells where images hardly do, as little is expected
then."""
_BEYOND_EXPECTED = 8.0
"""The sum of the squares must also exceed that which covariances let expect so many times. Good
runs have up to 5, those that take another velocity over 19 or more."""
_FOUND_AGAIN, _BROKEN_NS = 0.5, 1_500_000_000
"""Tracks are broken where fewer of them go on to the next frame; corrections count for so long."""


class DivergenceError(EstimationError):
    """The estimate is beyond what is physically possible, or contradicts the images."""


class JumpError(DivergenceError):
    """The platform is somewhere else, and the IMU has not measured how it came there."""


def check_sane(state: NavState, config: RunConfig) -> None:
    """Refuse a state that cannot be true.

    Raises:
        DivergenceError: naming what is beyond its limit.
    """
    limits = config.limits
    variances = [0.0] * 15 if state.covariance is None else state.covariance.diagonal().tolist()
    pose, velocity = state.world_T_body.matrix().ravel().tolist(), state.velocity.tolist()
    gyro, accel = state.gyro_bias.tolist(), state.accel_bias.tolist()
    if not all(map(math.isfinite, (*pose, *velocity, *gyro, *accel, *variances))):
        raise DivergenceError(f"diverged at frame {state.stamp_ns}: the state is not finite")
    sigma_rad, sigma_m = (math.sqrt(max(*v, 0.0)) for v in (variances[:3], variances[3:6]))
    for what, value, limit in (
        ("speed of {} m/s", math.hypot(*velocity), limits.max_speed),
        ("position sigma of {} m", sigma_m, limits.max_position_sigma_m),
        ("orientation sigma of {} rad", sigma_rad, limits.max_orientation_sigma_rad),
        ("gyroscope bias of {} rad/s", max(map(abs, gyro)), limits.max_gyro_bias),
        ("accelerometer bias of {} m/s²", max(map(abs, accel)), limits.max_accel_bias),
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


class Disagreement:
    """The share of the tested features that is rejected, over the last seconds.

    Only time in which features are tested counts, and a gap between two tests counts little: after
    a pause, such as blank images, an estimate has time to recover.

    Args:
        interval_s: over which the share is taken.
        limit: largest share of an estimate that is not lost.
        what: happened to what was seen, in a message.
    """

    def __init__(self, interval_s: float, limit: float, what: str) -> None:
        self._interval_s, self._limit, self._what = interval_s, limit, what
        self._tests: deque[_Test] = deque()
        self._recent: deque[_Test] = deque()  # those that the share is taken over
        self._tested = self._rejected = 0  # sums over these
        self._tested_s = 0.0
        self._last_ns: int | None = None
        self._earlier_ns: int | None = None  # of the newest test that is not kept any more

    def __len__(self) -> int:
        """How many tests are kept."""
        return len(self._tests)

    def check(self, stamp_ns: int, tested: int, rejected: int) -> None:
        """Add the numbers of features of the next frame that were tested and rejected.

        Raises:
            DivergenceError: if too much was rejected for too long.
        """
        if tested == 0:
            return
        if self._last_ns is not None:
            self._tested_s += min((stamp_ns - self._last_ns) * 1e-9, _LONGEST_GAP_S)
        self._last_ns = stamp_ns
        new = _Test(stamp_ns, self._tested_s, tested, rejected)
        self._tests.append(new)
        self._recent.append(new)
        self._tested += tested
        self._rejected += rejected
        begin_s = self._tested_s - self._interval_s
        while self._tests[0].tested_s < begin_s - _LOOKED_BACK * self._interval_s:
            self._earlier_ns = self._tests.popleft().stamp_ns
        if self._tests[0].tested_s > begin_s:
            return
        self._forget_recent(begin_s)
        share = self._rejected / self._tested
        if share > self._limit:
            raise DivergenceError(
                f"diverged at frame {stamp_ns}: images contradict the state, {share:.0%} of "
                f"what was seen in {self._interval_s:g} s {self._what} (the limit is "
                f"{self._limit:.0%})"
            )

    def _forget_recent(self, begin_s: float) -> None:
        """Forget the tests before the one that was under way at a time.

        Args:
            begin_s: seconds in which features were tested, since the first test.
        """
        recent = self._recent
        while len(recent) > 1 and recent[1].tested_s <= begin_s:
            old = recent.popleft()
            self._tested -= old.tested
            self._rejected -= old.rejected

    def untested(self, stamp_ns: int) -> None:
        """Note a frame before the first test: nothing is held against it."""
        if not self._tests:
            self._earlier_ns = stamp_ns

    def agreed_until(self) -> int | None:
        """Time of the last frame before the images contradicted the state; None if they always did.

        The most likely time at which the share of rejected features changed from that of a good
        state to one beyond the limit (a maximum of cumulated log-likelihood ratios: Page 1954).
        """
        good, bad = _GOOD_SHARE, min(self._limit, _BAD_SHARE)
        kept, lost = np.log((1.0 - bad) / (1.0 - good)), np.log(bad / good)
        tests = list(self._tests)
        ratio, highest, first = 0.0, 0.0, len(tests)
        for k in reversed(range(len(tests))):
            rejected = tests[k].rejected
            ratio += rejected * lost + (tests[k].tested - rejected) * kept
            if ratio >= highest:
                highest, first = ratio, k
        return tests[first - 1].stamp_ns if first else self._earlier_ns


class Corrections:
    """Corrections of the velocity against what the IMU allows, where tracks were broken.

    After a jump that no track outlives, the images may show another velocity, with which every new
    feature agrees. An estimator takes it over in small steps, each of them against the IMU. As long
    as tracks go on they tell more: they show a wrong clock as well, which a start need not cure.
    """

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float, float]] = deque()
        self._ids: IntArray = np.zeros(0, np.int64)
        self._broken_ns: int | None = None
        self._agreed_ns: int | None = None

    def __len__(self) -> int:
        """How many corrections contradict the state; none as long as it was not lost by them."""
        return 0 if self._agreed_ns is None else len(self._recent)

    def note(self, frame: FeatureFrame) -> None:
        """Note whether the tracks of the frame before go on in this one."""
        ids = np.array(frame.ids, np.int64)  # as a kernel takes them, whatever a front end gives
        if not len(ids):
            return
        again = np.count_nonzero(are_among(self._ids, ids))
        if again < _FOUND_AGAIN * len(self._ids):
            self._broken_ns = frame.stamp_ns
        self._ids = ids

    def check(self, stamp_ns: int, square: float, expected: float) -> None:
        """Add the correction of the next step.

        After a pause, as at a standstill, earlier ones do not count.

        Args:
            stamp_ns: time of the frame.
            square: of the correction, in variances of the prediction.
            expected: its mean if covariances are right.

        Raises:
            DivergenceError: if velocities were corrected by too much.
        """
        recent, begin_ns = self._recent, stamp_ns - round(_CORRECTED_S * 1e9)
        if recent and recent[-1][0] < begin_ns:
            recent.clear()
        recent.append((stamp_ns, square, expected))
        while len(recent) > _FEWEST_CORRECTIONS and recent[1][0] <= begin_ns:
            recent.popleft()
        if len(recent) < _FEWEST_CORRECTIONS or recent[0][0] > begin_ns:
            return
        squares = sum(square for _, square, _ in recent)
        usual = sum(expected for _, _, expected in recent)
        mean = squares / len(recent)
        broken = self._broken_ns is not None and stamp_ns <= self._broken_ns + _BROKEN_NS
        if broken and mean > _MOST_CORRECTED and squares > _BEYOND_EXPECTED * usual:
            self._agreed_ns = recent[0][0]
            raise DivergenceError(
                f"diverged at frame {stamp_ns}: no track went on, and new ones contradict the IMU: "
                f"velocities were corrected by {math.sqrt(mean):.1f} standard deviations for "
                f"{_CORRECTED_S:g} s"
            )

    def agreed_until(self) -> int | None:
        """Time of the first of the steps that corrected the velocity by too much; None without."""
        return self._agreed_ns


class Bridging:
    """Whether the velocity is known again after an IMU dropout that images alone had to bridge.

    A camera whose features have no known depth, as at a take-off, does not constrain it. The
    estimator then becomes more certain with every step of a velocity that is arbitrary.
    """

    def __init__(self) -> None:
        self._last: NavState | None = None
        self._before: NavState | None = None  # the last one before samples were missing
        self._sampled = 0
        self._agreed_ns: int | None = None

    def __len__(self) -> int:
        """One if the velocity was found unknown."""
        return 0 if self._agreed_ns is None else 1

    def check(self, state: NavState, missed: bool) -> None:
        """Add the next state.

        Args:
            state: with its covariance.
            missed: whether samples were missing since the state before.

        Raises:
            DivergenceError: if there are samples again, and the velocity is not known.
        """
        if state.covariance is None:
            return
        if missed:
            self._before = self._last if self._before is None else self._before
            self._sampled = 0
        self._last = state
        if missed or self._before is None:
            return
        sigma = _velocity_sigma(state)
        self._sampled += 1
        if sigma <= max(_KNOWN_VELOCITY, _LESS_KNOWN * _velocity_sigma(self._before)):
            self._before = None
        elif self._sampled >= _SAMPLED_FRAMES:
            self._agreed_ns = self._before.stamp_ns
            raise DivergenceError(
                f"lost at frame {state.stamp_ns}: IMU samples were missing, and images do not tell "
                f"the velocity (σ of {sigma:.2g} m/s)"
            )

    def agreed_until(self) -> int | None:
        """Time of the last state before samples were missing; None without."""
        return self._agreed_ns


def _velocity_sigma(state: NavState) -> float:
    """Largest standard deviation of the velocity along any axis, m/s."""
    assert state.covariance is not None, "only such states are kept"
    return math.sqrt(float(np.linalg.eigvalsh(state.covariance[6:9, 6:9])[-1]))
