# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Other systems beside this one, on the same clip, in the same run and on one core.

Each runs in a process of its own, in a virtual environment of its own below the folder that
`SLAM_GRAPH_PEERS` names; where there is none it is left out with a note. Nothing is installed, and
nothing of them is imported here (`docs/performance.md` says how to make the environments).

Costs are CPU times of all threads, without the decoding of images, in flows that the same process
times between the frames. Causal figures are of the poses that a system gives frame by frame; final
ones of those that it gives at its end. ORB-SLAM3 counts from where its map is aligned with gravity.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.metric import Metric, info
from benchmarks.peer_clip import CAUSAL_FILE, COSTS_FILE, FINAL_FILE
from benchmarks.peer_orbslam3 import VOCABULARY_VARIABLE
from benchmarks.running import Errors, Run
from benchmarks.speed import ONE_THREAD, RECORDING, UNIT, parts, worker
from benchmarks.suite import CORE, Benchmark, Outcome
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.geometry.trajectory import Trajectory

PEERS_VARIABLE = "SLAM_GRAPH_PEERS"
TRAINING = ("tum_rgbd/freiburg1_rpy_12s/rgb", "euroc/V1_01_easy_static_2s/mav0/cam0/data")
"""Folders of images, not of the clip, on which the vocabulary of ORB-SLAM3 is trained."""
LIMIT_S = 600.0
"""Against a peer that hangs."""


@dataclass(frozen=True, slots=True)
class Peer:
    """Another system.

    Attributes:
        name: of its environment below the folder of peers, and in tables.
        package: what is installed there.
        trained: whether its program takes folders of images for training.
    """

    name: str
    package: str
    trained: bool = False

    @property
    def program(self) -> str:
        """The module that runs it."""
        return f"benchmarks.peer_{self.name}"


PEERS = (Peer("orbslam3", "pyorbslam3==0.1.1", trained=True), Peer("cuvslam", "dim-odom==0.4.2"))


def measure(data: Path) -> Outcome:
    """Costs and errors of ours and of the peers that are there."""
    outcome, truth = Outcome(), read_groundtruth(data / RECORDING)
    for name in CORE:
        outcome.add(name, own(data / RECORDING, name, truth), judged=False)
    for peer in PEERS:
        python = interpreter(peer)
        if python is None:
            outcome.notes.append(f"{peer.name}: left out, as {where(peer)} is not there")
            continue
        with tempfile.TemporaryDirectory() as folder:
            failure = run(peer, python, data, Path(folder))
            if failure:
                outcome.notes.append(f"{peer.name}: left out: {failure}")
            else:
                outcome.add(peer.name, theirs(Path(folder), truth), judged=False)
    outcome.notes.append(
        "costs: CPU time of all threads on one core without decoding; ATE and orientation after "
        "alignment in SE(3); the vocabulary of ORB-SLAM3 is small, trained on other images"
    )
    return outcome


def own(recording: Path, name: str, truth: Trajectory) -> list[Metric]:
    """Cost of the causal part; errors of the causal estimate, and of the one after adjustment."""
    timed = worker("benchmarks.speed_worker", "interleaved", str(recording), name)
    cost = next(m for m in parts(timed) if m.key == "cost_mean")
    done = Run(recording, name, 2, final_ba=True)
    figures = [info("cost", cost.value, UNIT), *errors("causal", truth, done.result.trajectory)]
    final = done.result.smoothed
    return figures if final is None else figures + errors("final", truth, final)


def theirs(folder: Path, truth: Trajectory) -> list[Metric]:
    """The same of what a peer has written."""
    table = json.loads((folder / COSTS_FILE).read_text(encoding="utf-8"))
    unit_ms, frames = float(np.median(table["reference"])), len(table["frame"])
    frame_ms = table["all_threads_ms"] / frames
    figures = [info("cost", frame_ms / unit_ms, UNIT), info("frame", frame_ms, "ms CPU")]
    for kind, file in (("causal", CAUSAL_FILE), ("final", FINAL_FILE)):
        if (folder / file).is_file():
            figures += errors(kind, truth, read_groundtruth(folder / file))
    return figures


def errors(kind: str, truth: Trajectory, estimate: Trajectory) -> list[Metric]:
    """Errors after alignment in SE(3), and the time that the estimate covers."""
    found = Errors.of(truth, estimate, "se3")
    return [
        info(f"{kind}.ate", found.position_m, "m"),
        info(f"{kind}.orientation", found.orientation_deg, "deg"),
        info(f"{kind}.coverage", found.span_s, "s"),
    ]


def run(peer: Peer, python: Path, data: Path, folder: Path) -> str:
    """Run a peer over the clip; it writes its files into a folder.

    Returns:
        Why it could not be measured; empty if it could.
    """
    arguments = [str(data / RECORDING), str(folder)]
    if peer.trained:
        found = [str(data / name) for name in TRAINING if (data / name).is_dir()]
        if not found and VOCABULARY_VARIABLE not in os.environ:
            return f"no images to train its vocabulary on: {data / TRAINING[0]} is not there"
        arguments += found
    root = Path(__file__).resolve().parent.parent
    try:
        done = subprocess.run(
            [python, "-m", peer.program, *arguments],
            cwd=root,
            env=environment(root),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        return f"not done after {LIMIT_S:g} s"
    if done.returncode == 0 and (folder / COSTS_FILE).is_file():
        return ""
    said: Sequence[str] = done.stderr.strip().splitlines() or ["no message"]
    return f"exit code {done.returncode}: {said[-1]}"


def environment(root: Path) -> dict[str, str]:
    """Variables of a peer's process: one thread in libraries, and only this folder to import."""
    return os.environ | ONE_THREAD | {"PYTHONPATH": str(root)}


def interpreter(peer: Peer) -> Path | None:
    """The Python of a peer's environment; None if there is none."""
    folder = os.environ.get(PEERS_VARIABLE)
    python = Path(folder or "") / peer.name / "bin" / "python"
    return python if folder and python.is_file() else None


def where(peer: Peer) -> str:
    """Where the environment of a peer should be, as a reader would look for it."""
    return f"{os.environ.get(PEERS_VARIABLE, f'${PEERS_VARIABLE}')}/{peer.name} ({peer.package})"


BENCHMARKS = {
    "peers": Benchmark(
        "MH_01 stereo beside ORB-SLAM3 and cuVSLAM where they are installed: cost, ATE, "
        f"orientation ({PEERS_VARIABLE} names their environments)",
        (RECORDING,),
        measure,
    )
}
