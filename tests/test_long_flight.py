# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Five minutes of simulated stereo, final adjustment and files included: nothing grows.

The flight is that of the benchmarks `growth` and `long_run`, in a process of its own
(`benchmarks.growth_worker`). Memory is compared as `long_run` does: what is resident in the last
tenth of the flight over that in the second. Times are no test: the time of a frame is printed, in
flows that are timed between the frames, and what is tested is the work of a frame, the poses and
features in the state, in the parts and under the bar of `growth`.
"""

import numpy as np
import pytest

from benchmarks import growth
from benchmarks.long_run import MEMORY_BAR
from benchmarks.speed import worker

pytestmark = pytest.mark.slow

FLIGHT_S = 300.0

KEPT_KB = 3.6
"""What may be kept of a frame, kB: states, covariances and logs. Half as much again as measured, of
which a part is the allocator's; `long_run` measures less in hours."""

ADJUSTMENT_MB = 700.0
"""What the final adjustment and the files may take beside the flight: half as much again as
measured. It grows with a recording of minutes; that it does not with one of hours is measured by
`long_run`."""


def test_memory_and_work_of_a_frame_are_flat(capsys: pytest.CaptureFixture[str]) -> None:
    table = worker("benchmarks.growth_worker", "msckf", f"{FLIGHT_S:g}", "complete")
    frames = len(table["frame"])
    parts = [float(np.median(part)) for part in np.array_split(table["memory"], growth.PARTS)]
    kept_kb = 1024.0 * (parts[-1] - parts[1]) / (0.8 * frames)
    mean_of = {
        name: [float(np.mean(part)) for part in np.array_split(table[name], growth.PARTS)]
        for name in ("poses", "features")
    }
    grown = next(one.value for one in growth.figures(table) if one.key == "growth")
    with capsys.disabled():
        print(  # noqa: T201 - figures that no test judges
            f"\nresident memory {parts[1]:.0f} to {parts[-1]:.0f} MB, {kept_kb:.2f} kB a frame, "
            f"peak {table['peak_mb']:.0f} MB; time of a frame "
            f"late over early {grown:.2f}, in the state on average:",
            *(f"{name} {np.round(means, 1).tolist()}" for name, means in mean_of.items()),
        )
    assert frames == 10 * FLIGHT_S + 1
    assert parts[-1] / parts[1] <= MEMORY_BAR
    assert kept_kb <= KEPT_KB
    assert table["peak_mb"] - parts[-1] <= ADJUSTMENT_MB
    for means in mean_of.values():
        early, late = means[growth.EARLY], means[growth.LATE]
        assert min(early) > 0.0
        assert np.median(late) <= growth.FLAT_BAR * np.median(early)
