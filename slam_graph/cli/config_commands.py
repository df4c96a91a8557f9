# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph config`: show, describe and check configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam_graph.cli.options import Algorithm, ConfigFile, Overrides
from slam_graph.cli.printing import echo_json

app = typer.Typer(
    help="Show, describe and check configurations.", no_args_is_help=True, rich_markup_mode=None
)


@app.command()
def dump(config: ConfigFile = None, set_: Overrides = None, algorithm: Algorithm = None) -> None:
    """Print all settings as YAML with their meanings; the output is a valid --config file."""
    from slam_graph.config import dump_yaml, load_config

    typer.echo(dump_yaml(load_config(config, set_ or (), algorithm=algorithm)), nl=False)


@app.command()
def schema() -> None:
    """Print the JSON schema of a configuration."""
    from slam_graph.config import RunConfig

    echo_json(RunConfig.model_json_schema())


@app.command()
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
