# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A finding of a diagnosis: what was found, how sure, how bad, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

Severity = Literal["error", "warning", "info"]
_SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")

Sureness = Literal["certain", "likely", "hint"]
CERTAIN_SIGMAS, _LIKELY_SIGMAS = 10.0, 5.0
"""From so many standard deviations on a finding is certain, or likely."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was found.

    Attributes:
        kind: name of the check, for programs, e.g. ``time_offset``.
        severity: ``error`` for what makes a result worthless, ``warning`` for what makes it worse,
            ``info`` for a fact.
        what: in words, with the figures.
        fix: the line of the calibration, the setting or the option that mends it, with its value.
        sure: ``certain``, ``likely`` or ``hint``.
        sigmas: distance from what was expected in standard deviations; None where it was counted.
        values: the figures by name.
    """

    kind: str
    severity: Severity
    what: str
    fix: str = ""
    sure: Sureness = "certain"
    sigmas: float | None = None
    values: Mapping[str, object] = field(default_factory=dict)

    @property
    def with_fix(self) -> str:
        """What was found and what mends it, in one line."""
        return f"{self.what}; {self.fix}" if self.fix else self.what

    @staticmethod
    def measured(
        kind: str,
        severity: Severity,
        what: str,
        fix: str,
        sigmas: float,
        values: Mapping[str, object] | None = None,
    ) -> Finding:
        """A finding whose sureness follows from its distance in standard deviations."""
        return Finding(kind, severity, what, fix, sureness(sigmas), sigmas, values or {})


def graded(bad: bool) -> Severity:
    """An error if it is bad, else a warning."""
    return "error" if bad else "warning"


def sureness(sigmas: float) -> Sureness:
    """How sure a difference of so many standard deviations is."""
    if sigmas >= CERTAIN_SIGMAS:
        return "certain"
    return "likely" if sigmas >= _LIKELY_SIGMAS else "hint"


def no_surer(finding: Finding, faults: Iterable[Finding]) -> Finding:
    """A fault that is no surer than those whose corrections it was found under.

    Args:
        finding: the later one.
        faults: the earlier ones; those that are facts have corrected nothing.
    """
    if finding.severity == "info":
        return finding
    levels: tuple[Sureness, ...] = get_args(Sureness)
    weakest = [levels.index(fault.sure) for fault in faults if fault.severity != "info"]
    return replace(finding, sure=levels[max([levels.index(finding.sure), *weakest])])


def in_order(findings: list[Finding]) -> list[Finding]:
    """Errors first; within a severity in the order in which they were found."""
    return sorted(findings, key=lambda finding: _SEVERITIES.index(finding.severity))
