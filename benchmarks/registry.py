# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""All benchmarks by name, in the order in which they run. A new suite is a module and a line here.

A module offers `BENCHMARKS`, a table of `Benchmark` by name.
"""

from __future__ import annotations

from benchmarks import (
    bal,
    car,
    consistency_real,
    cost_over_time,
    elimination,
    faults,
    final_ba,
    frontend,
    growth,
    held_out,
    kernels,
    loop_closure,
    maps,
    memory,
    mh01,
    mono_real_imu,
    monte_carlo,
    moving_object,
    moving_static,
    objects,
    openvins_sim,
    openvins_sim_seeds,
    peers,
    policy_product,
    posegraphs,
    real_imu,
    rolling_shutter,
    speed,
    starts,
    stream_rates,
    time_offset,
    verdict,
    wheel,
    wide_lenses,
)
from benchmarks.suite import Benchmark

BENCHMARKS: dict[str, Benchmark] = {
    **held_out.BENCHMARKS,  # first: it says most, and is the longest of the quick ones
    **wheel.BENCHMARKS,
    **mh01.BENCHMARKS,
    **openvins_sim.BENCHMARKS,
    **openvins_sim_seeds.BENCHMARKS,
    **monte_carlo.BENCHMARKS,
    **policy_product.BENCHMARKS,
    **moving_object.BENCHMARKS,
    **objects.BENCHMARKS,
    **moving_static.BENCHMARKS,
    **real_imu.BENCHMARKS,
    **mono_real_imu.BENCHMARKS,
    **consistency_real.BENCHMARKS,
    **car.BENCHMARKS,
    **starts.BENCHMARKS,
    **stream_rates.BENCHMARKS,
    **rolling_shutter.BENCHMARKS,
    **time_offset.BENCHMARKS,
    **wide_lenses.BENCHMARKS,
    **faults.BENCHMARKS,
    **verdict.BENCHMARKS,
    **final_ba.BENCHMARKS,
    **cost_over_time.BENCHMARKS,
    **growth.BENCHMARKS,
    **memory.BENCHMARKS,
    **frontend.BENCHMARKS,
    **speed.BENCHMARKS,
    **peers.BENCHMARKS,
    **kernels.BENCHMARKS,
    **elimination.BENCHMARKS,
    **posegraphs.BENCHMARKS,
    **bal.BENCHMARKS,
    **loop_closure.BENCHMARKS,
    **maps.BENCHMARKS,
}
