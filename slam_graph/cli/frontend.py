# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph frontend`: run the front end alone and draw its tracks; compare several."""

from __future__ import annotations

from contextlib import ExitStack
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from slam_graph.cli.console import echo_json, echo_table, number
from slam_graph.cli.options import (
    Calibration,
    Cameras,
    ConfigFile,
    Data,
    Duration,
    Format,
    Groundtruth,
    Json,
    Overrides,
    Sources,
    Start,
    open_recording,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from slam_graph.config import RunConfig
    from slam_graph.datasets import RecordedSequence
    from slam_graph.experiment import FrontendReport
    from slam_graph.sensors import FeatureFrame, Packet

_EVERYTHING = "klt,klt/harris,klt/fast,klt/dog,klt/surf,klt/orb,klt/brisk,sift,surf,orb,brisk,brief"


class _RunByDefault(TyperGroup):
    """A group whose first command is the default: `frontend DATA`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the name of the first command before arguments that do not begin with one."""
        if args and args[0] not in self.commands and args[0] != "--help":
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_RunByDefault,
    help="Run the front end alone and look at its tracks: `frontend DATA` is `frontend run DATA`.",
    no_args_is_help=True,
    rich_markup_mode="rich",
)


@app.command("run")
def run(
    data: Data,
    config: ConfigFile = None,
    set_: Overrides = None,
    cameras: Cameras = None,
    start: Start = None,
    duration: Duration = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="PNG of the middle frame with its tracks; tracks.png, or tracks-2.png and so on "
            "where that exists, if not given.",
            show_default=False,
        ),
    ] = None,
    video: Annotated[
        Path | None, typer.Option("--video", help="MP4 of all frames with their tracks.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option("--record", help="Folder to record the tracks to, for replay.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Let --picture and --video replace files.")
    ] = False,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
    as_json: Json = False,
) -> None:
    """Track a recording, report how good the tracks are, and draw them."""
    from slam_graph.config import load_config
    from slam_graph.experiment import FrontendReport
    from slam_graph.results import ResultFolder

    for path in (picture, video):
        if path is not None:
            ResultFolder.refuse_to_replace(path, force)
    picture = picture or _free_name(Path("tracks.png"))
    settings = load_config(config, set_ or (), cameras=cameras, start_s=start, duration_s=duration)
    sequence = open_recording(data, format_, calibration, groundtruth, sources, settings.cameras)
    with ExitStack() as stack:
        watch = _watch(sequence, settings, picture, video, record, stack)
        report = FrontendReport.of_tracks(sequence, settings, settings.frontend.method, watch)
    files = [str(path) for path in (picture, video, record) if path is not None]
    if as_json:
        echo_json({**_plain(report), "files": files})
        return
    echo_table(_lines(report))
    typer.echo("\n" + " ".join(files))


@app.command("compare")
def compare(
    data: Data,
    frontends: Annotated[
        str,
        typer.Option("--frontends", help="METHOD or METHOD/DETECTOR, with commas between."),
    ] = _EVERYTHING,
    algorithm: Annotated[
        str | None,
        typer.Option("--algorithm", help="Also estimate the trajectory from the tracks of each."),
    ] = None,
    config: ConfigFile = None,
    set_: Overrides = None,
    cameras: Cameras = None,
    start: Start = None,
    duration: Duration = None,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
    as_json: Json = False,
) -> None:
    """Run several front ends on one recording, and print a table."""
    from slam_graph.config import load_config
    from slam_graph.experiment import FrontendReport

    options = {"cameras": cameras, "start_s": start, "duration_s": duration, "algorithm": algorithm}
    reports = []
    runs = {  # all at once, so that a wrong name is found before the first run
        name: load_config(config, [*(set_ or ()), *changes], **options)
        for name, changes in _settings_of(n for n in frontends.split(",") if n).items()
    }
    for name, settings in runs.items():
        sequence = open_recording(
            data, format_, calibration, groundtruth, sources, settings.cameras
        )
        go = FrontendReport.of_tracks if algorithm is None else FrontendReport.of_run
        reports.append(go(sequence, settings, name))
        typer.echo(f"{name}: done", err=True)
    if as_json:
        echo_json([_plain(report) for report in reports])
    else:
        echo_table([_COLUMNS, *map(_row, reports)])


def _free_name(path: Path) -> Path:
    """The path, or the first with a number behind its name under which there is no file."""
    numbered = (path.with_stem(f"{path.stem}-{number}") for number in count(2))
    return next(found for found in chain([path], numbered) if not found.exists())


def _settings_of(names: Iterable[str]) -> dict[str, list[str]]:
    """The settings of front ends given as METHOD or METHOD/DETECTOR.

    Returns:
        Overrides for `load_config`, which refuses unknown ones, by name.
    """
    settings = {}
    for name in names:
        method, _, detector = name.partition("/")
        settings[name] = [f"frontend.method={method}"]
        settings[name] += [f"frontend.detector={detector}"] if detector else []
    return settings


def _watch(
    sequence: RecordedSequence,
    settings: RunConfig,
    picture: Path,
    video: Path | None,
    record: Path | None,
    stack: ExitStack,
) -> Callable[[Packet, FeatureFrame], None]:
    """A function that draws each frame, and records it if asked for."""
    from slam_graph.datasets import TrackRecorder
    from slam_graph.sensors import CameraFrame
    from slam_graph.visualization import TrackPictures

    recorder = labels = None
    info = sequence.info()
    if record is not None:
        labels = sequence.labels_over_time()
        truth, notes = sequence.groundtruth(), sequence.classes_file()
        recorder = stack.enter_context(
            TrackRecorder(record, sequence.rig, info.name, truth, notes=notes)
        )
    length_ns = info.end_ns - info.start_ns - round(settings.start_s * 1e9)
    if settings.duration_s is not None:
        length_ns = min(length_ns, round(settings.duration_s * 1e9))
    middle_ns = info.start_ns + round(settings.start_s * 1e9) + length_ns // 2
    pictures = stack.enter_context(TrackPictures(picture, middle_ns, video))

    def watch(packet: Packet, features: FeatureFrame) -> None:
        assert isinstance(packet.frame, CameraFrame)
        pictures.show(packet.frame, features)
        if recorder is not None:
            features = features if labels is None else labels.labelled(features)
            recorder.write(packet.imu, features, packet.aiding)

    return watch


_COLUMNS = (
    "front end",
    "features",
    "length median",
    "mean",
    "inliers",
    "coverage",
    "epipolar px",
    "wrong",
    "ms",
    "ATE m",
    "status",
)


def _row(report: FrontendReport) -> list[str]:
    """The cells of a front end in the table."""
    tracks = report.tracks
    return [
        report.name,
        f"{tracks.features:.0f}",
        f"{tracks.median_length:.0f}",
        f"{tracks.mean_length:.1f}",
        f"{report.inliers:.3f}",
        f"{tracks.coverage:.2f}",
        number(tracks.epipolar_px, 2),
        number(tracks.wrong, 3),
        f"{report.ms.get('total', 0.0):.1f}",
        number(report.ate_m, 4),
        report.status or "-",
    ]


def _lines(report: FrontendReport) -> list[tuple[str, str]]:
    """The report of one front end."""
    tracks = report.tracks
    counts = ", ".join(f"{name} {value:.1f}" for name, value in report.counts.items())
    stages = ", ".join(f"{name} {value:.2f}" for name, value in report.ms.items())
    return [
        ("frames", str(tracks.frames)),
        ("features a frame", f"{tracks.features:.1f}"),
        ("track length", f"median {tracks.median_length:.0f}, mean {tracks.mean_length:.1f}"),
        ("inliers", f"{report.inliers:.3f}"),
        ("coverage", f"{tracks.coverage:.2f} of the cells hold a feature"),
        ("epipolar error", f"{number(tracks.epipolar_px, 2)} px against the true motion"),
        ("wrong", f"{number(tracks.wrong, 4)} of the features"),
        ("between cameras", f"{number(tracks.stereo_px, 2)} px from the epipolar line"),
        ("counts a frame", counts),
        ("ms a frame", stages),
    ]


def _plain(report: FrontendReport) -> dict[str, Any]:
    """A report for JSON, which has no NaN."""
    table = report.table()
    if table["inliers"] != table["inliers"]:
        table["inliers"] = None
    return table
