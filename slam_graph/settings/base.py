# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The base class of all settings: typed, frozen, and closed to unknown keys.

There are two tiers. A plain `Field` is a setting that a user can choose with sense; its docstring
says when to change it and what happens. `expert` marks the others: they are for development, are
listed apart, and may go. A value that nobody has a reason to change is no setting but a constant
beside its use.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import ClassVar

from pydantic import BaseModel, ConfigDict, Field

expert = partial(Field, json_schema_extra={"expert": True})
"""A pydantic field of the second tier: it works like any other, and is listed apart."""


class Settings(BaseModel):
    """Base of all settings.

    Attributes:
        moved: for each key that this table once had, what to do instead: the end of a sentence
            that begins with the key, such as "is now frontend.max_features".
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    moved: ClassVar[Mapping[str, str]] = {}
