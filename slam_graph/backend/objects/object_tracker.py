# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""All moving objects of a recording: found, followed, and told apart, frame by frame.

In every frame: the objects take their tracks; the other tracks are tested for motion of their own
(`motion_test.py`); those that fit the motion of an object join it; those that are left and move
together begin a new one (`motion_segmentation.py`).
"""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.special import chdtri

from slam_graph.arrays import FloatArray, IntArray, ascending_union, median
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.mirror_motion import CLEARLY, MirrorMotion
from slam_graph.backend.objects.motion_segmentation import rigid_groups
from slam_graph.backend.objects.motion_test import MotionTest, Verdict, judge_tracks
from slam_graph.backend.objects.object_frame import ObjectFrame
from slam_graph.backend.objects.object_regions import region, regions_of_motion
from slam_graph.backend.objects.object_review import ObjectReview
from slam_graph.backend.objects.object_state import ObjectState
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.objects.relative_motion import RelativeMotion, motion_over
from slam_graph.backend.objects.track_assignment import (
    MARGIN,
    TrackAssignment,
    members_of,
)
from slam_graph.backend.objects.track_labels import TrackLabels
from slam_graph.backend.objects.track_window import TrackWindow
from slam_graph.backend.objects.tracked_object import TrackedObject
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.errors import EstimationError
from slam_graph.sensors import FeatureFrame, Rig

_LEAST_FRAMES = 3
"""Frames of a track before it is tested."""
_ENOUGH, _NEWS, _LEAST_NOISE = 20, 0.1, 0.3
"""Tracks that tell the noise, weight of one frame of them once there are more than ten (before, all
weigh alike, the setting as one of them), and its least ratio to the setting."""
_MOVING_SHARE = 0.3
"""Share of the tracks in a mask that must move before it is an object."""
_TWO_MOTIONS = 0.25
"""Share of the tracks of an object that move in its frame, from which it is two objects."""
_REVIEWS = (3, 6, 10)
"""Frames of an object after which it is reviewed; later each time as many as the last one."""
_MIRRORED, _CLEARLY_MIRRORED = 2, 5
"""Frames between two comparisons with the mirror image, once it was ruled out; and once it was
clearly: the window then has hardly a frame that was compared."""
_PAUSE = 5
"""Least frames between two reviews of an object."""
_BADLY = 3.0
"""Squared errors of an object that is reviewed at once, in standard deviations."""
_SAME_PLACE_M = 0.5
"""An object that appears again is no farther than this from where it is expected, or its own
size."""


class ObjectTracker:
    """Finds moving objects and estimates their motion.

    Args:
        rig: the cameras.
        algorithm: the policies, the same for objects as for the platform.
        backend: settings of the estimator.
        config: of objects.
        first: number of the first one.

    Attributes:
        objects: those that are seen, or were a short time ago.
    """

    def __init__(
        self,
        rig: Rig,
        algorithm: AlgorithmConfig,
        backend: BackendConfig,
        config: ObjectsConfig,
        first: int = 1,
    ) -> None:
        self._backend = backend
        self._policies = algorithm, backend
        self._config = config
        self._window = TrackWindow(rig, backend)
        self._rig = rig
        self._next = first
        self._noise, self._noise_frames = 1.0, 0
        self.objects: list[TrackedObject] = []
        self._hidden: list[TrackedObject] = []

    def add(
        self, frame: FeatureFrame, ego: EgoMotion, sigma_px: float, noise_px: float
    ) -> ObjectFrame:
        """Take the features of one frame.

        Args:
            frame: all of them, with those that are known to move.
            ego: the motion of the platform up to it.
            sigma_px: standard deviation of the observations by the settings, for the tests.
            noise_px: that which the platform's tracks show, for the estimates.
        """
        noise = self._backend.noise.model_copy(update={"pixel_sigma": noise_px})
        self._policies = self._policies[0], self._backend.model_copy(update={"noise": noise})
        self._window.add(frame, ego.stamps_ns[0], ego)
        self._labels = TrackLabels(frame)
        states = self._follow(ego, noise_px)
        own = members_of(self.objects)
        others = _without(self._window.seen, own)
        test = self._tested(others, ego, sigma_px)
        sigma_px *= self._noise_of(test, ego, sigma_px)
        assignment = TrackAssignment(self._window, self._labels, ego, sigma_px)
        assignment.join(self.objects, test)
        self._leave(assignment, ego, sigma_px)
        self._begin(test, ego, sigma_px)
        self._review(ego, sigma_px)
        self._resolve(ego, sigma_px)
        self._merge(ego)
        return self._described(states, test)

    def move(self, motion: gtsam.Pose3) -> None:
        """Move the objects with their world, by `new_T_old`."""
        for item in (*self.objects, *self._hidden):
            item.state = None if item.state is None else item.state.moved(motion)

    # --- objects that are known ------------------------------------------------------------------

    def _follow(self, ego: EgoMotion, noise_px: float) -> list[ObjectState]:
        states: list[ObjectState] = []
        now = ego.stamps_ns[-1]
        for item in list(self.objects):
            try:
                item.assume_pixel_noise(noise_px)
                state = item.add(self._window, ego)
            except EstimationError:
                self.objects.remove(item)
                continue
            if state is not None and item.confirmed and state.points >= self._config.min_points:
                states.append(state)
            if state is None:
                self.objects.remove(item)
                if item.confirmed:
                    self._hidden.append(item)
            elif item.confirmed and not item.moving and not item.reported:
                self.objects.remove(item)  # it was found by errors of the platform's motion
                states = [other for other in states if other is not state]
            item.reported |= item.confirmed
        oldest = now - round(self._config.max_occlusion_s * 1e9)
        self._hidden = [item for item in self._hidden if item.seen_ns >= oldest]
        return states

    def _leave(self, assignment: TrackAssignment, ego: EgoMotion, sigma_px: float) -> None:
        """Tracks leave the objects that they do not fit; what moves within one is another."""
        for item in list(self.objects):
            leaving = assignment.leaving(item)
            apart = self._moving_within(item, ego, sigma_px)
            if item.confirmed and len(apart) > _TWO_MOTIONS * len(item.members):
                self._separate(item, ego, sigma_px)
            else:
                item.members = _without(item.members, ascending_union(leaving, apart))

    def _moving_within(self, item: TrackedObject, ego: EgoMotion, sigma_px: float) -> IntArray:
        """Ids (N,) of the tracks of an object that move in its frame: an object is a world."""
        world = item.as_ego_motion(ego)
        if world is None:
            return np.zeros(0, np.int64)
        stamps = list(world.stamps_ns)
        obs = self._window.observations(item.members, _LEAST_FRAMES, stamps)
        rig, backend = self._window.projection(stamps, world.poses), self._policies[1]
        test = judge_tracks(obs, rig, world, sigma_px, backend, self._config)
        return test.ids[test.moves]

    def _separate(self, item: TrackedObject, ego: EgoMotion, sigma_px: float) -> None:
        """Leave an object the largest part of its tracks that moves as one; none fits it."""
        groups = self._groups(item.members, sigma_px)
        motion = self._motion_of(groups[0], ego) if groups else None
        if motion is None:
            self.objects.remove(item)
        else:
            item.begin_again(groups[0], motion, ego)

    def _review(self, ego: EgoMotion, sigma_px: float) -> None:
        """Begin objects again, or make two of them, where that explains their tracks better."""
        review = ObjectReview(self._window, ego, sigma_px, self._policies, self._config)
        for item in list(self.objects):
            if not self._due(item, sigma_px):
                continue
            item.reviewed = item.frames
            parts = sorted(review.of(item), key=lambda part: -len(part.members))
            if parts:
                item.begin_again(parts[0].members, parts[0].motion, ego)
            for part in parts[1:]:
                self._add(item.label, part.members, part.motion, ego)

    def _resolve(self, ego: EgoMotion, sigma_px: float) -> None:
        """See whether tracks tell the motion of their object from its mirror image."""
        mirror = MirrorMotion(self._window, sigma_px)
        for item in self.objects:
            if item.unique and item.frames < item.compared_next:
                continue
            worse = mirror.worse(item.members, item.poses)
            clearly = worse > CLEARLY * MARGIN
            item.compared_next = item.frames + (_CLEARLY_MIRRORED if clearly else _MIRRORED)
            if abs(worse) > MARGIN:
                item.unique = worse > 0
            if worse < -MARGIN:  # one that begins now finds either of the two
                motion = self._motion_of(item.members, ego)
                if motion is not None and mirror.worse(item.members, motion.poses) > MARGIN:
                    item.begin_again(item.members, motion, ego)
                    item.unique = True

    def _due(self, item: TrackedObject, sigma_px: float) -> bool:
        """Whether an object is to be reviewed: often at first, and where its tracks fit badly."""
        if item.frames in _REVIEWS or item.frames % _REVIEWS[-1] == 0:
            return item.frames > 0
        if item.frames - item.reviewed < _PAUSE:
            return False
        _, squares, dof = self._window.misfit(item.members, item.poses, sigma_px)
        spread = float(np.sqrt(2.0 * max(dof.sum(), 1)))
        return bool(squares.sum() - dof.sum() > _BADLY * spread)

    def _merge(self, ego: EgoMotion) -> None:
        """Objects that move as one rigid body become one: the older stays."""
        for younger in list(self.objects)[::-1]:
            for older in self.objects:
                if older.label != younger.label or older.number >= younger.number:
                    continue
                if older.moves_with(younger, ego):
                    older.members = ascending_union(older.members, younger.members)
                    self.objects.remove(younger)
                    break

    def _noise_of(self, test: MotionTest, ego: EgoMotion, sigma_px: float) -> float:
        """Noise of the tracks that are not known to move, over what is assumed; at most 1.

        It is read from the same squared errors that are compared for objects. Those of the test
        are smaller: it allows for slow errors, which take a part of the noise.
        """
        static = dict(zip(ego.stamps_ns, ego.poses, strict=True))
        _, squares, dof = self._window.misfit(test.ids[~test.moves], static, sigma_px)
        if len(dof) >= _ENOUGH:
            middle = float(median(squares / chdtri(dof, 0.5)))
            ratio = float(np.clip(middle, _LEAST_NOISE**2, 1.0))
            self._noise_frames += 1
            weight = max(_NEWS, 1.0 / (1.0 + self._noise_frames))
            self._noise += weight * (float(np.sqrt(ratio)) - self._noise)
        return self._noise

    # --- new objects -----------------------------------------------------------------------------

    def _tested(self, ids: IntArray, ego: EgoMotion, sigma_px: float) -> MotionTest:
        stamps = list(ego.stamps_ns)
        obs = self._window.observations(ids, _LEAST_FRAMES, stamps)
        rig = self._window.projection(stamps, ego.poses)
        return judge_tracks(obs, rig, ego, sigma_px, self._policies[1], self._config)

    def _begin(self, test: MotionTest, ego: EgoMotion, sigma_px: float) -> None:
        """Tracks that move together begin an object."""
        for label, group in self._new_groups(test, sigma_px):
            motion = self._motion_of(group, ego)
            if motion is not None:
                self._add(label, group, motion, ego)

    def _motion_of(self, members: IntArray, ego: EgoMotion) -> RelativeMotion | None:
        return motion_over(members, self._window, ego, self._policies, self._config)

    def _add(self, label: int, members: IntArray, motion: RelativeMotion, ego: EgoMotion) -> None:
        """Add an object, with its old number if it was seen before."""
        item = TrackedObject(self._next, label, members, motion, ego, self._config)
        self._recognise(item, ego)
        if item.number == self._next:
            self._next += 1
        self.objects.append(item)

    def _new_groups(self, test: MotionTest, sigma_px: float) -> list[tuple[int, IntArray]]:
        """Labels and tracks of what begins to move; without masks labels are 0."""
        free = ~is_in(test.ids, members_of(self.objects))
        moves = free & test.moves
        if not self._labels.given:
            return [(0, group) for group in self._groups(test.ids[moves], sigma_px)]
        taken = {item.label for item in self.objects}
        groups: list[tuple[int, IntArray]] = []
        for label in self._labels.present(test.ids[moves]):
            inside = free & (self._labels.of(test.ids) == label)
            if label in taken or np.mean(moves[inside]) < _MOVING_SHARE:
                continue
            groups += [(label, group) for group in self._groups(test.ids[inside], sigma_px)[:1]]
        return groups

    def _groups(self, ids: IntArray, sigma_px: float) -> list[IntArray]:
        config = self._config
        if len(ids) < config.min_points or len(self._window.frames) < _LEAST_FRAMES:
            return []
        window = self._window
        frames, motions = list(window.frames), window.motions
        return rigid_groups(ids, frames, self._rig, config.min_points, sigma_px, motions)

    def _recognise(self, item: TrackedObject, ego: EgoMotion) -> None:
        """Give an object its old number if one that was hidden is expected there."""
        now = ego.stamps_ns[-1]
        for hidden in sorted(self._hidden, key=lambda other: -other.seen_ns):
            expected = hidden.predicted(now)
            if expected is None or hidden.label != item.label:
                continue
            shift = item.middle(ego) - expected.transformFrom(hidden.shape_middle())
            if item.label > 0:  # the mask says that it is the same
                expected = gtsam.Pose3(expected.rotation(), expected.translation() + shift)
                shift = np.zeros(3)
            if np.linalg.norm(shift) < max(_SAME_PLACE_M, hidden.size()):
                item.number, item.moving = hidden.number, hidden.moving
                item.continue_from(expected, ego)
                self._hidden.remove(hidden)
                return

    def _hulls(self, by_itself: IntArray) -> list[tuple[int, FloatArray]]:
        """Number and polygon of each object; of what moves and is none yet, 0."""
        seen = self._window.frames[-1].cameras[0]
        hulls = [(item.number, region(seen, item.members)) for item in self.objects]
        return hulls + [(0, polygon) for polygon in regions_of_motion(seen, by_itself)]

    def _described(self, states: list[ObjectState], test: MotionTest) -> ObjectFrame:
        moving = [item for item in self.objects if item.moving or not item.confirmed]
        members = {int(i): item.number for item in self.objects for i in item.members}
        own = members_of(self.objects)
        standing = members_of([item for item in self.objects if item.standing])
        free = ~is_in(test.ids, own)
        ids = np.concatenate([test.ids[free], own])
        known = np.concatenate(
            [
                test.probabilities[free],
                is_in(own, members_of(moving)).astype(np.float64),
            ]
        )
        order = np.argsort(ids)
        by_itself = test.ids[free & test.moves]
        return ObjectFrame(
            states,
            _without(ascending_union(own, by_itself), standing),
            ascending_union(_without(test.of(Verdict.STATIC), own), standing),
            _without(test.of(Verdict.WRONG), own),
            (ids[order], known[order]),
            members,
            {item.number: item.world_points() for item in self.objects if item.confirmed},
            self._hulls(by_itself),
        )


def _without(ids: IntArray, others: IntArray) -> IntArray:
    """The ids (N,) that are not among others; both ascending."""
    return ids[~is_in(ids, others)]
