# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The simulated IMU: instantaneous samples of a motion, with white noise and bias random walks.

Continuous-time white noise of density σ (e.g. rad/s/√Hz) sampled at intervals Δt has the standard
deviation σ/√Δt; a bias random walk of density σ_b takes steps of standard deviation σ_b √Δt. Each
block of samples has its own random generator, so samples do not depend on where reading begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.sensors import ImuData, ImuNoise
from slam_graph.simulation.motion import RecordedMotion, SplineMotion
from slam_graph.simulation.simulation_config import SimulatedImuConfig, random_stream

SAMPLES_PER_BLOCK = 2000


class ImuSource(Protocol):
    """An IMU stream with known biases."""

    @property
    def samples(self) -> int:
        """Number of samples."""
        ...

    def blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The samples from `after_ns` on."""
        ...

    def biases(self, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """True biases of gyroscope and accelerometer (N, 3) at increasing times (N,)."""
        ...


@dataclass(frozen=True, eq=False)
class SimulatedImu:
    """The IMU of a platform that moves along a spline.

    Attributes:
        motion: of the body.
        noise: continuous-time densities.
        config: rate, scale of the noise, and the initial biases.
        seed: of the simulation.
    """

    motion: SplineMotion
    noise: ImuNoise
    config: SimulatedImuConfig
    seed: int

    @property
    def rate_hz(self) -> float:
        """Sampling rate."""
        return self.config.rate_hz if self.config.rate_hz is not None else self.noise.rate_hz

    @property
    def samples(self) -> int:
        """Number of samples."""
        duration_s = (self.motion.end_ns - self.motion.start_ns) * 1e-9
        return int(duration_s * self.rate_hz + 1e-6) + 1

    def blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The samples from `after_ns` on."""
        for block, (stamps, gyro_bias, accel_bias) in enumerate(self._walk()):
            if after_ns is not None and stamps[-1] < after_ns:
                continue
            gyro_sigma, accel_sigma = self._white_sigmas()
            rng = np.random.default_rng(random_stream(self.seed, "imu white", block))
            noise = rng.normal(size=(2, SAMPLES_PER_BLOCK, 3))[:, : len(stamps)]
            gyro = self.motion.angular_rates(stamps) + gyro_bias + gyro_sigma * noise[0]
            accel = self.motion.specific_forces(stamps) + accel_bias + accel_sigma * noise[1]
            first = 0 if after_ns is None else int(np.searchsorted(stamps, after_ns))
            yield ImuData(stamps, gyro, accel)[first:]

    def biases(self, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """True biases of gyroscope and accelerometer (N, 3) at increasing times (N,)."""
        found = np.empty((2, len(stamps_ns), 3))
        previous: tuple[IntArray, FloatArray, FloatArray] | None = None
        done = 0
        for block in self._walk():
            # the last sample of the previous block closes the interval between the blocks
            stamps, gyro, accel = block if previous is None else _join(previous, block)
            until = int(np.searchsorted(stamps_ns, stamps[-1], side="right"))
            wanted = slice(done, until)
            seconds, at = (stamps - stamps[0]) * 1e-9, (stamps_ns[wanted] - stamps[0]) * 1e-9
            for row, values in enumerate((gyro, accel)):
                for axis in range(3):
                    found[row, wanted, axis] = np.interp(at, seconds, values[:, axis])
            previous, done = (stamps[-1:], gyro[-1:], accel[-1:]), until
        assert previous is not None
        found[0, done:], found[1, done:] = previous[1], previous[2]
        return found[0], found[1]

    def _walk(self) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Times (N,) and biases (N, 3) of gyroscope and accelerometer, in blocks."""
        start = np.random.default_rng(random_stream(self.seed, "imu bias"))
        sigmas = np.array([[self.config.gyro_bias_sigma], [self.config.accel_bias_sigma]])
        bias = start.normal(size=(2, 3)) * sigmas
        densities = np.array([self.noise.gyro_random_walk, self.noise.accel_random_walk])
        step = self.config.noise_scale * densities / np.sqrt(self.rate_hz)
        for block, first in enumerate(range(0, self.samples, SAMPLES_PER_BLOCK)):
            index = np.arange(first, min(first + SAMPLES_PER_BLOCK, self.samples))
            stamps = self.motion.start_ns + np.round(index * (1e9 / self.rate_hz)).astype(np.int64)
            rng = np.random.default_rng(random_stream(self.seed, "imu walk", block))
            steps = rng.normal(size=(2, SAMPLES_PER_BLOCK, 3)) * step[:, None, None]
            walks = bias[:, None, :] + np.cumsum(steps, axis=1)
            biases = np.concatenate([bias[:, None, :], walks[:, :-1]], axis=1)[:, : len(index)]
            yield stamps, biases[0], biases[1]
            bias = walks[:, -1]

    def _white_sigmas(self) -> tuple[float, float]:
        root = self.config.noise_scale * float(np.sqrt(self.rate_hz))
        return root * self.noise.gyro_noise_density, root * self.noise.accel_noise_density


def _join(
    previous: tuple[IntArray, FloatArray, FloatArray],
    block: tuple[IntArray, FloatArray, FloatArray],
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    return (
        np.concatenate([previous[0], block[0]]),
        np.concatenate([previous[1], block[1]]),
        np.concatenate([previous[2], block[2]]),
    )


@dataclass(frozen=True, eq=False)
class RecordedImu:
    """The recorded IMU of a real flight; its true biases are those of the ground truth.

    Attributes:
        data: the samples of the flight.
        motion: the recorded motion; biases are taken as zero where the recording has none.
    """

    data: ImuData
    motion: RecordedMotion

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.data)

    def blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The samples from `after_ns` on."""
        begin = 0 if after_ns is None else int(np.searchsorted(self.data.stamps_ns, after_ns))
        for first in range(begin, len(self.data), SAMPLES_PER_BLOCK):
            yield self.data[first : min(first + SAMPLES_PER_BLOCK, len(self.data))]

    def biases(self, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Biases of gyroscope and accelerometer (N, 3) at times (N,) within the motion."""
        truth = self.motion.at(stamps_ns)
        zero = np.zeros((len(stamps_ns), 3))
        gyro = zero if truth.gyro_biases is None else truth.gyro_biases
        return gyro, zero if truth.accel_biases is None else truth.accel_biases
