# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The command `slam-graph`: launches a command and turns errors into exit codes.

Exit codes: 0 success; 1 expected failure, with one line on stderr; 2 usage or configuration error;
3 ran, but never initialised, diverged, covered less than asked or made no map; 130 interrupted.
Modules that are slow to import are imported inside the commands.
"""

from __future__ import annotations

import os
import signal
import sys
from copy import copy
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from slam_graph.cli import (
    batch,
    compare,
    data_commands,
    doctor,
    evaluate,
    export,
    frontend,
    map,
    optimize,
    run,
    simulate,
    view,
)
from slam_graph.cli.console import echo_json
from slam_graph.cli.help_texts import SuggestingGroup, add_examples, example_text
from slam_graph.cli.options import INTERRUPTED, Algorithm, ConfigFile, Overrides
from slam_graph.errors import DataError, SlamGraphError
from slam_graph.files import Files
from slam_graph.interrupts import Interrupts
from slam_graph.version import __version__

# The matrices of a window are a few hundred wide. BLAS threads make these slower, up to ten times
# where other work shares the cores. OpenBLAS reads this when NumPy is first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Settings need no plugins of pydantic, which it would look for in all installed packages.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

config_app = typer.Typer(
    help="Show, describe and check configurations.", no_args_is_help=True, rich_markup_mode="rich"
)


@config_app.command()
def dump(config: ConfigFile = None, set_: Overrides = None, algorithm: Algorithm = None) -> None:
    """Print all settings as YAML with their meanings; the output is a valid --config file."""
    from slam_graph.config import load_config

    typer.echo(load_config(config, set_ or (), algorithm=algorithm).as_yaml(), nl=False)


@config_app.command()
def schema() -> None:
    """Print the JSON schema of a configuration."""
    from slam_graph.config import RunConfig

    echo_json(RunConfig.model_json_schema())


@config_app.command()
def check(
    file: Annotated[Path, typer.Argument(help="YAML file to check.")],
    set_: Overrides = None,
    algorithm: Algorithm = None,
) -> None:
    """Check a YAML file of settings, or of an algorithm.

    An error names the file and line, and the exit code is 2.
    """
    from slam_graph.config import load_config

    load_config(file, set_ or (), algorithm=algorithm)
    typer.echo(f"{file}: ok")


app = typer.Typer(
    help="Factor-graph SLAM: a recorded sequence in, a trajectory out.",
    no_args_is_help=True,
    epilog=example_text(""),
    cls=SuggestingGroup,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)
app.command("run")(run.run)
app.command("batch")(batch.batch)
app.command("localize")(map.localize)
app.add_typer(map.app, name="map")
app.command("ape")(evaluate.ape)
app.command("rpe")(evaluate.rpe)
app.command("export")(export.export)
app.command("compare")(compare.compare)
app.command("optimize")(optimize.optimize)
app.command("doctor")(doctor.doctor)
app.command("simulate")(simulate.simulate)
app.command("view")(view.view)
app.add_typer(frontend.app, name="frontend")
app.add_typer(data_commands.app, name="data")
app.add_typer(config_app, name="config")
add_examples(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"slam-graph {__version__}")
        raise typer.Exit


@app.callback()
def _global_options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Options before the command."""


def _with_one_command(name: str = "") -> typer.Typer:
    """The program with one command only, or with all if there is none of this name.

    Typer makes the options of all commands that it is given, which takes a tenth of a second.
    """
    alone = copy(app)
    alone.registered_commands = [c for c in app.registered_commands if c.name == name]
    alone.registered_groups = [group for group in app.registered_groups if group.name == name]
    return alone if alone.registered_commands or alone.registered_groups else app


def run_command() -> int | str:
    """Run a command; a `SlamGraphError` becomes one line on stderr and its exit code.

    Returns:
        The exit code.
    """
    heard = False

    def interrupt(signum: int, frame: FrameType | None) -> None:
        nonlocal heard
        heard = True
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
    Interrupts.terminate_like_interrupt()
    code: int | str = 0
    try:
        _with_one_command(*sys.argv[1:2])(prog_name="slam-graph")
    except SystemExit as leaving:
        code = leaving.code or 0
    except KeyboardInterrupt:
        code = _interrupted()
    except SlamGraphError as error:
        typer.echo(f"error: {error}", err=True)
        code = error.exit_code
    except OSError as error:  # of the system, in a place where nobody expected it
        where = f"{error.filename}: " if error.filename is not None else ""
        typer.echo(f"error: {where}{Files.refused(error)}", err=True)
        code = DataError.exit_code
    except Exception:
        if not heard:  # imports of other libraries turn Ctrl-C into errors of their own
            raise
        code = _interrupted()
    return _flushed() or code


def _interrupted() -> int:
    typer.echo("interrupted", err=True)
    return INTERRUPTED


def _flushed() -> int:
    """Write what is left of the output, and return 1 if that cannot be done, else 0."""
    try:
        sys.stdout.flush()
    except OSError as error:
        sys.stdout = None  # else Python tries again at its end
        typer.echo(f"error: the output cannot be written ({Files.refused(error)})", err=True)
        return DataError.exit_code
    return 0


def main() -> None:
    """Run a command, and leave with its exit code."""
    sys.exit(run_command())


if __name__ == "__main__":
    main()
