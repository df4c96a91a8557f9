# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure at the end of a run.

Start at `loop_closing.py` (`close_loops`): keyframes (`loop_keyframes.py`), place recognition,
verification, a pose graph in four degrees of freedom (`loop_pose_graph.py`). Settings are in
`loop_config.py`.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "Keyframe",
    "KeyframeLog",
    "Loop",
    "LoopClosureConfig",
    "LoopClosures",
    "LoopVerifier",
    "Vocabulary",
    "close_loops",
    "correct_keyframes",
]

if TYPE_CHECKING:
    from slam_graph.loop_closure.loop_closing import LoopClosures, close_loops
    from slam_graph.loop_closure.loop_config import LoopClosureConfig
    from slam_graph.loop_closure.loop_keyframes import Keyframe, KeyframeLog
    from slam_graph.loop_closure.loop_pose_graph import correct_keyframes
    from slam_graph.loop_closure.loop_verification import Loop, LoopVerifier
    from slam_graph.loop_closure.place_recognition import Vocabulary
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "loop_closing": (
                "LoopClosures",
                "close_loops",
            ),
            "loop_config": ("LoopClosureConfig",),
            "loop_keyframes": (
                "Keyframe",
                "KeyframeLog",
            ),
            "loop_pose_graph": ("correct_keyframes",),
            "loop_verification": (
                "Loop",
                "LoopVerifier",
            ),
            "place_recognition": ("Vocabulary",),
        },
    )
