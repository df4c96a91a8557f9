# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of real trajectories agree with evo's, run in a subprocess as an independent oracle."""

import json
import subprocess
import sys
import zipfile
from dataclasses import asdict
from pathlib import Path

import pytest
from groups import slow

from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.evaluation.relative_pose_error import rpe

RELATIVE_TOLERANCE = 1e-9
PEERS = ["openvins_stereo", "okvis2_slam_causal"]

APE_CASES = [
    (["-r", "trans_part"], {}),
    (["-r", "full", "-a"], {"relation": "full", "alignment": "se3"}),
    (["-r", "rot_part"], {"relation": "rot_part"}),
    (["-r", "angle_rad", "-a", "-s"], {"relation": "angle_rad", "alignment": "sim3"}),
    (["-s"], {"alignment": "scale"}),
    (["-a", "--t_max_diff", "0.001"], {"alignment": "se3", "limit_s": 0.001}),
]
RPE_CASES = [
    ([], {}),
    (["-d", "20", "-r", "angle_deg"], {"delta": 20, "relation": "angle_deg"}),
    (
        ["-d", "20", "--all_pairs", "-r", "full"],
        {"delta": 20, "all_pairs": True, "relation": "full"},
    ),
    (["-d", "1", "-u", "m", "-a", "-s"], {"unit": "m", "alignment": "sim3"}),
    (["-d", "0.5", "-u", "m", "--all_pairs"], {"delta": 0.5, "unit": "m", "all_pairs": True}),
    (
        ["-d", "10", "-u", "d", "--pairs_from_reference"],
        {"delta": 10, "unit": "d", "pairs_from_reference": True},
    ),
    (["-d", "0.2", "-u", "r", "--all_pairs"], {"delta": 0.2, "unit": "r", "all_pairs": True}),
]
"""Command lines of evo, and the same question to our functions."""


def evo(metric: str, tmp_path: Path, reference: Path, estimate: Path, options: list[str]) -> dict:
    command = Path(sys.executable).with_name(f"evo_{metric}")
    if not command.exists():
        pytest.fail(f"{command} not found: install the dev extra")
    saved = tmp_path / "evo.zip"
    subprocess.run(
        [command, "euroc", reference, estimate, *options, "--save_results", saved, "--no_warnings"],
        check=True,
        capture_output=True,
        env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "MPLBACKEND": "Agg"},
    )
    with zipfile.ZipFile(saved) as archive:
        return json.loads(archive.read("stats.json"))


@pytest.fixture(scope="module")
def recording(data_dir: Path) -> Path:
    return data_dir / "euroc" / "MH_01_easy_17s"


@pytest.mark.data
@pytest.mark.parametrize(
    ("metric", "options", "arguments", "peer"),
    [
        (slow if index % 3 else pytest.param)(metric, *case, PEERS[index % len(PEERS)])
        for metric, cases in (("ape", APE_CASES), ("rpe", RPE_CASES))
        for index, case in enumerate(cases)
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_numbers_are_those_of_evo(
    tmp_path: Path, recording: Path, metric: str, options: list[str], arguments: dict, peer: str
) -> None:
    truth = recording / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    estimate = recording / "peers" / f"{peer}.tum"
    expected = evo(metric, tmp_path, truth, estimate, options)
    function = ape if metric == "ape" else rpe
    # evo compares with the true pose nearest in time
    poses = (read_groundtruth(truth), read_groundtruth(estimate))
    ours = function(*poses, pairing="nearest", **arguments)
    assert asdict(ours.statistics) == pytest.approx(expected, rel=RELATIVE_TOLERANCE, abs=1e-15)
