# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Writes configuration.md, the list of all settings, from their types, defaults and docstrings."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from slam_graph.backend.policies import SmootherPolicy
from slam_graph.bundle_adjustment.bal_policy import BalPolicy
from slam_graph.config import RunConfig, load_config
from slam_graph.pose_graph.pose_graph_policy import PoseGraphPolicy

PAGE = Path(__file__).with_name("configuration.md")

INTRODUCTION = """\
# Configuration

<!-- Written by docs/generate_configuration.py: run `make docs` after a change of a setting. -->

Every recording runs without a configuration. What a run used, down to the last default, is in the
`config.yaml` beside its results, and that file is again a valid `--config`.

Settings are laid over one another in this order: the defaults below, the YAML file of `--config`,
the options of the command line (`--algorithm`, `--cameras`, `--start`, `--duration`, `--seed`), and
each `--set key=value`, whose value is read as YAML:

```sh
slam-graph run demo --algorithm swf --set backend.noise.pixel_sigma=1.5
slam-graph run demo --set algorithm.cost.max_past_poses=20
slam-graph config dump --algorithm swf > my.yaml
slam-graph config check my.yaml
slam-graph run demo --config my.yaml
```

`algorithm` is the name of a file in `configs/algorithms/`, the path of a file of your own, or the
table itself. An unknown key, a value of the wrong type or outside its range is refused (exit code
2) with the file and line where it stands. `slam-graph config schema` prints the same as a JSON
schema, for editors that check YAML.
"""

POSE_GRAPHS = """\
## Pose graphs

`slam-graph optimize` has settings of its own, for its `--config` and `--set`. For a pose graph:

```sh
slam-graph optimize graph.g2o --set cost.robust=gnc --set gauss_newton.tolerance=1e-9
```
"""

BUNDLES = """\
## Bundle adjustment of BAL files

The settings of `slam-graph optimize` for a problem in BAL's format:

```sh
slam-graph optimize problem.txt --set cost.robust_width_px=1.5 --set gauss_newton.tolerance=1e-9
```
"""

EXPERT = """\
# Expert settings

For development and experiments: the defaults hold for every recording that was tried, and a setting
here may go when a constant does as well.
"""

BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def page() -> str:
    """The whole page, Markdown."""
    schema = RunConfig.model_json_schema()
    run_defaults = load_config().model_dump(mode="json")
    run_defaults["algorithm"]["smoother"] = SmootherPolicy().model_dump(mode="json")
    sections = [INTRODUCTION, *_sections(schema, schema["$defs"], run_defaults, "")]
    expert = list(_sections(schema, schema["$defs"], run_defaults, "", expert=True))
    for heading, policy in (
        (POSE_GRAPHS, PoseGraphPolicy()),
        (BUNDLES, BalPolicy()),
    ):
        schema = policy.model_json_schema()
        defaults = policy.model_dump(mode="json")
        sections += [heading, *_sections(schema, schema["$defs"], defaults, "")]
        expert += _sections(schema, schema["$defs"], defaults, "", expert=True)
    if expert:
        sections += [EXPERT, *expert]
    return "\n".join(sections)


def _sections(
    table: dict[str, Any],
    tables: dict[str, Any],
    defaults: dict[str, Any],
    path: str,
    expert: bool = False,
) -> Iterator[str]:
    """One section for a table of settings and for each table in it, depth first, of one tier."""
    settings = {name: _resolved(entry, tables) for name, entry in table["properties"].items()}
    plain = {
        name: entry
        for name, entry in settings.items()
        if "properties" not in entry and entry.get("expert", False) == expert
    }
    if plain:
        yield "\n".join(_section(path, table, plain, defaults))
    for name, entry in settings.items():
        if "properties" in entry:
            yield from _sections(entry, tables, defaults[name], f"{path}{name}.", expert)


def _section(
    path: str, table: dict[str, Any], settings: dict[str, Any], defaults: dict[str, Any]
) -> Iterator[str]:
    """Heading and table of the settings that stand directly in a table."""
    yield f"## {path.removesuffix('.') or 'The run'}\n"
    yield f"{_one_line(table.get('description', ''))}\n"
    yield "| setting | type | default | meaning |"
    yield "|---|---|---|---|"
    for name, entry in settings.items():
        default = json.dumps(defaults[name]) if name in defaults else "required"
        meaning = _one_line(entry.get("description", ""))
        yield f"| `{path}{name}` | {_type(entry)} | `{default}` | {meaning} |"
    yield ""


def _resolved(entry: dict[str, Any], tables: dict[str, Any]) -> dict[str, Any]:
    """The table that a setting refers to, or the setting itself if it is a plain value.

    A setting that may also be given by name (`algorithm`) is shown as its table.
    """
    for choice in [entry, *entry.get("anyOf", [])]:
        if "$ref" in choice:
            resolved: dict[str, Any] = tables[choice["$ref"].rsplit("/", 1)[-1]]
            # pydantic leaves out what a setting says where its table says the same
            about = entry.get("description") or resolved.get("description", "")
            return {**resolved, "description": about}
    return entry


def _type(entry: dict[str, Any]) -> str:
    """Type and range of a plain value in a few words."""
    if "anyOf" in entry:
        return " or ".join(dict.fromkeys(_type(choice) for choice in entry["anyOf"]))
    if "enum" in entry:
        return ", ".join(f"`{value}`" for value in entry["enum"])
    if "prefixItems" in entry:
        return f"list of {len(entry['prefixItems'])}: {_type(entry['prefixItems'][0])}"
    if entry.get("type") == "array":
        item = _type(entry["items"])
        return f"list of ({item})" if " or " in item else f"list of {item}"
    bounds = (f"{sign} {entry[key]:g}" for key, sign in BOUNDS.items() if key in entry)
    return " ".join([entry.get("type", "any"), ", ".join(bounds)]).strip()


def _one_line(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
