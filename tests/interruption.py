# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C at any file that is written, renamed or removed."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


@contextmanager
def interrupted_at(step: int) -> Iterator[list[Path]]:
    """Within the block what changes a folder is noted, and interrupted before one of the steps.

    Hidden files, which are not complete, do not count.

    Yields:
        The paths before the steps that were begun.
    """
    begun: list[Path] = []

    def noted(call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*paths: Path, **options: object) -> object:
            if not paths[-1].name.startswith("."):
                begun.append(paths[-1])
                if len(begun) == step + 1:
                    raise KeyboardInterrupt
            return call(*paths, **options)

        return wrapped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "unlink", noted(Path.unlink))
        patch.setattr(os, "replace", noted(os.replace))
        yield begun
