# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Localization in a map: the filter's laws, agreement, and what happens where the map misleads."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from groups import slow
from map_flights import World

from slam_graph.errors import DataError
from slam_graph.loop_closure.loop_config import LoopClosureConfig
from slam_graph.maps.map_config import LocalizationConfig
from slam_graph.maps.map_localization import MapLocalizer, MapPoseFilter, with_roll_and_pitch
from slam_graph.maps.map_places import MapPlaces

CONFIG = LocalizationConfig()
SIGMAS = np.array([0.004] * 3 + [0.02] * 3)


def random_pose(rng: np.random.Generator, tilt: float = 0.3) -> gtsam.Pose3:
    yaw, pitch, roll = rng.uniform([-3, -tilt, -tilt], [3, tilt, tilt])
    return gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), rng.uniform(-2, 2, 3))


def noisy(pose: gtsam.Pose3, sigmas: np.ndarray, rng: np.random.Generator) -> gtsam.Pose3:
    turn, shift = np.split(rng.normal(0.0, sigmas), 2)
    return pose.compose(gtsam.Pose3(gtsam.Rot3.Expmap(turn), shift))


@pytest.mark.parametrize("level", [True, slow(False)])
def test_the_filter_is_as_wrong_as_it_says(level: bool) -> None:
    """NEES over many flights with odometry that drifts and matchs that are off as they say."""
    config = CONFIG.model_copy(update={"map_rotation_sigma": 1e-6, "map_position_sigma": 1e-6})
    rng, size, values = np.random.default_rng(1), 4 if level else 6, []
    for _ in range(150):
        map_T_odom = gtsam.Pose3(gtsam.Rot3.Rz(rng.uniform(-3, 3)), rng.uniform(-5, 5, 3))
        true = random_pose(rng)
        odom, filter_ = map_T_odom.inverse().compose(true), None
        for step in range(40):
            if step:
                following = random_pose(rng)
                pace = gtsam.Pose3(
                    following.rotation(), true.translation() + rng.normal(0.0, 0.5, 3)
                )
                moved = true.between(pace)
                true = pace
                # the run drifts in yaw and position; roll and pitch are right
                yaw = rng.normal(0.0, config.odometry_rotation_sigma * np.sqrt(0.2))
                shift = rng.normal(0.0, config.odometry_position_sigma * np.sqrt(0.2), 3)
                odom = odom.compose(moved)
                odom = gtsam.Pose3(
                    gtsam.Rot3.Rz(yaw).compose(odom.rotation()), odom.translation() + shift
                )
                if not level:
                    tilt = rng.normal(0.0, config.odometry_rotation_sigma * np.sqrt(0.2), 2)
                    turn = gtsam.Rot3.Expmap(np.array([*tilt, 0.0]))
                    odom = gtsam.Pose3(turn.compose(odom.rotation()), odom.translation())
            match = noisy(true, SIGMAS, rng)
            stamp_ns = step * 200_000_000
            if filter_ is None:
                covariance = np.diag(SIGMAS**2)
                filter_ = MapPoseFilter(config, level, odom, match, covariance, stamp_ns)
                continue
            filter_.move(stamp_ns, odom)
            if step % 4 == 0:
                filter_.correct(match, np.diag(SIGMAS**2))
        assert filter_ is not None
        turn = gtsam.Rot3.Logmap(true.rotation().compose(filter_.pose.rotation().inverse()))
        angle = turn[2:] if level else turn
        error = np.concatenate([angle, true.translation() - filter_.pose.translation()])
        values.append(error @ np.linalg.solve(filter_.covariance, error))
    # the mean of 150 χ² values over their degrees of freedom
    assert np.mean(values) / size == pytest.approx(1.0, abs=0.3)


def test_roll_and_pitch_are_those_of_the_run() -> None:
    rng = np.random.default_rng(0)
    odom, match = random_pose(rng), random_pose(rng)
    filter_ = MapPoseFilter(CONFIG, True, odom, match, np.diag(SIGMAS**2), 0)
    for step in range(1, 10):
        odom = random_pose(rng)
        filter_.move(step * 10**8, odom)
        filter_.correct(noisy(filter_.pose, 10 * SIGMAS, rng), np.diag(SIGMAS**2))
        np.testing.assert_allclose(
            filter_.pose.rotation().matrix()[2], odom.rotation().matrix()[2], atol=1e-12
        )
    assert with_roll_and_pitch(odom, odom).equals(odom, 1e-12)


@pytest.fixture(scope="module")
def world() -> World:
    return World()


def localizer(world: World, **changes: float) -> MapLocalizer:
    config = CONFIG.model_copy(update={"period_s": 0.0, **changes})
    return MapLocalizer(world.map(), world.rig, LoopClosureConfig(), config)


ODOM_T_MAP = gtsam.Pose3(gtsam.Rot3.Rz(2.0), np.array([30.0, -7.0, 4.0]))


def fly(
    world: World,
    located: MapLocalizer,
    number: int,
    steps: range,
    odom_T_map: gtsam.Pose3 = ODOM_T_MAP,
) -> list[float]:
    """Errors of positions along a path; the world of the run is another than the map's."""
    errors = []
    for step in steps:
        pose = odom_T_map.compose(world.pose(number + step))
        view = world.view(number + step, pose)
        located.move(view.stamp_ns, pose)
        if located.wants(view.stamp_ns):
            located.match(view)
        if located.located and located.filter is not None:
            away = located.filter.pose.translation() - world.pose(number + step).translation()
            errors.append(float(np.linalg.norm(away)))
    return errors


def test_a_run_is_located_once_three_matchs_agree(world: World) -> None:
    located = localizer(world)
    errors = fly(world, located, 0, range(5))
    assert len(errors) == 3
    assert max(errors) < 1e-6
    assert (located.queries, located.accepted, located.starts) == (5, 5, 1)


def test_the_calibration_of_the_map_does_not_matter(world: World) -> None:
    """Points are what they are, whichever camera has found them."""
    known = world.map()
    strange = replace(known.recordings[0], rig=world.rig.select(1))
    camera = replace(strange.rig.cameras[0], body_T_camera=gtsam.Pose3())
    strange = replace(strange, rig=replace(strange.rig, cameras=(camera,)))
    poses = []
    for content in (known, replace(known, recordings=(strange,))):
        places = MapPlaces(content, world.rig, LoopClosureConfig(), 10)
        match = places.locate(world.view(2), 1, gravity=True)
        assert match is not None
        poses.append(match.world_T_body)
    assert poses[0].equals(poses[1], 1e-12)
    assert poses[0].equals(world.pose(2), 1e-3)


def test_a_run_without_an_imu_is_located_however_its_world_is_tilted(world: World) -> None:
    """Its roll and pitch mean nothing, also where those of the map do."""
    known, rig = replace(world.map(), gravity_aligned=True), world.rig.without_imu()
    config = CONFIG.model_copy(update={"period_s": 0.0})
    located = MapLocalizer(known, rig, LoopClosureConfig(), config)
    tilted = gtsam.Pose3(gtsam.Rot3.Rx(1.6), np.array([30.0, -7.0, 4.0]))
    assert max(fly(world, located, 0, range(5), tilted)) < 0.05
    assert located.starts == 1


def test_a_run_that_begins_anew_is_located_in_the_index_that_is_there(world: World) -> None:
    located = localizer(world)
    fly(world, located, 0, range(4))
    places = located.places
    located.restart(world.rig)
    assert located.places is places
    assert located.filter is None
    assert located.queries == 4, "all are counted"
    assert max(fly(world, located, 1, range(4))) < 0.05
    assert located.starts == 2


def test_a_false_match_is_left_out(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    located = localizer(world)
    fly(world, located, 0, range(3))
    right = MapPlaces.locate

    def wrong(self: MapPlaces, *arguments: object, **options: object) -> object:
        match = right(self, *arguments, **options)  # type: ignore[arg-type]
        if match is None:
            return None
        shift = gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 0.5, 0.0]))
        return replace(match, world_T_body=shift.compose(match.world_T_body))

    monkeypatch.setattr(MapPlaces, "locate", wrong)
    assert max(fly(world, located, 0, range(3, 5))) < 1e-6
    assert located.starts == 1
    # if they go on and agree with each other, it is the filter that is wrong
    fly(world, located, 0, range(3, 5))
    assert located.starts == 2


def test_who_has_been_carried_off_is_found_again(world: World) -> None:
    located = localizer(world)
    fly(world, located, 0, range(2, 5))
    far = gtsam.Pose3(gtsam.Rot3.Rz(-1.0), np.array([50.0, 0.0, 0.0]))
    errors = []
    for step in range(4):  # the run's own world has moved, as after a reset
        view = world.view(step)
        pose = far.compose(world.pose(step))
        view = replace(view, world_T_body=pose, stamp_ns=view.stamp_ns + 10**10)
        located.move(view.stamp_ns, pose)
        located.match(view)
        assert located.filter is not None
        away = located.filter.pose.translation() - world.pose(step).translation()
        errors.append(float(np.linalg.norm(away)))
    assert located.starts == 2
    assert errors[0] > 1.0
    assert max(errors[2:]) < 1e-6


def test_odometry_that_makes_no_sense_leaves_it_lost(world: World) -> None:
    """A run that has diverged contradicts every match, and the matchs each other."""
    located = localizer(world)
    fly(world, located, 0, range(3))
    assert located.located
    rng = np.random.default_rng(0)
    for step in range(8):
        view = world.view(step % 5)
        pose = gtsam.Pose3(ODOM_T_MAP.compose(world.pose(step % 5)).rotation(), rng.normal(size=3))
        stamp_ns = (10 + step) * 10**9
        located.move(stamp_ns, pose)
        located.match(replace(view, world_T_body=pose, stamp_ns=stamp_ns))
    assert not located.located
    assert located.starts == 1


def test_it_is_lost_when_nothing_has_been_seen_for_long(world: World) -> None:
    located = localizer(world, odometry_position_sigma=0.1)
    fly(world, located, 0, range(3))
    assert located.located
    located.move(60 * 10**9, ODOM_T_MAP)
    assert not located.located
    assert located.wants(60 * 10**9 + 1)


def test_descriptors_of_another_kind_are_refused(world: World) -> None:
    places = MapPlaces(world.map(), world.rig, LoopClosureConfig(), 10)
    with pytest.raises(DataError, match=r"flight.*512 bits.*256"):
        places.check(np.zeros((3, 64), np.uint8), "flight")
