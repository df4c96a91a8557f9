# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The places of a map: which look like a view, and from where the view was taken."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.errors import DataError
from slam_graph.loop_closure.loop_config import PlaceConfig, VerificationConfig
from slam_graph.loop_closure.loop_keyframes import Keyframe
from slam_graph.loop_closure.loop_verification import Loop, LoopVerifier
from slam_graph.loop_closure.place_recognition import PlaceDatabase, best_places
from slam_graph.maps.map_model import Descriptors, SlamMap, in_body
from slam_graph.sensors.rig import Rig

HALF_TURN_M = 4.0
"""How far a keyframe that looks the opposite way counts as being away."""

HELD_PLACES = 200
"""How many places are held ready, about 0.1 MB each; the one made first makes room."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A view that a place of the map explains.

    Attributes:
        place: the keyframe of the map.
        world_T_body: where the view was taken, in the world of the map.
        covariance: (6, 6) of it in GTSAM's tangent: rotation (rad), translation (m).
        loop: how it was found: from the place (`first`) to the view (`second`).
        features: (inliers,) features of the map that the pairs of `loop` match.
    """

    place: int
    world_T_body: gtsam.Pose3
    covariance: FloatArray
    loop: Loop
    features: IntArray


class MapPlaces:
    """Compares views with a map.

    A place is a keyframe with all features that it and its neighbours see. Neighbours are those
    that share most features with it.

    Args:
        content: the map.
        rig: of the views; only its first camera is used.
        places: how alike a place must look.
        verification: what it takes.
        neighbours: how many of them.
    """

    def __init__(
        self,
        content: SlamMap,
        rig: Rig,
        places: PlaceConfig,
        verification: VerificationConfig,
        neighbours: int,
    ) -> None:
        self.map = content
        self._same_place, self._neighbours = places.same_place, neighbours
        self._verifier = LoopVerifier(rig.cameras[0], verification)
        self._database = PlaceDatabase(len(content.vocabulary.words))
        for number in range(len(content)):
            self._database.add(content.vocabulary.words_of(content.descriptors_of(number)))
        self._shared = content.seen_by.minimum(1)
        self._places: dict[int, Keyframe] = {}

    def check(self, descriptors: Descriptors, name: str) -> None:
        """Refuse descriptors of another kind than the map's.

        Raises:
            DataError: naming both.
        """
        bits, own = 8 * descriptors.shape[1], 8 * self.map.descriptors.shape[1]
        if bits != own:
            raise DataError(
                f"{name}: has descriptors of {bits} bits and the map of {own}; make the map with "
                "the same ones"
            )

    def alike(self, descriptors: Descriptors, count: int) -> IntArray:
        """Keyframes that look most like a view with descriptors (N, B), the best first."""
        scores = self._database.query(self.map.vocabulary.words_of(descriptors))
        return best_places(scores, 0.0, count, self._same_place)

    def nearest(self, world_T_body: gtsam.Pose3, count: int) -> IntArray:
        """Keyframes nearest to a pose, in position and direction of view, the best first."""
        poses = self.map.poses
        away = np.linalg.norm(poses.translations - world_T_body.translation(), axis=1)
        # |R - S|² = 8 for a half turn
        turned = np.linalg.norm(poses.rotations - world_T_body.rotation().matrix(), axis=(1, 2))
        near = 1.0 / (1.0 + away + turned * HALF_TURN_M / np.sqrt(8.0))
        return best_places(near, 0.0, count, self._same_place)

    def locate(self, view: Keyframe, number: int, gravity: bool) -> Sighting | None:
        """Where a view was taken, if it shows the place of a keyframe of the map.

        Args:
            view: its points are not used, and its pose only for roll and pitch.
            number: of the keyframe.
            gravity: whether both know roll and pitch.
        """
        place = self._place(number)
        loop = self._verifier.verify([place, view], 0, 1, gravity)
        if loop is None:
            return None
        return Sighting(
            number,
            place.world_T_body.compose(loop.first_T_second),
            loop.covariance,
            loop,
            place.ids[loop.pairs[:, 0]],
        )

    def _place(self, number: int) -> Keyframe:
        """A keyframe that sees all features of its neighbours too."""
        if number not in self._places:
            if len(self._places) == HELD_PLACES:
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
