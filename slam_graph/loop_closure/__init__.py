# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure at the end of a run.

Start at `close_loops.py` (`close_loops`): keyframes (`loop_keyframes.py`), place recognition,
verification, a pose graph in four degrees of freedom (`loop_pose_graph.py`). Settings are in
`loop_config.py`.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "Descriptors",
    "Keyframe",
    "KeyframeDescriber",
    "KeyframeLog",
    "Loop",
    "LoopClosureConfig",
    "LoopClosures",
    "LoopVerifier",
    "PlaceConfig",
    "PlaceDatabase",
    "VerificationConfig",
    "Vocabulary",
    "best_places",
    "body_poses",
    "close_loops",
    "loop_graph",
    "majority",
    "reposed",
]

if TYPE_CHECKING:
    from slam_graph.loop_closure.loop_closing import LoopClosures, close_loops
    from slam_graph.loop_closure.loop_config import (
        LoopClosureConfig,
        PlaceConfig,
        VerificationConfig,
    )
    from slam_graph.loop_closure.loop_keyframes import (
        Descriptors,
        Keyframe,
        KeyframeDescriber,
        KeyframeLog,
        reposed,
    )
    from slam_graph.loop_closure.loop_pose_graph import body_poses, loop_graph
    from slam_graph.loop_closure.loop_verification import Loop, LoopVerifier
    from slam_graph.loop_closure.place_recognition import (
        PlaceDatabase,
        Vocabulary,
        best_places,
        majority,
    )
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "loop_closing": ("LoopClosures", "close_loops"),
            "loop_config": ("LoopClosureConfig", "PlaceConfig", "VerificationConfig"),
            "loop_keyframes": (
                "Descriptors",
                "Keyframe",
                "KeyframeDescriber",
                "KeyframeLog",
                "reposed",
            ),
            "loop_pose_graph": ("body_poses", "loop_graph"),
            "loop_verification": ("Loop", "LoopVerifier"),
            "place_recognition": ("PlaceDatabase", "Vocabulary", "best_places", "majority"),
        },
    )
