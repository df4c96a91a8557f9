# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The base class of all settings: typed, frozen, and closed to unknown keys.

There are two tiers. A plain `Field` is a setting that a user can sensibly choose; its docstring
says when to change it and what then happens. `expert` marks the others: they are for development,
are listed on a page of their own, and may be removed. A value that nobody has a reason to change is
not a setting but a constant beside its use.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import ClassVar

from pydantic import BaseModel, ConfigDict, Field

expert = partial(Field, json_schema_extra={"expert": True})
"""A pydantic field of the second tier; it works like any other."""


class Settings(BaseModel):
    """Base of all settings.

    Attributes:
        moved: for each key that this table no longer has, the end of a sentence that begins with
            the key and says what to do instead, such as "is now frontend.max_features".
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    moved: ClassVar[Mapping[str, str]] = {}
