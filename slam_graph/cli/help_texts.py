# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Examples and panels of the help, and what is said about an option that does not exist."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Any

import typer
from typer.core import TyperGroup

_RUN, _MEASURE, _SOLVE, _DATA = "Run", "Compare and look", "Graphs", "Recordings and settings"

_PANELS = {
    _RUN: ("run", "batch", "localize", "map"),
    _MEASURE: ("ape", "rpe", "compare", "view", "export"),
    _SOLVE: ("optimize",),
    _DATA: ("doctor", "simulate", "data", "frontend", "config"),
}
"""Commands in the help of the program, by the title of their panel."""

EXAMPLES = {
    "": (
        "slam-graph run demo",
        "slam-graph run path/to/MH_01_easy --cameras stereo",
        "slam-graph batch path/to/recordings --jobs 4",
    ),
    "run": (
        "slam-graph run demo --algorithm swf --duration 20",
        "slam-graph run path/to/MH_01_easy --loop-closure --save-map",
        "slam-graph run flight.bag --topic imu=/imu0 --topic cam0=/cam0/image_raw",
    ),
    "batch": (
        "slam-graph batch path/to/recordings --jobs 4",
        "slam-graph batch 'path/to/*/MH_*' --algorithm okvis --output results/okvis",
        "slam-graph batch list.yaml --scheduler tcp://127.0.0.1:8786",
    ),
    "localize": ("slam-graph localize path/to/MH_02_easy --map results/MH_01_easy",),
    "map": (
        "slam-graph map info results/MH_01_easy",
        "slam-graph map merge monday.slam tuesday.slam --output both.slam",
    ),
    "ape": (
        "slam-graph ape path/to/MH_01_easy results/MH_01_easy/latest/trajectory.tum --align yaw",
    ),
    "rpe": (
        "slam-graph rpe path/to/MH_01_easy results/MH_01_easy/latest/trajectory.tum -d 0.5 -u m",
    ),
    "view": (
        "slam-graph view results/MH_01_easy",
        "slam-graph view results/MH_01_easy --screenshot picture.png",
    ),
    "export": (
        "slam-graph export results/MH_01_easy --tum poses.tum --euroc states.csv",
        "slam-graph export results/MH_01_easy --recording path/to/MH_01_easy --colmap scene",
    ),
    "compare": (
        "slam-graph compare sim:figure8 --algorithms msckf,swf --seeds 5",
        "slam-graph compare path/to/MH_01_easy --algorithms msckf,okvis,kmsckf.yaml",
    ),
    "optimize": (
        "slam-graph optimize sphere2500.g2o",
        "slam-graph optimize problem-16-22106-pre.txt.bz2",
    ),
    "doctor": (
        "slam-graph doctor path/to/MH_01_easy",
        "slam-graph doctor flight.bag --calibration camchain-imucam.yaml --json",
    ),
    "simulate": (
        "slam-graph simulate flight --duration 30",
        "slam-graph simulate rooms --kind images --trajectory rooms",
    ),
    "data": ("slam-graph data info demo", "slam-graph data check path/to/MH_01_easy"),
    "frontend": ("slam-graph frontend run path/to/MH_01_easy --duration 10",),
    "config": (
        "slam-graph config dump --algorithm okvis > my.yaml",
        "slam-graph config check my.yaml",
    ),
}
"""Commands that a user can type, for the help of each command; of the program itself under ``""``.
"""


def example_text(command: str) -> str | None:
    """The examples of a command as the last lines of its help."""
    if command not in EXAMPLES:
        return None
    lines = "\n".join(f"  [cyan]{line}[/cyan]" for line in EXAMPLES[command])
    return f"[bold]Examples[/bold]\n\n{lines}"


def add_examples(app: typer.Typer) -> None:
    """Give every command of the program its panel and its examples."""
    panels = {name: panel for panel, names in _PANELS.items() for name in names}
    infos: list[Any] = [*app.registered_commands, *app.registered_groups]
    for info in infos:
        name = str(info.name)
        info.rich_help_panel = panels.get(name, "Commands")
        info.epilog = example_text(name)


class SuggestingGroup(TyperGroup):
    """Commands that answer an option which does not exist with the one that was probably meant."""

    def make_context(self, *args: Any, **extra: Any) -> Any:
        """Read the options before the command."""
        with _suggestions():
            return super().make_context(*args, **extra)

    def invoke(self, ctx: Any) -> Any:
        """Read the options of the command, and run it."""
        with _suggestions():
            return super().invoke(ctx)


@contextmanager
def _suggestions() -> Iterator[None]:
    """Say "did you mean" where the parser lists what is possible."""
    try:
        yield
    except Exception as error:
        # which module the class is in depends on the version of Typer
        if type(error).__name__ == "NoSuchOption":
            fault: Any = error
            known = list(fault.possibilities or ())
            similar = [*get_close_matches(fault.option_name, known, n=1), *known][:1]
            if similar:
                fault.message = f"No such option: {fault.option_name}. Did you mean {similar[0]}?"
                fault.possibilities = None
        raise
