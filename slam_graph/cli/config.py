# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph config`: show, describe and check configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam_graph.cli.output import echo_json

app = typer.Typer(
    help="Show, describe and check configurations.", no_args_is_help=True, rich_markup_mode=None
)

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="YAML file laid over the defaults.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set one value; may be repeated."),
]
Algorithm = Annotated[
    str | None, typer.Option("--algorithm", help="Name of an algorithm, or its YAML file.")
]


@app.command()
def dump(config: ConfigFile = None, set_: Overrides = None, algorithm: Algorithm = None) -> None:
    """Print all settings as YAML, with what each means; the output is a valid --config file."""
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
    """Check a configuration, or the table of an algorithm.

    A fault is said with its file and line, and the exit code is 2.
    """
    from slam_graph.config import is_algorithm_file, load_config

    if is_algorithm_file(file):
        load_config(None, set_ or (), algorithm=str(file))
    else:
        load_config(file, set_ or (), algorithm=algorithm)
    typer.echo(f"{file}: ok")
