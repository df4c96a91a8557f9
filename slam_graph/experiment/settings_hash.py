# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A short hash of settings, by which a task knows whether its result is there already."""

from __future__ import annotations

import hashlib
import json

HASH_LENGTH = 12


def settings_hash(*values: object) -> str:
    """A short hash of values that JSON can hold."""
    text = json.dumps(values, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:HASH_LENGTH]
