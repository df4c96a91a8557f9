# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the property-based tests of readers share: settings, generated values, near-valid text.

The same examples are tried in each run. `SLAM_GRAPH_MUTATIONS=20000` makes a campaign of it, with
so many new examples of each property, as in `damage`.
"""

import random
import re
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import gtsam
import numpy as np
import pytest
from damage import CAMPAIGN
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.internal.conjecture import providers

from slam_graph.errors import SlamGraphError
from slam_graph.geometry import Trajectory

_Read = TypeVar("_Read")
_Test = TypeVar("_Test", bound=Callable[..., None])
_SETTINGS = "_hypothesis_internal_use_settings"
"""Where Hypothesis keeps the settings of a test until it is run."""

if not CAMPAIGN:
    # Hypothesis also tries numbers and texts of the modules that are loaded, and which these are
    # depends on the tests that ran before in the same process.
    assert hasattr(providers, "_get_local_constants")
    providers._get_local_constants = providers.Constants


LARGEST_STAMP_NS = 2**62
"""What readers take for a time is nearer to zero."""


def examples(full: int = 60) -> Callable[[_Test], _Test]:
    """How a property is tried: always the same examples, but for a campaign.

    Args:
        full: how many examples `make slow` tries; `make test` tries half as many. The fixture
            `share` says which.
    """
    tried = settings(
        max_examples=CAMPAIGN or full // 2,
        derandomize=not CAMPAIGN,
        print_blob=bool(CAMPAIGN),
        phases=[Phase.explicit, Phase.generate, Phase.shrink],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )

    def property_of(test: _Test) -> _Test:
        test.full = full  # type: ignore[attr-defined]
        return pytest.mark.usefixtures("share")(tried(test))

    return property_of


@contextmanager
def all_examples(test: Any) -> Iterator[None]:
    """A property is tried with all of its examples within the block."""
    assert hasattr(test, _SETTINGS)
    with pytest.MonkeyPatch.context() as patch:
        full = settings(getattr(test, _SETTINGS), max_examples=CAMPAIGN or test.full)
        patch.setattr(test, _SETTINGS, full)
        yield


def parsed(read: Callable[..., _Read], *arguments: Any) -> _Read | None:
    """What a reader gives; None if it refuses in one short line of ours.

    Any other exception passes, and fails the test.
    """
    try:
        return read(*arguments)
    except SlamGraphError as error:
        said = str(error)
        assert "\n" not in said
        assert len(said) < 2000
        return None


# --- values ---------------------------------------------------------------------------------------


def finite(largest: float = 1e17) -> st.SearchStrategy[float]:
    """Finite numbers: tiny, large, negative zero, subnormal; readers refuse those beyond 1e18."""
    return st.floats(-largest, largest, allow_nan=False)


def vectors(count: int, largest: float = 1e17) -> st.SearchStrategy[list[float]]:
    """Lists of so many finite numbers."""
    return st.lists(finite(largest), min_size=count, max_size=count)


def stamps(
    fewest: int = 0,
    most: int = 5,
    least: int = 1 - LARGEST_STAMP_NS,
    end: int = LARGEST_STAMP_NS,
) -> st.SearchStrategy[np.ndarray]:
    """(N,) increasing times, from `least` to before `end`."""
    inside = st.integers(least, end - 1)
    made = st.lists(inside, min_size=fewest, max_size=most, unique=True)
    return made.map(lambda values: np.array(sorted(values), np.int64))


def quaternions() -> st.SearchStrategy[list[float]]:
    """Unit quaternions x y z w, some of them of special rotations."""
    made = vectors(4, 1.0).filter(lambda q: float(np.linalg.norm(q)) > 0.1)
    unit = made.map(lambda q: (np.array(q) / np.linalg.norm(q)).tolist())
    half = st.sampled_from([(0, 0, 0, 1), (1, 0, 0, 0), (0, 0, 0, -1), (0.5, -0.5, 0.5, 0.5)])
    special = half.map(lambda q: [float(value) for value in q])
    return st.one_of(unit, special)


@st.composite
def poses(draw: st.DrawFn, largest: float = 1e6) -> gtsam.Pose3:
    """Poses with rotations of any angle."""
    x, y, z, w = draw(quaternions())
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), np.array(draw(vectors(3, largest))))


@st.composite
def trajectories(
    draw: st.DrawFn, largest: float = 1e17, columns: tuple[int, ...] = (7, 10, 16), **limits: int
) -> Trajectory:
    """Trajectories of one to a few poses, with 7, 10 or 16 numbers for each."""
    times = draw(stamps(fewest=1, **limits))
    count = draw(st.sampled_from(columns))
    rows = np.array([draw(vectors(count - 4, largest)) for _ in times]).reshape(len(times), -1)
    turns = np.array([draw(quaternions()) for _ in times])
    return Trajectory(
        times,
        rows[:, :3],
        turns,
        rows[:, 3:6] if count > 7 else None,
        gyro_biases=rows[:, 6:9] if count > 10 else None,
        accel_biases=rows[:, 9:12] if count > 10 else None,
    )


NAMES = st.one_of(
    st.sampled_from(
        ["cam0", "null", "~", "1", "true", " a b ", "é ü 日本 🛰", "'", '"', "#", "- ", ":"]
    ),
    st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=30),
)
"""Names that a person, or a program, may give something."""


# --- text -----------------------------------------------------------------------------------------

NUMBERS = st.one_of(
    st.integers(-3, 300).map(str),
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.floats(-1.0, 1.0).map(repr),
    st.integers(-(2**65), 2**65).map(str),
)
ODD = st.sampled_from(
    [
        *("nan", "inf", "-inf", "NaN", "1e400", "-1e400", "1e-400", "1e9999999", "+1", "-0", "007"),
        *("0x10", "1_0", "1__0", ".", "-", "+", "e", "1e", "1,5", "1j", "1d5", "None", "true"),
        *("١٢", "½", "−", "\x00", "\ufeff", "\x85", "\u2028", "\xa0", "\x1c"),
    ]
)
"""What some language takes for a number, or for a blank."""

TOKENS = st.one_of(NUMBERS, NUMBERS, NUMBERS, ODD, st.text(max_size=8))
"""Mostly numbers."""


def rows_of(
    separator: str, columns: int, tags: tuple[str, ...] = (), most: int = 6
) -> st.SearchStrategy[str]:
    """Text whose lines have about so many columns, after one of some tags."""
    right = st.lists(NUMBERS, min_size=columns, max_size=columns)
    wrong = st.lists(TOKENS, min_size=0, max_size=columns + 2)
    cells = st.one_of(right, right, wrong)
    between = st.sampled_from([separator, separator, separator, f"{separator} ", "\t"])
    line = st.builds(lambda values, mark: mark.join(values), cells, between)
    if tags:
        line = st.builds(lambda tag, rest: f"{tag} {rest}", st.sampled_from(tags), line)
    other = st.one_of(st.just(""), st.just("# comment"), st.text(max_size=12))
    lines = st.lists(st.one_of(line, line, line, other), max_size=most)
    return st.builds(lambda found, end: end.join(found), lines, LINE_ENDS)


def rows_as_bytes(separator: str, columns: int) -> st.SearchStrategy[bytes]:
    """The same as the bytes of a file."""
    return rows_of(separator, columns).map(lambda text: text.encode("utf-8", "surrogatepass"))


LINE_ENDS = st.sampled_from(["\n", "\n", "\r\n"])

ANYTHING = st.one_of(
    st.binary(max_size=200), st.text(max_size=200).map(lambda t: t.encode("utf-8", "surrogatepass"))
)
"""Any bytes, and any text."""


@st.composite
def dressed(
    draw: st.DrawFn, text: str, comments: tuple[str, ...] = ("#",), blanks: str = " \t"
) -> bytes:
    """The same content with comments, blank lines, blanks at the ends, CRLF, and a mark of UTF-8.

    Args:
        draw: of Hypothesis.
        text: of lines.
        comments: what comments begin with.
        blanks: what lines may end with.
    """
    if draw(st.booleans()):
        return text.encode()
    rng, end = random.Random(draw(st.integers(0, 2**32))), draw(LINE_ENDS)
    between = ["", *blanks, *(f"{mark} é, 1 2 3" for mark in comments)]
    lines: list[str] = []
    for line in text.splitlines():
        if rng.random() < 0.3:
            lines.append(rng.choice(between))
        lines.append(line + rng.choice(["", *blanks]))
    last, mark = draw(st.sampled_from(["", end])), draw(st.sampled_from([b"", BOM_UTF8]))
    return mark + (end.join(lines) + last).encode()


def in_seconds(stamp_ns: int) -> str:
    """A time in seconds with nine decimals."""
    sign, size = "-" if stamp_ns < 0 else "", abs(stamp_ns)
    return f"{sign}{size // 10**9}.{size % 10**9:09d}"


_EDITS = ("word", "word", "word", "line", "twice", "gone", "moved")


@st.composite
def edited(draw: st.DrawFn, text: str, marks: str = " ,\t:") -> bytes:
    """A valid text in which some words are others, or some lines twice, gone or elsewhere.

    Args:
        draw: of Hypothesis.
        text: of lines.
        marks: what separates words.
    """
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        if not lines:
            break
        at, edit = draw(st.integers(0, len(lines) - 1)), draw(st.sampled_from(_EDITS))
        if edit == "word":
            parts = re.split(f"([{re.escape(marks)}]+)", lines[at])  # a mark after each word
            parts[2 * draw(st.integers(0, len(parts) // 2))] = draw(TOKENS)
            lines[at] = "".join(parts)
        elif edit == "line":
            lines[at] = draw(st.text(max_size=12))
        elif edit == "twice":
            lines.insert(draw(st.integers(0, len(lines))), lines[at])
        else:
            line = lines.pop(at)
            if edit == "moved":
                lines.insert(draw(st.integers(0, len(lines))), line)
    return "\n".join(lines).encode("utf-8", "surrogatepass")


@contextmanager
def instead(path: Path, content: bytes) -> Iterator[None]:
    """A file with another content within the block."""
    whole = path.read_bytes()
    try:
        path.write_bytes(content)
        yield
    finally:
        path.write_bytes(whole)
