# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph ape` and `slam-graph rpe`: errors of a trajectory, with evo's flags and numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from slam_graph.cli.console import echo_json, echo_table
from slam_graph.cli.options import Json

if TYPE_CHECKING:
    from slam_graph.geometry import AlignmentMode, Trajectory

_Align = Literal["none", "yaw", "se3", "sim3"]
_PoseRelation = Literal["full", "trans_part", "rot_part", "angle_deg", "angle_rad"]
_StepUnit = Literal["f", "m", "d", "r"]

_STATISTICS = ("max", "mean", "median", "min", "rmse", "sse", "std")

_Reference = Annotated[
    Path, typer.Argument(help="True trajectory: TUM file, EuRoC CSV or EuRoC folder.")
]
_Estimate = Annotated[Path, typer.Argument(help="Trajectory to evaluate: TUM file or EuRoC CSV.")]
_Relation = Annotated[
    _PoseRelation,
    typer.Option("-r", "--pose_relation", help="Part of the difference of two poses that counts."),
]
_AlignFlag = Annotated[
    bool, typer.Option("-a", help="Align with Umeyama's method (the same as --align se3).")
]
_ScaleFlag = Annotated[
    bool,
    typer.Option("-s", "--correct_scale", help="Correct the scale; with -a that is --align sim3."),
]
_AlignOption = Annotated[
    _Align | None, typer.Option("--align", help="Align before errors are taken.")
]
_MaxDifference = Annotated[
    float | None,
    typer.Option(
        "--t_max_diff",
        min=0.0,
        help="Compare with the true pose nearest in time, as evo does, at most so many seconds "
        "away; without it the truth is interpolated.",
    ),
]


def ape(
    reference: _Reference,
    estimate: _Estimate,
    relation: _Relation = "trans_part",
    align_se3: _AlignFlag = False,
    correct_scale: _ScaleFlag = False,
    align: _AlignOption = None,
    t_max_diff: _MaxDifference = None,
    as_json: Json = False,
) -> None:
    """Absolute pose error of ESTIMATE against REFERENCE."""
    from slam_graph.evaluation import ape as absolute_pose_error

    mode = _alignment(align_se3, correct_scale, align)
    truth, guess = _read(reference), _read(estimate)
    result = absolute_pose_error(truth, guess, relation, mode, _pairing(t_max_diff), t_max_diff)
    _report("APE", result.table(), relation, mode, {}, as_json)


def rpe(
    reference: _Reference,
    estimate: _Estimate,
    relation: _Relation = "trans_part",
    delta: Annotated[float, typer.Option("-d", "--delta", min=0.0, help="Length of a step.")] = 1.0,
    delta_unit: Annotated[
        _StepUnit,
        typer.Option("-u", "--delta_unit", help="Frames, metres, degrees or radians."),
    ] = "f",
    delta_tol: Annotated[
        float,
        typer.Option(
            "-t", "--delta_tol", min=0.0, help="With --all_pairs: relative tolerance of a step."
        ),
    ] = 0.1,
    all_pairs: Annotated[
        bool, typer.Option("--all_pairs", help="All pairs instead of consecutive steps.")
    ] = False,
    pairs_from_reference: Annotated[
        bool, typer.Option("--pairs_from_reference", help="Measure steps along the reference.")
    ] = False,
    align_se3: _AlignFlag = False,
    correct_scale: _ScaleFlag = False,
    align: _AlignOption = None,
    t_max_diff: _MaxDifference = None,
    as_json: Json = False,
) -> None:
    """Relative pose error (drift) of ESTIMATE against REFERENCE."""
    from slam_graph.evaluation import rpe as relative_pose_error

    mode = _alignment(align_se3, correct_scale, align)
    result = relative_pose_error(
        _read(reference),
        _read(estimate),
        relation,
        mode,
        delta,
        delta_unit,
        all_pairs,
        delta_tol,
        pairs_from_reference,
        _pairing(t_max_diff),
        t_max_diff,
    )
    steps: dict[str, Any] = {
        "delta": delta,
        "delta_unit": result.step_unit,
        "all_pairs": all_pairs,
    }
    _report("RPE", result.table(), relation, mode, steps, as_json)


def _alignment(align_se3: bool, correct_scale: bool, align: _Align | None) -> AlignmentMode:
    """The alignment that the flags ask for."""
    if align is not None:
        if align_se3 or correct_scale:
            raise typer.BadParameter("--align cannot be combined with -a or -s")
        return align
    if align_se3:
        return "sim3" if correct_scale else "se3"
    return "scale" if correct_scale else "none"


def _pairing(t_max_diff: float | None) -> Literal["interpolate", "nearest"]:
    """How true poses are found: evo's way if its limit is given."""
    return "interpolate" if t_max_diff is None else "nearest"


def _read(path: Path) -> Trajectory:
    """Read a trajectory file."""
    from slam_graph.datasets import read_groundtruth

    return read_groundtruth(path)


def _report(
    metric: str,
    errors: dict[str, Any],
    relation: _PoseRelation,
    mode: AlignmentMode,
    steps: dict[str, Any],
    as_json: bool,
) -> None:
    """Print errors (`ErrorSeries.table`)."""
    unit, statistics = errors["unit"], errors["statistics"]
    if as_json:
        about = {"metric": metric.lower(), "relation": relation, "unit": unit, "alignment": mode}
        echo_json({**about, **errors, **steps, "statistics": statistics})
        return
    step = ""
    if steps:
        pairs = "all pairs" if steps["all_pairs"] else "consecutive steps"
        step = f", {pairs} of {steps['delta']:g} {steps['delta_unit']}"
    typer.echo(
        f"{metric} {relation}{f' [{unit}]' if unit else ''}{step}, alignment: {mode}, "
        f"{errors['poses']} shared poses, {errors['errors']} errors"
    )
    echo_table(((name, f"{statistics[name]:.6f}") for name in _STATISTICS), indent="  ")
