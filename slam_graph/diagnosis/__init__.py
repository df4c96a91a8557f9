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

__all__ = ["Diagnosis"]

if TYPE_CHECKING:
    from slam_graph.diagnosis.diagnose import Diagnosis
else:
    __getattr__, __dir__ = lazy_exports(__name__, {"diagnose": ("Diagnosis",)})
