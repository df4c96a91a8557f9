# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Matching of views with a map: similar keyframes, and the pose from which the view was taken."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.errors import DataError
from slam_graph.loop_closure import Keyframe, Loop, LoopClosureConfig, LoopVerifier
from slam_graph.maps.map_model import SlamMap, in_body
from slam_graph.sensors import Rig

_HALF_TURN_M = 4.0
"""Distance that a rotation by 180° counts as."""
_CACHED_PLACES = 200
"""Size of the cache of places, about 0.1 MB each; the oldest is removed first."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaceMatch:
    """A view that was localized at a place of the map.

    Attributes:
        place: number of the keyframe of the map.
        world_T_body: pose of the view in the world of the map.
        covariance: (6, 6) of it in GTSAM's tangent: rotation (rad), translation (m).
        loop: the verified match, from the place (`first`) to the view (`second`).
        features: (inliers,) features of the map that the pairs of `loop` match.
    """

    place: int
    world_T_body: gtsam.Pose3
    covariance: FloatArray
    loop: Loop
    features: IntArray


class MapPlaces:
    """Matches views with a map.

    A place is a keyframe with all features that it and its most covisible neighbours observe.

    Args:
        content: the map.
        rig: of the views; only its first camera is used.
        config: thresholds of verification.
        neighbours: number of covisible keyframes of a place.
    """

    def __init__(
        self,
        content: SlamMap,
        rig: Rig,
        config: LoopClosureConfig,
        neighbours: int,
    ) -> None:
        self.map = content
        self._neighbours = neighbours
        self._config = config.verification
        self.use(rig)
        self._database = content.vocabulary.index(map(content.descriptors_of, range(len(content))))
        self._shared = content.seen_by.minimum(1)
        self._places: dict[int, Keyframe] = {}

    def use(self, rig: Rig) -> None:
        """Match views of a rig with another calibration from now on."""
        self._verifier = LoopVerifier(rig.cameras[0], self._config)

    def check(self, descriptors: NDArray[np.uint8], name: str) -> None:
        """Check that descriptors are of the kind of the map.

        Raises:
            DataError: if they are not.
        """
        bits, own = 8 * descriptors.shape[1], 8 * self.map.descriptors.shape[1]
        if bits != own:
            raise DataError(
                f"{name}: has descriptors of {bits} bits and the map of {own}; make the map with "
                "the same ones"
            )

    def similar(self, descriptors: NDArray[np.uint8], count: int) -> IntArray:
        """The keyframes most similar to a view with descriptors (N, B), best first."""
        return self._database.similar(self.map.vocabulary.words_of(descriptors), count)

    def nearest(self, world_T_body: gtsam.Pose3) -> int:
        """The keyframe nearest to a pose, in position and orientation."""
        poses = self.map.poses
        away = np.linalg.norm(poses.translations - world_T_body.translation(), axis=1)
        # |R - S|² = 8 for a half turn
        turned = np.linalg.norm(poses.rotations - world_T_body.rotation().matrix(), axis=(1, 2))
        return int(np.argmin(away + turned * _HALF_TURN_M / np.sqrt(8.0)))

    def locate(self, view: Keyframe, number: int, gravity: bool) -> PlaceMatch | None:
        """Localize a view at a keyframe of the map; None if verification fails.

        Args:
            view: its points are not used, and its pose only for roll and pitch.
            number: of the keyframe.
            gravity: whether roll and pitch of view and map are known.
        """
        place = self._place(number)
        loop = self._verifier.verify([place, view], 0, 1, gravity)
        if loop is None:
            return None
        return PlaceMatch(
            number,
            place.world_T_body.compose(loop.first_T_second),
            loop.covariance,
            loop,
            place.ids[loop.pairs[:, 0]],
        )

    def _place(self, number: int) -> Keyframe:
        """A keyframe with the features of its neighbours."""
        if number not in self._places:
            if len(self._places) == _CACHED_PLACES:
                del self._places[next(iter(self._places))]
            content, keyframe = self.map, self.map.keyframe(number)
            common = (self._shared @ self._shared[number].T).toarray()[:, 0]
            common[number] = 0
            near = np.argsort(-common, kind="stable")[: self._neighbours]
            near = near[common[near] > 0]
            features = np.unique(self._shared[[number, *near.tolist()]].indices).astype(np.int64)
            pose = keyframe.world_T_body
            self._places[number] = replace(
                keyframe,
                ids=features,
                normalized=np.full((len(features), 2), np.nan),
                descriptors=content.feature_descriptors[features],
                points=in_body(pose, content.points[features]),
            )
        return self._places[number]
