# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a recording? Findings about sensors, calibration, clocks and images.

import slam_graph as sg
from slam_graph.diagnosis import Diagnosis

for finding in Diagnosis.of(sg.open_dataset("demo")).faults:
    print(finding.what, finding.fix)
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = ["ClockWindow", "Diagnosis", "Finding", "clock_change"]

if TYPE_CHECKING:
    from slam_graph.diagnosis.clock_windows import ClockWindow, clock_change
    from slam_graph.diagnosis.diagnose import Diagnosis
    from slam_graph.diagnosis.finding import Finding
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "clock_windows": ("ClockWindow", "clock_change"),
            "diagnose": ("Diagnosis",),
            "finding": ("Finding",),
        },
    )
