# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The policy table: what makes one algorithm differ from another, module by module.

An algorithm is a YAML file in `configs/algorithms/` with one section for each module of the loop.
How poses are selected, and what becomes of features, is in `cost/selection_policies.py`.

Every combination of policies that is accepted counts each measurement exactly once. What one policy
would make of no effect in another is refused when the file is loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError

from slam_graph.backend.cost.selection_policies import FEATURE_POLICIES, POSE_SELECTIONS
from slam_graph.plugins import Choice
from slam_graph.settings import Settings, expert

_STATE_FEATURE_FRAMES = 10
"""Features seen in fewer frames are worth more when they are used once, with all observations."""
_BOUNDED = ("most_recent", "evenly_spaced", "keyframes")
"""Pose selections that are known to keep no more than `max_past_poses`."""


class CostPolicy(Settings):
    """Module 1: which variables and residuals are in the cost."""

    past_poses: Annotated[str, Choice(POSE_SELECTIONS)] = "most_recent"
    """Which past poses stay in the cost beside the current IMU state. most_recent: the latest ones.
    evenly_spaced: also some of the far past, which helps in slow flight. keyframes: chosen by what
    they see, so that hovering does not fill the window with one view."""
    max_past_poses: int = Field(11, ge=1)
    """N_max: how many past poses at most (of `keyframes`: how many keyframes). More poses mean less
    drift, and time that grows faster than their number."""
    pose_spacing_s: float | None = expert(None, ge=0)
    """Least time between two poses that stay, s, so that the window of a fast camera is not too
    short, and its features are seen with parallax. Only the frames that stay count for
    state_feature_frames. 0 keeps all. Not given: 0.037 with one camera and an IMU (of 25 Hz all
    poses stay, of 30 Hz every second one, of 60 Hz every third), else 0. Not for keyframes."""
    recent_frames: int = Field(1, ge=1)
    """How many of the last frames keep their velocity and bias; 1 is the current one only. The IMU
    factors between them are linearised anew in every step. Raise it with `keyframes`, which need
    IMU states between the keyframes and the current frame."""
    features: Annotated[str, Choice(FEATURE_POLICIES)] = "once"
    """What becomes of a feature that is not held in the state. once: used when its track ends, or
    when a pose that saw it leaves, with all its observations, and marginalised at once. state: not
    used, only features of the state count. every_step: in the cost of every step, linearised anew,
    until a pose that saw it leaves; then it becomes part of the prior, and starts anew if it is
    still tracked."""
    keep_lost_features: bool | None = None
    """Whether features of the state that are no longer tracked are kept for when they come back:
    for front ends and simulations that recognise features. Not given: with stereo and RGB-D without
    an IMU only. Once tracks drift (`backend.noise.adaptive_drift`), none are kept."""
    max_state_features: int | None = Field(40, ge=0)
    """How many features are held in the state while they are tracked; null for no bound, 0 for the
    textbook MSCKF. Long-lived features in the state lower the drift and cost time."""
    state_feature_frames: int | None = expert(None, ge=2)
    """How many frames must have seen a feature before it may be held in the state; null for 10, or
    for as many as the past poses allow if these are fewer."""
    state_feature_depth_error: float = expert(0.1, gt=0)
    """Features are held in the state only if the standard deviation of their depth, relative to it,
    is less than this."""
    max_features_per_step: int = Field(60, ge=1)
    """How many features outside the state are in the cost of one step (longest tracks first). Lower
    it to save time, raise it for accuracy where many tracks end at once."""
    keyframe_overlap: float = Field(0.6, ge=0, le=1)
    """A frame becomes a keyframe when the last keyframe saw less than this share of its features.
    Higher values make more keyframes, and a window that is shorter in time."""
    keyframe_parallax_rad: float = expert(0.05, ge=0)
    """A frame also becomes a keyframe when the median angle between its rays and those of the last
    keyframe to the same features is larger than this."""

    moved: ClassVar[Mapping[str, str]] = {
        "gate": "follows from 'features' now: each feature is tested when it enters the cost, and "
        "under 'every_step' its observations after each step; remove the line",
        "robust_loss": "is backend.gating.robust_loss now, the same for all algorithms",
    }

    @field_validator("features", mode="before")
    @classmethod
    def _renamed(cls, value: Any) -> Any:
        """Name the new word for an old one."""
        if value == "window":
            raise ValueError("'window' is 'every_step' now")
        return value

    @model_validator(mode="after")
    def _has_effect(self) -> CostPolicy:
        """Refuse what another choice makes of no effect."""
        features = FEATURE_POLICIES[self.features]
        holds_none = self.max_state_features == 0
        if holds_none and not features.uses_tracks:
            raise ValueError(
                f"features: {self.features} measures only features of the state, and "
                "max_state_features: 0 allows none; raise it, or use features: once"
            )
        if features.relinearized and self.past_poses == "evenly_spaced":
            raise ValueError(
                f"features: {self.features} makes a feature part of the prior when a pose that saw "
                "it leaves, and past_poses: evenly_spaced drops its observations, so they would "
                "be lost; use most_recent or keyframes, or features: once"
            )
        if holds_none:
            self._refuse(
                ("keep_lost_features", "state_feature_frames", "state_feature_depth_error"),
                "max_state_features: 0 holds no features in the state",
            )
        if not features.uses_tracks:
            self._refuse(
                ("max_features_per_step",),
                f"features: {self.features} uses no features outside the state",
            )
        if self.past_poses == "keyframes":
            self._refuse(("pose_spacing_s",), "past_poses: keyframes keeps no poses by their time")
        if self.past_poses in ("most_recent", "evenly_spaced"):
            self._refuse(
                ("keyframe_overlap", "keyframe_parallax_rad"),
                f"past_poses: {self.past_poses} selects no keyframes",
            )
            if self.past_poses == "evenly_spaced" and self.max_past_poses < 2:
                raise ValueError(
                    "past_poses: evenly_spaced keeps the oldest and the newest pose, so "
                    "max_past_poses must be 2 at least; or use most_recent"
                )
            if self.past_poses == "evenly_spaced" and self.recent_frames >= self.max_past_poses:
                raise ValueError(
                    f"past_poses: evenly_spaced keeps the {self.recent_frames} recent_frames and "
                    f"the oldest pose, so max_past_poses: {self.max_past_poses} must be larger "
                    "than recent_frames; or use most_recent"
                )
            if self.recent_frames > self.max_past_poses + 1:
                raise ValueError(
                    f"recent_frames: {self.recent_frames} are more than the poses that stay: "
                    f"max_past_poses: {self.max_past_poses} and the current one"
                )
        asked = self.state_feature_frames
        bounded = self.past_poses in _BOUNDED  # what others keep is not known here
        if bounded and asked is not None and asked > self._most_frames:
            raise ValueError(
                f"a feature waits over {self._most_frames} frames at most under max_past_poses: "
                f"{self.max_past_poses}, so none would be seen in state_feature_frames: "
                f"{asked}; lower that, or remove it"
            )
        return self

    @property
    def frames_before_state(self) -> int:
        """In how many frames a feature must have been seen before it may be held in the state."""
        return self.state_feature_frames or min(_STATE_FEATURE_FRAMES, self._most_frames)

    @property
    def _most_frames(self) -> int:
        """The longest track, in frames: past poses, the one that is to leave, and the current.

        A pose selection from outside may keep more than `max_past_poses`, not knowing it.
        """
        recent = self.recent_frames - 1 if self.past_poses == "keyframes" else 0
        return self.max_past_poses + recent + 2

    def _refuse(self, names: tuple[str, ...], reason: str) -> None:
        """Refuse settings that are not at their defaults although they have no effect.

        A switch may be off in any case.
        """
        for name in names:
            value: Any = getattr(self, name)
            if value != type(self).model_fields[name].default and value is not False:
                raise ValueError(f"{name}: {value} has no effect: {reason}; remove the line")


class GaussNewtonPolicy(Settings):
    """Module 2: how the cost is minimised."""

    max_steps: int = Field(1, ge=1)
    """Number of steps at most: 1 makes a filter, several an iterated one. More steps help where the
    start or the features are far from linear, and cost time."""
    tolerance: float = expert(1e-6, ge=0)
    """Steps end when no tangent moves by more (with damping: when the cost falls by less, relative
    to its value)."""
    damping: Literal["none", "levenberg_marquardt"] = "none"
    """Plain Gauss-Newton, or Levenberg-Marquardt, which repeats a step that raises the cost with
    damping: use it with several steps."""

    @model_validator(mode="after")
    def _has_effect(self) -> GaussNewtonPolicy:
        """Refuse what a single step makes of no effect."""
        default = type(self).model_fields["tolerance"].default
        if self.max_steps == 1 and self.tolerance not in (default, 0.0):
            raise ValueError(
                f"tolerance: {self.tolerance} has no effect with max_steps: 1; remove the line, or "
                "take more steps"
            )
        return self


class MarginalizationPolicy(Settings):
    """Module 3: what the variables that leave the cost leave behind."""

    first_estimates: bool = True
    """First-estimates Jacobians for the variables of the prior. Without them the estimator becomes
    too sure of heading and position; turn them off to see that."""

    moved: ClassVar[Mapping[str, str]] = {
        "absorb": "follows from the cost's 'features' and 'recent_frames' now; remove the line",
    }


class SmootherPolicy(Settings):
    """How GTSAM's own smoothers are used, where one of them is the engine."""

    lag_s: float = Field(4.0, gt=0)
    """How long states stay in a fixed lag (`isam2` keeps all). Longer: more accurate, slower."""
    spacing_s: float = expert(0.09, ge=0)
    """Least time between two states in the graph; frames between them are predicted by the IMU."""
    factorization: Literal["cholesky", "qr"] = expert("cholesky")
    """How variables are eliminated: fast, or with the square root of the condition number."""
    relinearize_threshold: float = expert(0.01, gt=0)
    """Variables of which the tangent moved by more are linearised anew (iSAM2)."""
    relinearize_skip: int = expert(1, ge=1)
    """How many updates from one such check to the next (iSAM2)."""
    max_iterations: int = expert(5, ge=1)
    """Levenberg-Marquardt steps at most in one update (`fixed_lag_batch`)."""
    max_features: int = expert(40, ge=1)
    """How many features are tracked in the graph at once: more are more accurate and slower."""
    robust_loss: Literal["none", "huber", "cauchy"] = expert("cauchy")
    """Loss on reprojection residuals, instead of that of `backend.gating`: an outlier that is in
    the graph stays there, so its weight must be able to vanish."""
    min_feature_frames: int | None = expert(None, ge=2)
    """How many states must have seen a feature before it may become a variable. Not given: 5, or 2
    without an IMU."""
    min_parallax_rad: float | None = expert(None, ge=0)
    """Smallest angle between two rays to such a feature. Not given: 0.02, or 0 without an IMU."""

    @property
    def feature_frames(self) -> int:
        """How many states must have seen a feature before it may become a variable."""
        return 5 if self.min_feature_frames is None else self.min_feature_frames

    @property
    def feature_parallax_rad(self) -> float:
        """Smallest angle between two rays to such a feature."""
        return 0.02 if self.min_parallax_rad is None else self.min_parallax_rad


_OWN_SECTIONS = ("cost", "gauss_newton", "marginalization")
"""Sections that this package's own engine uses."""
_SMOOTHER_SECTIONS = ("smoother",)
"""Sections that GTSAM's smoothers use."""
_UNUSED_KEYS = {
    "isam2": {"max_iterations"},
    "fixed_lag_isam2": {"max_iterations"},
    "fixed_lag_batch": {"relinearize_threshold", "relinearize_skip"},
}
"""Keys of `smoother` that mean nothing to one of GTSAM's smoothers."""


def _sections_of(engine: str) -> tuple[str, ...]:
    """The sections of an algorithm's table that an engine uses."""
    return _OWN_SECTIONS if engine == "square_root" else _SMOOTHER_SECTIONS


def _unused_keys(engine: str, section: str) -> set[str]:
    """Keys of a section that an engine does not use although it uses the section."""
    return _UNUSED_KEYS.get(engine, set()) if section in _SMOOTHER_SECTIONS else set()


class AlgorithmConfig(Settings):
    """One row of the table."""

    # files of results have this name, so it must not lead out of their folder
    name: str = Field(pattern=r"^[\w+-][\w.+ -]*$", max_length=120)
    """Name of the algorithm."""
    engine: Literal["square_root", "fixed_lag_isam2", "fixed_lag_batch", "isam2"] = "square_root"
    """What solves the problem: this package's own loop under the three policies, or one of GTSAM's
    smoothers under `smoother`."""
    cost: CostPolicy = CostPolicy()
    """Cost construction."""
    gauss_newton: GaussNewtonPolicy = GaussNewtonPolicy()
    """Gauss-Newton steps."""
    marginalization: MarginalizationPolicy = MarginalizationPolicy()
    """Marginalization."""
    smoother: SmootherPolicy = SmootherPolicy()
    """GTSAM's smoothers."""

    @property
    def relinearizes(self) -> bool:
        """Whether residuals stay in the cost after a step, to be linearised anew in the next."""
        return FEATURE_POLICIES[self.cost.features].relinearized or self.cost.recent_frames > 1

    @field_validator("cost", "gauss_newton", "marginalization", "smoother", mode="before")
    @classmethod
    def _used(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse a section, or a key of one, that the engine would ignore."""
        engine, section = str(info.data.get("engine", "square_root")), str(info.field_name)
        sections = _sections_of(engine)
        if section not in sections:
            others = "square_root" if section in _OWN_SECTIONS else "one of GTSAM's smoothers"
            reason = (
                f"is not used by engine '{engine}', whose settings are in {', '.join(sections)}; "
                f"remove it, or set algorithm.engine to {others}"
            )
            raise PydanticCustomError("unused", "{reason}", {"reason": reason})
        given = value.model_fields_set if isinstance(value, Settings) else value
        unused = sorted(_unused_keys(engine, section).intersection(given or ()))
        if unused:
            reason = f"has '{unused[0]}', which engine '{engine}' does not use; remove it"
            raise PydanticCustomError("unused", "{reason}", {"reason": reason})
        return value

    @model_serializer(mode="wrap")
    def _only_what_is_used(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """The table without what the engine does not use, so that it can be read back."""
        table: dict[str, Any] = handler(self)
        sections = _sections_of(self.engine)
        for section in {*_OWN_SECTIONS, *_SMOOTHER_SECTIONS}.intersection(table):
            if section not in sections:
                del table[section]
            elif isinstance(table[section], dict):
                unused = _unused_keys(self.engine, section)
                table[section] = {k: v for k, v in table[section].items() if k not in unused}
        return table
