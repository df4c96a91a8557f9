# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What benchmarks of peers, of kernels and of growth are made of; no time is tested."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import growth, kernels, peer_clip, peer_vocabulary, peers
from slam_graph.datasets.groundtruth import read_groundtruth


def test_all_ways_to_reduce_features_agree() -> None:
    problem = kernels.made_up(6, 4, np.random.default_rng(1))
    figures = {m.key: m for m in kernels.timed(problem, rounds=1)}
    assert figures["error"].value < 1e-12


def test_a_flight_that_gets_dearer_shows() -> None:
    frames = np.concatenate([np.full(900, 2.0), np.full(100, 3.0)])
    costs = growth.costs_of_parts(frames, np.full(100, 4.0))
    np.testing.assert_allclose(costs, [0.5] * 9 + [0.75])
    slower = growth.costs_of_parts(
        np.linspace(1.0, 2.0, 1000), np.linspace(1.0, 2.0, 100)
    )  # the processor alone
    np.testing.assert_allclose(slower, 1.0, atol=0.01)


def test_poses_of_peers_are_read_as_written(tmp_path: Path) -> None:
    turns = Rotation.random(20, random_state=2)
    poses = []
    for k, turn in enumerate(turns):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn.as_matrix(), (k, -k, 0.5)
        poses.append((1403636584763555584 + 50_000_123 * k, T))
        np.testing.assert_allclose(
            peer_clip.rotation(peer_clip.quaternion(T[:3, :3])), T[:3, :3], atol=1e-12
        )
    peer_clip.write_tum(tmp_path / "poses.tum", poses)
    read = read_groundtruth(tmp_path / "poses.tum")
    np.testing.assert_array_equal(read.stamps_ns, [stamp for stamp, _ in poses])
    np.testing.assert_allclose(read.positions, [T[:3, 3] for _, T in poses], atol=1e-9)


def test_a_vocabulary_is_a_tree_of_as_many_lines_as_nodes(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    for k in range(3):
        image = cv2.resize(rng.integers(0, 255, (60, 80), np.uint8), (640, 480))
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    (tmp_path / "broken.png").write_bytes(b"no image")
    peer_vocabulary.train(sorted(tmp_path.glob("*.png")), tmp_path / "vocabulary.txt")
    text = (tmp_path / "vocabulary.txt").read_text()
    first, *nodes = text.split("\n")
    assert first.split() == ["10", "4", "0", "0"]
    assert len(nodes) > 100
    rows = [line.split() for line in nodes]
    assert {len(row) for row in rows} == {2 + 32 + 1}
    parents = [int(row[0]) for row in rows]
    leaves = {number for number, row in enumerate(rows, 1) if row[1] == "1"}
    assert all(parent < number for number, parent in enumerate(parents, 1))
    assert leaves == set(range(1, len(rows) + 1)) - set(parents)


def test_a_peer_without_environment_is_not_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = peers.PEERS[0]
    monkeypatch.delenv(peers.PEERS_VARIABLE, raising=False)
    assert peers.interpreter(peer) is None
    monkeypatch.setenv(peers.PEERS_VARIABLE, str(tmp_path))
    assert peers.interpreter(peer) is None
    assert str(tmp_path / peer.name) in peers.where(peer)


def test_a_peer_that_fails_says_why(tmp_path: Path) -> None:
    peer = peers.Peer("nobody", "none==0")
    failure = peers.run(peer, Path(sys.executable), tmp_path, tmp_path)
    assert "exit code 1" in failure
    assert "peer_nobody" in failure
