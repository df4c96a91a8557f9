# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph simulate`: a simulated recording with exact ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from slam_graph.cli.console import ProgressBar, echo_json, echo_table
from slam_graph.cli.options import ConfigFile, Json, Overrides

if TYPE_CHECKING:
    from slam_graph.datasets import SequenceInfo

Kind = Literal["tracks", "images"]
Depth = Literal["none", "stereo", "kinect"]


def simulate(
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="Folder to write.")],
    kind: Annotated[
        Kind | None, typer.Option("--kind", help="Feature tracks, or an EuRoC folder of images.")
    ] = None,
    trajectory: Annotated[
        str | None,
        typer.Option(
            "--trajectory",
            metavar="figure8|rooms|random|car|PATH",
            help="A made-up trajectory, or a ground truth or EuRoC folder to fly along.",
        ),
    ] = None,
    real_imu: Annotated[
        bool | None, typer.Option("--real-imu", help="Use the IMU that was recorded there.")
    ] = None,
    cameras: Annotated[
        int | None, typer.Option("--cameras", help="Number of cameras of the rig.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="Kalibr YAML of the rig.")
    ] = None,
    depth: Annotated[
        Depth | None, typer.Option("--depth", help="Depth of what the first camera sees.")
    ] = None,
    imu: Annotated[
        bool | None,
        typer.Option("--imu/--no-imu", help="With an IMU, by default.", show_default=False),
    ] = None,
    shutter_readout: Annotated[
        float | None,
        typer.Option("--shutter-readout", help="Readout time of rolling shutters, seconds."),
    ] = None,
    gnss: Annotated[
        float | None, typer.Option("--gnss", help="Position fixes with this sigma, metres.")
    ] = None,
    multipath: Annotated[
        float | None, typer.Option("--multipath", help="Share of fixes that are off by 10 m.")
    ] = None,
    odometry: Annotated[
        bool | None, typer.Option("--odometry", help="Odometry of wheels.", show_default=False)
    ] = None,
    start: Annotated[
        float | None, typer.Option("--start", help="Seconds into a recorded trajectory.")
    ] = None,
    duration: Annotated[float | None, typer.Option("--duration", help="Seconds to fly.")] = None,
    rate: Annotated[float | None, typer.Option("--rate", help="Frames in a second.")] = None,
    features: Annotated[
        int | None, typer.Option("--features", help="Most features in an image.")
    ] = None,
    pixel_sigma: Annotated[
        float | None, typer.Option("--pixel-sigma", help="Noise of features, pixels.")
    ] = None,
    outliers: Annotated[
        float | None, typer.Option("--outliers", help="Share of wrong observations.")
    ] = None,
    loss: Annotated[
        float | None, typer.Option("--loss", help="Probability that a track ends at a frame.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of random numbers.")] = None,
    world_seed: Annotated[
        int | None,
        typer.Option(
            "--world-seed", help="Seed of the place, for several flights through one; see --seed."
        ),
    ] = None,
    config: ConfigFile = None,
    set_: Overrides = None,
    progress: Annotated[
        bool, typer.Option("--progress/--no-progress", help="Show progress on stderr.")
    ] = True,
    as_json: Json = False,
) -> None:
    """Simulate a flight: IMU, and feature tracks or rendered images, with their exact truth.

    OUTPUT is then a recording like any other. The same settings and seed write the same bytes.
    """
    from slam_graph.datasets import EurocWriter
    from slam_graph.simulation import simulate as make

    tracks = {
        "features": features,
        "pixel_sigma": pixel_sigma,
        "outliers": outliers,
        "loss": loss,
    }
    fixes = {"sigma_m": gnss, "multipath": multipath}
    given: dict[str, Any] = {
        "kind": kind,
        "trajectory": trajectory,
        "real_imu": real_imu,
        "cameras": cameras,
        "calibration": calibration,
        "depth": None if depth is None else {"sensor": depth},
        "with_imu": imu,
        "gnss": _given(fixes),
        "odometry": None if odometry is None else {"enabled": odometry},
        "shutter_readout_s": shutter_readout,
        "start_s": start,
        "duration_s": duration,
        "rate_hz": rate,
        "seed": seed,
        "world_seed": world_seed,
        "tracks": _given(tracks),
    }
    EurocWriter.refuse_existing(output)
    sequence = make(config, set_ or (), **given)
    info = sequence.info()
    with ProgressBar(info.start_ns, info.end_ns) if progress else nullcontext() as bar:
        sequence.save(output, None if bar is None else lambda t: bar.advance(t, True))
    report = sequence.flight.report
    path = {} if report is None else {"path": report.as_dict()}
    _report(sequence.info(), path, {} if report is None else report.lines(), output, as_json)


def _given(options: Mapping[str, Any]) -> dict[str, Any] | None:
    """The options of a table that were given; None if none was."""
    return {name: value for name, value in options.items() if value is not None} or None


def _report(
    info: SequenceInfo, path: Mapping[str, Any], lines: Mapping[str, str], output: Path, json: bool
) -> None:
    """Print what was simulated.

    Args:
        info: the recording.
        path: what is known of a recorded path that was flown, as it is printed by `--json`.
        lines: the same in words.
        output: where the recording is.
        json: whether to print JSON.
    """
    if json:
        echo_json({"folder": str(output), **asdict(info), **path})
        return
    rows = {
        "folder": str(output),
        "content": f"{info.frames} frames of {info.content}, {info.cameras} cameras",
        "duration": f"{(info.end_ns - info.start_ns) * 1e-9:.2f} s",
        "IMU": f"{info.imu_samples} samples" if info.has_imu else "none",
    }
    if info.has_depth:
        rows["depth"] = "of the first camera"
    echo_table((rows | dict(lines)).items())
