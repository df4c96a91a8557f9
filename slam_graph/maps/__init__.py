# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of recordings: saved by one run, used by later ones.

`map_building.py` (`build_map`) makes a `SlamMap` (`map_model.py`) of the keyframes of a run,
`map_file.py` reads and writes it, `map_localization.py` (`MapLocalizer`) localizes a run in it, and
`map_merge.py` (`merge_maps`) merges two. Settings are in `map_config.py`.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "LocalizationConfig",
    "MapConfig",
    "MapLocalizer",
    "MapRecording",
    "SlamMap",
    "build_map",
    "merge_maps",
    "read_map",
    "write_map",
]

if TYPE_CHECKING:
    from slam_graph.maps.map_building import build_map
    from slam_graph.maps.map_config import LocalizationConfig, MapConfig
    from slam_graph.maps.map_file import read_map, write_map
    from slam_graph.maps.map_localization import MapLocalizer
    from slam_graph.maps.map_merge import merge_maps
    from slam_graph.maps.map_model import MapRecording, SlamMap
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "map_building": ("build_map",),
            "map_config": (
                "LocalizationConfig",
                "MapConfig",
            ),
            "map_file": (
                "read_map",
                "write_map",
            ),
            "map_localization": ("MapLocalizer",),
            "map_merge": ("merge_maps",),
            "map_model": (
                "MapRecording",
                "SlamMap",
            ),
        },
    )
