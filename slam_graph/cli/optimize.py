# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph optimize`: a pose graph or a bundle-adjustment problem in, its optimum out."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal
from zipfile import is_zipfile

import typer

from slam_graph.cli.loading import loading
from slam_graph.cli.optimize_bal import optimize_bal
from slam_graph.cli.optimize_pose_graph import Wanted, optimize_pose_graph_file
from slam_graph.cli.options import (
    ConfigFile,
    Json,
    Overrides,
    Rerun,
    RerunAddress,
    read_policy,
)
from slam_graph.cli.watching import Watching
from slam_graph.errors import ConfigError, DataError

_Method = Literal["gauss_newton", "levenberg_marquardt", "dogleg", "isam2"]
_Initial = Literal["auto", "chordal", "lago", "odometry", "file"]
_Format = Literal["auto", "pose_graph", "bal"]
_Intrinsics = Literal["per_camera", "shared", "fixed"]
_Robust = Literal["none", "gnc", "huber", "cauchy", "geman_mcclure", "dcs", "truncated"]


class _Information(StrEnum):
    """The values of `--information`; Typer takes no list of literals."""

    ANGLE = "angle"
    QUATERNION = "quaternion"
    NEAREST = "nearest"
    ISOTROPIC = "isotropic"


def optimize(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Pose graph (g2o or TORO, 2D or 3D), or bundle adjustment (BAL, also as .bz2).",
        ),
    ],
    kind: Annotated[
        _Format, typer.Option("--format", help="Kind of FILE; auto detects it from the content.")
    ] = "auto",
    method: Annotated[_Method | None, typer.Option("--method", help="Optimisation method.")] = None,
    initialization: Annotated[
        _Initial | None, typer.Option("--init", help="Source of the initial estimates.")
    ] = None,
    robust: Annotated[
        _Robust | None,
        typer.Option("--robust", help="Robust loss against false loop closures or outliers."),
    ] = None,
    intrinsics: Annotated[
        _Intrinsics | None,
        typer.Option("--intrinsics", help="Which intrinsics bundle adjustment estimates."),
    ] = None,
    information: Annotated[
        list[_Information] | None,
        typer.Option(
            "--information",
            help="Which rotation error the information of 3D edges is for: GTSAM's (angle, the "
            "default) or g2o's (quaternion); and what stands in for matrices that are not positive "
            "definite: the nearest that is, or what is isotropic in them. Repeatable.",
        ),
    ] = None,
    certify: Annotated[
        bool, typer.Option("--certify", help="Certify whether the result is the global optimum.")
    ] = False,
    covariances: Annotated[
        bool, typer.Option("--covariances", help="Write the covariance of every pose.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="PATH", help="Also write the optimised problem here."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Let --save replace an existing file.")
    ] = False,
    config: ConfigFile = None,
    set_: Overrides = None,
    output: Annotated[
        Path, typer.Option("--output", help="Folder of results: OUTPUT/<name>/<UTC time>/.")
    ] = Path("results"),
    rerun: Rerun = "off",
    rerun_address: RerunAddress = None,
    as_json: Json = False,
) -> None:
    """Optimise a pose graph or a bundle-adjustment problem, and write the results.

    The newest results are also found under OUTPUT/<name>/latest; nothing is overwritten.
    """
    with loading():
        from slam_graph.bundle_adjustment import BalPolicy
        from slam_graph.pose_graph import PoseGraphPolicy
        from slam_graph.results import ResultFolder

    watching = Watching(rerun, address=rerun_address)
    if save is not None:
        ResultFolder.refuse_to_replace(save, force)
        if not save.parent.is_dir():
            raise DataError(f"{save}: cannot be written; name a file in an existing folder")
    loss = {("cost", "robust"): robust}
    of_graphs = {("gauss_newton", "method"): method, ("cost", "initialization"): initialization}
    of_bundles = {("cost", "intrinsics"): intrinsics}
    if kind == "auto":
        kind = _seen_format(file)
    if kind == "pose_graph":
        _refuse({"--intrinsics": intrinsics}, "bundle adjustment", file)
        graph_policy = read_policy(PoseGraphPolicy, config, set_ or [], {**loss, **of_graphs})
        wanted = Wanted(certify, covariances)
        meaning, repair = _meaning_and_repair(information or [])
        optimize_pose_graph_file(
            file, meaning, repair, graph_policy, wanted, save, output, as_json, watching
        )
        return
    flags = {"--certify": certify or None, "--covariances": covariances or None}
    others = {"--method": method, "--init": initialization, "--information": information or None}
    _refuse({**others, **flags}, "pose graphs", file)
    bundle_policy = read_policy(BalPolicy, config, set_ or [], {**loss, **of_bundles})
    optimize_bal(file, bundle_policy, save, output, as_json, watching)


def _meaning_and_repair(
    given: list[_Information],
) -> tuple[Literal["angle", "quaternion"], Literal["nearest", "isotropic"] | None]:
    """What information matrices mean, and how they are repaired.

    Raises:
        ConfigError: if two of a kind are given.
    """
    kinds = _Information
    if {kinds.ANGLE, kinds.QUATERNION} <= set(given) or {kinds.NEAREST, kinds.ISOTROPIC} <= set(
        given
    ):
        raise ConfigError(f"--information: {' and '.join(given)} exclude each other")
    meaning: Literal["angle", "quaternion"] = "quaternion" if kinds.QUATERNION in given else "angle"
    repair: Literal["nearest", "isotropic"] | None = None
    if kinds.NEAREST in given or kinds.ISOTROPIC in given:
        repair = "nearest" if kinds.NEAREST in given else "isotropic"
    return meaning, repair


def _seen_format(file: Path) -> _Format:
    """The kind of a file, from its content.

    Raises:
        DataError: if it is a map.
    """
    from slam_graph.bundle_adjustment import is_bal

    if file.is_dir() or is_zipfile(file):
        raise DataError(
            f"{file}: maps are not optimised: their poses come from the bundle adjustment of the "
            "whole recording; for a better map run the recording again with --loop-closure "
            "--save-map"
        )
    return "bal" if is_bal(file) else "pose_graph"


def _refuse(options: Mapping[str, Any], what: str, file: Path) -> None:
    """Refuse options for another kind of problem.

    Raises:
        ConfigError: if one is given.
    """
    for option, value in options.items():
        if value is not None:
            raise ConfigError(f"{option} is for {what}, which {file} is not")
