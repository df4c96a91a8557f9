# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a map is asked with: the rows of a rolling shutter at one time, as those of the map are."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from flight import features, rig, room
from test_rolling_shutter import FAST, rolling, rows_of

from slam_graph.config import load_config
from slam_graph.diagnostics import Diagnostics
from slam_graph.loop_closure import Keyframe
from slam_graph.maps import SlamMap
from slam_graph.pipeline import mapping
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, Rig


class _Localizer:
    """Keeps the keyframes that it is to find in the map."""

    def __init__(self, *_: Any) -> None:
        self.found: list[Keyframe] = []
        self.filter, self.located = None, False
        self.places = SimpleNamespace(check=lambda descriptors, name: None)
        self.match = self.found.append

    def move(self, stamp_ns: int, pose: object) -> None: ...

    def wants(self, stamp_ns: int) -> bool:
        return True

    def restart(self, rig: Rig) -> None: ...


def _localization(mounted: Rig, monkeypatch: pytest.MonkeyPatch) -> mapping.Localization:
    monkeypatch.setattr(mapping, "MapLocalizer", _Localizer)
    log = SimpleNamespace(append=lambda *_: None, seconds=0.0)
    result = SimpleNamespace(
        config=load_config(),
        input=SimpleNamespace(rig=mounted, info=SimpleNamespace(name="flight")),
        causal_rig=mounted,
        estimated_rig=mounted,
        begin_localization=lambda known: log,
    )
    return mapping.Localization(cast(RunResult, result), cast(SlamMap, None), Diagnostics())


def _frame(seen: FeatureFrame, t_s: float, restarted: bool = False) -> EstimatedFrame:
    camera = seen.cameras[0]
    described = replace(camera, descriptors=np.zeros((len(camera), 32), np.uint8))
    frame = SimpleNamespace(
        restarted=restarted,
        state=FAST.nav_state(t_s),
        waits=False,
        image=None,
        features=FeatureFrame(seen.stamp_ns, (described, *seen.cameras[1:])),
    )
    return cast(EstimatedFrame, frame)


def test_rows_are_unrolled_before_the_map_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """As far as depths are not known; where the motion is not known either, they are as seen."""
    mounted, points = rolling(), room(300, np.random.default_rng(3))
    stage = _localization(mounted, monkeypatch)
    times = (0.9, 0.95, 1.0)
    for t_s in times:
        stage.frame(_frame(rows_of(FAST, mounted, points, t_s), t_s))
    again = rows_of(FAST, mounted, points, 1.05)
    stage.frame(_frame(again, 1.05, restarted=True))
    asked = cast(_Localizer, stage._localizer).found
    rows = rows_of(FAST, mounted, points, 1.0).cameras[0]
    at_once = features(FAST, rig(), points, 1.0).cameras[0]
    _, a, b = np.intersect1d(rows.ids, at_once.ids, return_indices=True)
    before, after = (
        np.linalg.norm(seen[a] - at_once.normalized[b], axis=1)
        for seen in (rows.normalized, asked[2].normalized)
    )
    assert len(a) > 20
    assert np.median(after) < 0.3 * np.median(before)
    assert np.array_equal(asked[3].normalized, again.cameras[0].normalized)


def test_a_global_shutter_is_asked_with_as_it_saw(monkeypatch: pytest.MonkeyPatch) -> None:
    points = room(300, np.random.default_rng(3))
    stage = _localization(rig(), monkeypatch)
    seen = [features(FAST, rig(), points, t_s) for t_s in (0.9, 0.95, 1.0)]
    for t_s, frame in zip((0.9, 0.95, 1.0), seen, strict=True):
        stage.frame(_frame(frame, t_s))
    for asked, frame in zip(cast(_Localizer, stage._localizer).found, seen, strict=True):
        assert np.array_equal(asked.normalized, frame.cameras[0].normalized)
