# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of maps: laws of its prior and its world, and the command."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from map_flights import World
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from slam_graph.bundle_adjustment.bal_cost import moved, reprojection_errors
from slam_graph.bundle_adjustment.bal_policy import BalStepsPolicy, Intrinsics
from slam_graph.bundle_adjustment.bal_prior import camera_residuals, linearized_prior
from slam_graph.bundle_adjustment.bal_problem import rays_of
from slam_graph.cli.main import app
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError, SlamGraphError
from slam_graph.geometry.trajectory_alignment import umeyama
from slam_graph.maps.map_adjustment import adjust_map, bundle_of
from slam_graph.maps.map_config import MapBalPolicy, MapCostPolicy, MapPriorPolicy
from slam_graph.maps.map_file import read_map
from slam_graph.maps.map_model import NO_FEATURE, SlamMap
from slam_graph.pose_graph.graph import Poses
from slam_graph.results.map_output import MAP_NAME, save_map

VIEWS = range(8)
TIGHT = BalStepsPolicy(tolerance=1e-12)
PRIOR = MapPriorPolicy(position_sigma=2e-3)
FILES = {
    MAP_NAME,
    "trajectory.tum",
    "config.yaml",
    "metrics.json",
    "scene.ply",
    "bundle_adjustment.png",
    "run.log",
}


@pytest.fixture(scope="module")
def true() -> SlamMap:
    """A map without any error."""
    return World().map(VIEWS)


def perturbed(
    true: SlamMap, seed: int = 0, factor: float = 1.0, prior: MapPriorPolicy = PRIOR
) -> SlamMap:
    """The map as far off as its prior says."""
    rng = np.random.default_rng(seed)
    turns = factor * prior.rotation_sigma * rng.standard_normal((len(true), 3))
    ways = factor * prior.position_sigma * rng.standard_normal((len(true), 3))
    distance = np.linalg.norm(true.points - true.poses.translations.mean(axis=0), axis=1)
    off = factor * prior.point_sigma * distance[:, None] * rng.standard_normal(true.points.shape)
    rotations = Rotation.from_rotvec(turns).as_matrix() @ true.poses.rotations
    poses = Poses(rotations, true.poses.translations + ways)
    return replace(true, poses=poses, points=true.points + off)


def similar(content: SlamMap, scale: float, turn: list[float], shift: list[float]) -> SlamMap:
    """The map in another world."""
    Q = Rotation.from_rotvec(turn).as_matrix()
    mount = content.recordings[0].rig.cameras[0].body_T_camera.translation()
    levers = content.poses.rotations @ mount
    cameras = scale * (content.poses.translations + levers) @ Q.T + shift
    poses = Poses(Q @ content.poses.rotations, cameras - levers @ Q.T)
    return replace(content, poses=poses, points=scale * content.points @ Q.T + shift)


def off(one: SlamMap, other: SlamMap) -> tuple[float, float]:
    """How far keyframes and features are from each other, root mean squares."""
    pairs = ((one.poses.translations, other.poses.translations), (one.points, other.points))
    keyframes, points = (float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1)))) for a, b in pairs)
    return keyframes, points


def test_a_map_and_its_problem_see_the_same(true: SlamMap) -> None:
    problem = bundle_of(true, PRIOR)
    assert reprojection_errors(problem, problem.estimates).max() < 1e-9
    assert problem.cameras == len(VIEWS)
    assert len(problem.camera) == np.count_nonzero(true.features >= 0)


def test_derivatives_of_the_prior(true: SlamMap) -> None:
    prior = bundle_of(true, PRIOR).prior
    assert prior is not None
    estimates = bundle_of(perturbed(true, factor=100.0), PRIOR).estimates
    by_pose, r = linearized_prior(prior, estimates)
    np.testing.assert_allclose(r, camera_residuals(prior, estimates))
    for k in range(6):
        along = np.zeros((len(true), 9))
        along[:, k] = 1e-6
        still = np.zeros_like(true.points)
        there, back = (
            camera_residuals(prior, moved(estimates, sign * along, still)) for sign in (1, -1)
        )
        expected = (there - back) / 2e-6
        np.testing.assert_allclose(by_pose[:, :, k], expected, rtol=1e-4, atol=1e-2)


def test_perturbed_maps_go_back_to_the_truth(true: SlamMap) -> None:
    before, after = [], []
    for seed in range(5):
        start = perturbed(true, seed)
        done = adjust_map(start, MapBalPolicy(prior=PRIOR))
        minimum = done.solution.minimum
        assert minimum.converged
        assert minimum.cost < 0.05 * minimum.start_cost
        before.append(off(start, true))
        after.append(off(done.after, true))
    assert np.linalg.norm(after, axis=0)[0] < 0.75 * np.linalg.norm(before, axis=0)[0]
    assert np.linalg.norm(after, axis=0)[1] < 0.2 * np.linalg.norm(before, axis=0)[1]


def test_maps_as_far_off_as_the_default_prior_come_nearer(true: SlamMap) -> None:
    before, after = [], []
    for seed in range(5):
        start = perturbed(true, seed, prior=MapPriorPolicy())
        before.append(off(start, true))
        after.append(off(adjust_map(start).after, true))
    assert np.all(np.array(after)[:, 0] < np.array(before)[:, 0])
    assert np.linalg.norm(after, axis=0)[1] < 0.2 * np.linalg.norm(before, axis=0)[1]


def test_without_a_prior_the_truth_is_found_up_to_the_gauge(true: SlamMap) -> None:
    nothing = MapPriorPolicy(rotation_sigma=1e3, position_sigma=1e3, point_sigma=1e3)
    found = adjust_map(perturbed(true), MapBalPolicy(prior=nothing)).after
    twice = np.asarray(true.seen_by.sum(axis=0)).ravel() > 1  # once says nothing of the distance
    points = found.points[twice]
    gauge = umeyama(true.points[twice], points, with_scale=True)
    points = gauge.scale * points @ gauge.rotation.T + gauge.translation
    np.testing.assert_allclose(points, true.points[twice], atol=1e-4)


@pytest.mark.parametrize(
    ("scale", "turn"), [(1.0, [0.0, 0.0, 0.0]), (1.05, [0.0, 0.0, 1.0]), (0.9, [0.2, -0.3, 2.0])]
)
def test_scale_and_world_are_those_of_the_map(
    true: SlamMap, scale: float, turn: list[float]
) -> None:
    # all these fit the images perfectly: nothing may move along the gauge
    elsewhere = similar(true, scale, turn, [5.0, -3.0, 1.0])
    done = adjust_map(elsewhere, MapBalPolicy(gauss_newton=TIGHT))
    assert max(off(done.after, elsewhere)) < 1e-7
    # and keyframes of a map with errors stay where their prior says
    start = perturbed(elsewhere)
    found = adjust_map(start, MapBalPolicy(prior=PRIOR)).after
    assert off(found, start)[0] < 2.0 * np.sqrt(3.0) * PRIOR.position_sigma
    turns = Rotation.from_matrix(found.poses.rotations @ start.poses.rotations.transpose(0, 2, 1))
    assert np.sqrt(np.mean(turns.magnitude() ** 2)) < 2.0 * np.sqrt(3.0) * PRIOR.rotation_sigma


def test_what_is_found_turns_with_the_world(true: SlamMap) -> None:
    start, world = perturbed(true), (1.0, [0.1, 0.2, 1.0], [5.0, -3.0, 1.0])
    policy = MapBalPolicy(gauss_newton=TIGHT)
    here, there = (adjust_map(x, policy).after for x in (start, similar(start, *world)))
    assert max(off(there, similar(here, *world))) < 1e-6


@pytest.mark.parametrize("intrinsics", ["shared", "per_camera"])
def test_intrinsics_are_those_of_recordings(true: SlamMap, intrinsics: Intrinsics) -> None:
    second = len(true) // 2
    (recording,) = true.recordings
    numbers = (np.arange(len(true)) >= second).astype(np.int64)
    two = replace(true, recordings=(recording, recording), recording_of=numbers)
    wrong = (two.keyframe_of >= second) | (intrinsics == "shared")
    rays = np.where(wrong[:, None], 1.02, 1.0) * two.normalized
    policy = MapBalPolicy(cost=MapCostPolicy(intrinsics=intrinsics), gauss_newton=TIGHT)
    done = adjust_map(replace(two, normalized=rays), policy)
    ratios = (
        done.solution.estimates.intrinsics[:, 0] / done.solution.problem.estimates.intrinsics[0, 0]
    )
    expected = np.where((numbers > 0) | (intrinsics == "shared"), 1.02, 1.0)
    np.testing.assert_allclose(ratios, expected, atol=1e-5)
    np.testing.assert_allclose(done.after.normalized, true.normalized, atol=1e-5)


def test_rays_are_where_distorted_pixels_come_from() -> None:
    rays = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 2))
    rays[0] = 0.0
    f, k1, k2 = 450.0, -0.1, 0.02
    q = np.sum(rays**2, axis=1, keepdims=True)
    pixels = f * (1.0 + k1 * q + k2 * q**2) * rays
    np.testing.assert_allclose(rays_of(pixels, np.tile([f, k1, k2], (50, 1))), rays, atol=1e-12)


def test_nothing_observed_is_refused_and_a_second_time_is_warned_of(true: SlamMap) -> None:
    unseen = replace(true, features=np.full_like(true.features, NO_FEATURE))
    with pytest.raises(DataError, match="none of the map's features"):
        adjust_map(unseen)
    diagnostics = Diagnostics()
    adjust_map(adjust_map(true, None, diagnostics).after, None, diagnostics)
    assert dict(diagnostics.counts) == {"map_adjusted_before": 1}


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["optimize", *map(str, arguments)])


def test_the_command_writes_everything(
    true: SlamMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "t"
    run.mkdir(parents=True)
    save_map(perturbed(true), run / MAP_NAME)
    os.symlink("t", run.parent / "latest")
    done = call(run.parent, "--save", "best.slam", "--json")
    assert done.exit_code == 0, done.output
    table = json.loads(done.stdout)
    folder = tmp_path / "results" / "wall_map" / "latest"
    assert {path.name for path in folder.iterdir()} == FILES
    assert (tmp_path / "best.slam").read_bytes() == (folder / MAP_NAME).read_bytes()
    assert table["cost"]["after"] < table["cost"]["before"]
    assert table["reprojection_px"]["after"]["rmse"] < table["reprojection_px"]["before"]["rmse"]
    assert (table["converged"], table["intrinsics"], table["robust"]) == (True, "fixed", "huber")
    written = read_map(folder / MAP_NAME)
    assert written.recordings[0].poses == "adjusted"
    assert off(written, true)[1] < 0.2 * off(perturbed(true), true)[1]
    tum = np.loadtxt(folder / "trajectory.tum")
    np.testing.assert_allclose(tum[:, 1:4], written.poses.translations, atol=1e-8)
    again = call(run / MAP_NAME, "--config", folder / "config.yaml", "--format", "map", "--json")
    assert json.loads(again.stdout)["cost"] == table["cost"]
    save_map(true, tmp_path / "place.slam")
    shown = call("place.slam", "--set", "prior.position_sigma=0.1", "--intrinsics", "shared")
    assert "8 keyframes" in shown.stdout
    assert (tmp_path / "results" / "place" / "latest" / MAP_NAME).is_file()


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["empty"], 1, "--save-map"),
        (["text.txt", "--format", "map"], 1, "not a slam_graph map"),
        (["unseen.slam"], 1, "none of the map's features"),
        (["good.slam", "--certify"], 2, "is for pose graphs"),
        (["good.slam", "--robust", "gnc"], 2, "huber"),
        (["good.slam", "--save", "unseen.slam"], 1, "--force"),
        (["good.slam", "--set", "prior.position_sigma=0"], 2, "prior.position_sigma"),
    ],
)
def test_faults_have_their_exit_code_and_leave_nothing(
    true: SlamMap,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    code: int,
    text: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("1 2 3\n")
    save_map(true, tmp_path / "good.slam")
    unseen = replace(true, features=np.full_like(true.features, NO_FEATURE))
    save_map(unseen, tmp_path / "unseen.slam")
    error = call(*arguments).exception
    assert isinstance(error, SlamGraphError)
    assert error.exit_code == code
    assert text in str(error)
    assert not (tmp_path / "results").exists()
