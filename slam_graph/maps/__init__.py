# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of recordings: saved by one run, used by later ones.

`map_building.py` (`build_map`) makes a `SlamMap` (`map_model.py`) of the keyframes of a run,
`map_file.py` reads and writes it, `map_localization.py` (`MapLocalizer`) localizes a run in it, and
`map_merge.py` (`merge_maps`) merges two. Settings are in `map_config.py`.
"""
