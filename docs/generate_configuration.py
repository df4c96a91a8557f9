# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the pages of settings from their types, defaults and docstrings.

`configuration.md` opens with the ten settings that matter and lists all plain ones;
`configuration_expert.md` lists those for development.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel
from pydantic_core import to_jsonable_python

from slam_graph.bundle_adjustment.bal_policy import BalPolicy
from slam_graph.config import RunConfig, load_config
from slam_graph.pose_graph.pose_graph_policy import PoseGraphPolicy

PAGE = Path(__file__).with_name("configuration.md")
EXPERT_PAGE = Path(__file__).with_name("configuration_expert.md")


class Advice(NamedTuple):
    """Why one would change a setting."""

    setting: str
    when: str
    effect: str


TEN_THAT_MATTER = (
    Advice(
        "algorithm",
        "You want to compare methods, or trade accuracy for speed.",
        "Another row of the [table of policies](engine.md#policies). `msckf` is the default; "
        "`slam-graph compare` shows the differences on your recording.",
    ),
    Advice(
        "cameras",
        "The recording has more cameras than you want to use.",
        "`mono` is the fastest; a second camera makes the scale observable without motion.",
    ),
    Advice(
        "frontend.method",
        "Motion between frames is too large for Lucas-Kanade: few tracks survive.",
        "A descriptor such as `orb` bridges larger motions, with shorter and less accurate tracks.",
    ),
    Advice(
        "frontend.max_features",
        "You have time to spare, or none.",
        "More features give a little more accuracy; the time of front end and back end grows.",
    ),
    Advice(
        "backend.noise.pixel_sigma",
        "In `metrics.json` `nis.mean` is far above `nis.expected_mean`, or many features are "
        "rejected by the gate.",
        "A larger value trusts images less and rejects fewer features; covariances grow.",
    ),
    Advice(
        "backend.noise.imu_scale",
        "The IMU's noise is taken from a data sheet, or the platform vibrates.",
        "A larger value trusts the IMU less; too small a value makes the estimate overconfident.",
    ),
    Advice(
        "backend.initialization.mode",
        "A run does not start, or starts wrongly.",
        "`static` waits for a standstill, `motion` for enough motion; `auto` takes what comes "
        "first; `groundtruth` separates faults of the start from those after it.",
    ),
    Advice(
        "backend.calibration.time_offset",
        "Camera and IMU are not synchronised in hardware.",
        "The offset between the clocks is estimated on the way; the result is in "
        "`calibration_estimated.yaml`.",
    ),
    Advice(
        "final_ba.enabled",
        "You need only the causal trajectory, or the result at once.",
        "Without it a run ends with its last frame, and there is no `trajectory_smoothed.tum`.",
    ),
    Advice(
        "loop_closure.enabled",
        "The recording comes back to places, and drift matters.",
        "Places are recognised at the end, and `trajectory_loop.tum` has the drift corrected.",
    ),
)
"""Curated: the settings that a new user changes first. All are plain settings."""

INTRODUCTION = """\
# Configuration

<!-- Written by docs/generate_configuration.py: run `make docs` after a change of a setting. -->

Every recording runs without a configuration. The `config.yaml` beside the results holds every
setting of the run, defaults included, and is itself a valid `--config`.
"""

SOURCES = """\
## How settings are given

Later sources replace earlier ones: the defaults below, the YAML file of `--config`, the options of
the command line (`--algorithm`, `--cameras`, `--start`, `--duration`, `--seed`), and each
`--set key=value`, whose value is read as YAML:

```sh
slam-graph run demo --algorithm swf --set backend.noise.pixel_sigma=1.5
slam-graph run demo --set algorithm.cost.max_past_poses=20
slam-graph config dump --algorithm swf > my.yaml
slam-graph config check my.yaml
slam-graph run demo --config my.yaml
```

In Python the same are arguments, and settings that are loaded are changed by `with_overrides`:

```python
import slam_graph as sg

config = sg.load_config("msckf", {"backend.noise.pixel_sigma": 1.5}, duration_s=9)
other = config.with_overrides({"backend.noise.pixel_sigma": 2.0}, seed=3)
result = sg.run("demo", other)
```

`algorithm` is the name of a file in `configs/algorithms/`, the path of a file of your own, or the
table itself. An unknown key, or a value of the wrong type or outside its range, is refused (exit
code 2) with file and line; a key of an older version is refused with a hint at what replaced it.
`slam-graph config schema` prints a JSON schema, for editors that check YAML.

The settings below are those that a user can sensibly choose. Settings for development, whose
defaults suit every recording that was tried, are in
[configuration_expert.md](configuration_expert.md).
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

POLICIES: tuple[tuple[str, type[BaseModel]], ...] = (
    (POSE_GRAPHS, PoseGraphPolicy),
    (BUNDLES, BalPolicy),
)

EXPERT = """\
# Expert settings

<!-- Written by docs/generate_configuration.py: run `make docs` after a change of a setting. -->

For development and experiments. The defaults suit every recording that was tried, and a setting
here may become a constant in a later version. They are given like the
[plain settings](configuration.md#how-settings-are-given).
"""

BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def page() -> str:
    """The page of plain settings, Markdown."""
    return "\n".join([INTRODUCTION, _ten(), SOURCES, *_all_sections(expert=False)])


def expert_page() -> str:
    """The page of expert settings, Markdown."""
    return "\n".join([EXPERT, *_all_sections(expert=True)])


def plain_settings() -> dict[str, str]:
    """Names of all plain settings by table and field; a table that is used twice counts once."""
    found: dict[str, str] = {}
    for model in (RunConfig, *(policy for _, policy in POLICIES)):
        _collect(model, "", found)
    return found


def _collect(model: type[BaseModel], path: str, found: dict[str, str]) -> None:
    """Add the plain settings of a table and of the tables in it."""
    for name, info in model.model_fields.items():
        kind, extra = info.annotation, info.json_schema_extra
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            _collect(kind, f"{path}{name}.", found)
        elif not (isinstance(extra, dict) and extra.get("expert")):
            found.setdefault(f"{model.__name__}.{name}", f"{path}{name}")


def _ten() -> str:
    """The section of the settings that matter most."""
    lines = ["## The ten that matter", "", "| setting | change it when | what happens |"]
    lines.append("|---|---|---|")
    lines += [f"| `{row.setting}` | {row.when} | {row.effect} |" for row in TEN_THAT_MATTER]
    return "\n".join([*lines, ""])


def _all_sections(expert: bool) -> Iterator[str]:
    """The sections of all tables, of one tier."""
    schema = RunConfig.model_json_schema()
    yield from _sections(schema, schema["$defs"], _defaults(load_config()), "", expert)
    for heading, policy in POLICIES:
        schema = policy.model_json_schema()
        sections = list(_sections(schema, schema["$defs"], _defaults(policy()), "", expert))
        if sections:
            yield heading
            yield from sections


def _defaults(table: BaseModel) -> dict[str, Any]:
    """All values of a table and of the tables in it, also those that its dump leaves out."""
    values = {name: getattr(table, name) for name in type(table).model_fields}
    return {
        name: _defaults(value) if isinstance(value, BaseModel) else to_jsonable_python(value)
        for name, value in values.items()
    }


def _sections(
    table: dict[str, Any],
    tables: dict[str, Any],
    defaults: dict[str, Any],
    path: str,
    expert: bool,
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
    EXPERT_PAGE.write_text(expert_page(), encoding="utf-8")
