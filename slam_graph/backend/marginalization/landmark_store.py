# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks that an EKF keeps while they are not tracked, at no cost until they are seen again.

When variables e are eliminated, a Gaussian over (e, s) factors into p(e | s) p(s). Filters continue
with p(s). As long as a feature in e is not measured again, p(e | s) does not change: no measurement
of s affects it. So these conditionals are stored, and the filter continues with what it tracks.
This is the joint Gaussian of all features, exactly, in the form of a Bayes net (Kaess et al. 2008)
and not as one dense matrix, whose update is O(n²) in the number n of all features.

When a feature is seen again, its conditional is multiplied with those stored after it, and the
variables that these eliminated are eliminated from the product. That pays as long as lost features
stay lost, as those of a tracker do. Where identities return all the time, each frame would reorder
all that was stored: then the store is closed. From then on lost features are marginalised for good,
and one that comes back is a new one. What was measured of it before stays in the prior of the
others; that it is the same point is no longer used.

The oldest conditionals are dropped where all of them take too much memory. That marginalises their
features for good as well, exactly: no later conditional depends on what an earlier one eliminated.

Where fixes move the world, what is stored moves with it, to first order in each of the moves.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam import Symbol
from gtsam.symbol_shorthand import L

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.solve.square_root import (
    Conditional,
    Layout,
    SquareRootInformation,
    trapezoidal,
)
from slam_graph.backend.solve.state import POINT_DIM, State, dims_of, letter_and_index

_TURNING = "vl"
"""Letters of variables whose tangents are in axes of the world, and not of the body."""

_MAX_EXCHANGES = 300
"""Work limit: after this many conditionals were reordered to recall features, the store closes."""

_MAX_BYTES = 10 * 2**20
"""Memory of all conditionals. In one recording whose features come back (stereo tracks of
openvins_sim) they were at most 9 MB away; with a larger state the same memory holds less time."""


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """Where a feature is: which conditional eliminated it, and its linearisation point (3,)."""

    conditional: int
    first: FloatArray


class LandmarkStore:
    """Conditionals of eliminated variables, in the order of elimination.

    They are over the offsets of all variables from the first linearisation point that each had.

    Attributes:
        open: whether it takes features; a closed one is empty.
    """

    def __init__(self) -> None:
        self.open = True
        self._exchanges = 0
        self._conditionals: deque[Conditional] = deque()
        self._dropped = 0  # conditionals that are no longer there; places count from the first one
        self._places: dict[int, _Place] = {}
        self._moved: dict[int, FloatArray] = {}  # how far linearisation points are from the first
        self._axes = np.eye(3)  # turn from the axes of the conditionals to those of the world now

    def __len__(self) -> int:
        """How many features are stored."""
        return len(self._places)

    @property
    def size(self) -> int:
        """Dimension of the stored features."""
        return POINT_DIM * len(self._places)

    def put(self, conditional: Conditional, state: State) -> None:
        """Store the conditional of eliminated variables.

        Args:
            conditional: of all variables that a step eliminated, over an increment of their
                estimates.
            state: that still has them.
        """
        for key in conditional.gone.dims:
            symbol = Symbol(key)
            if symbol.chr() == ord("l"):
                (first,) = state.positions_of(np.array([symbol.index()]), first=True)
                self._places[symbol.index()] = _Place(self._end, first)
        offset = np.concatenate([state.offset(part) for part in conditional.layouts])
        about_first = conditional.shifted(-offset - self._bases(conditional))
        self._conditionals.append(self._turned(about_first, self._axes.T))
        size = sum(each.rows.nbytes for each in self._conditionals)
        while size > _MAX_BYTES:
            size -= self._drop_oldest()

    @property
    def _has_first_axes(self) -> bool:
        """Whether the world has not turned since the conditionals were stored."""
        return bool(np.array_equal(self._axes, np.eye(3)))

    @property
    def _end(self) -> int:
        """The number of the conditional to come."""
        return self._dropped + len(self._conditionals)

    def _drop_oldest(self) -> int:
        """Marginalise what the oldest conditional eliminated for good; its size in bytes."""
        oldest = self._conditionals.popleft()
        for key in oldest.gone.dims:
            self._moved.pop(key, None)
        self._places = {j: at for j, at in self._places.items() if at.conditional > self._dropped}
        self._dropped += 1
        return oldest.rows.nbytes

    def follow(self, state: State) -> None:
        """Note that the linearisation points of all variables move to their estimates now."""
        for key, offset in state.offsets.items():
            if offset.any():
                self._moved[key] = self._moved.get(key, 0.0) + offset

    def follow_world(
        self, motion: gtsam.Pose3, centre: FloatArray, increments: Mapping[int, FloatArray]
    ) -> None:
        """Note that the world has moved, and all linearisation points with it.

        Conditionals stay in the axes of the world where the first of them was stored.

        Args:
            motion: new_T_old of the worlds.
            centre: (3,) the point in the old world about which it has turned.
            increments: of the variables in the state, to first order, along tangents in the old
                world.
        """
        if not self._conditionals:
            self.forget()
            return
        turn = motion.rotation().matrix()
        self._axes = turn @ self._axes
        held = {key for part in self._conditionals for key in part.keys}
        stored = [(L(j), place.first) for j, place in self._places.items()]
        firsts = np.array([first for _, first in stored]).reshape(-1, 3)
        there = firsts @ turn.T + motion.translation()
        shift = motion.transformFrom(centre) - centre
        straight = shift + np.cross(gtsam.Rot3.Logmap(motion.rotation()), firsts - centre)
        moves = zip([key for key, _ in stored], straight, strict=True)
        moved = {}
        for key, increment in {**increments, **dict(moves)}.items():
            if key in held:
                base = self._moved.get(key, 0.0) + increment
                moved[key] = turn @ base if letter_and_index(key)[0] in _TURNING else base
        self._moved = moved
        for (key, _), first in zip(stored, there, strict=True):
            j = letter_and_index(key)[1]
            self._places[j] = replace(self._places[j], first=first)

    def forget(self) -> None:
        """Marginalise all stored features for good, and go on taking others."""
        self._conditionals.clear()
        self._places.clear()
        self._moved.clear()
        self._axes = np.eye(3)

    def _turned(self, conditional: Conditional, turn: FloatArray) -> Conditional:
        """A conditional with the axes of velocities and points turned: of δ' = turn δ.

        Args:
            conditional: over δ.
            turn: (3, 3).
        """
        if self._has_first_axes:
            return conditional
        rows, column = conditional.rows.copy(), 0
        for part in conditional.layouts:
            for key, dim in part.dims.items():
                if letter_and_index(key)[0] in _TURNING:
                    rows[:, column : column + 3] = rows[:, column : column + 3] @ turn.T
                column += dim
        return Conditional(*conditional.layouts, rows)

    def _bases(self, conditional: Conditional) -> FloatArray:
        """How far the linearisation points of variables (w + n,) are from their first ones."""
        keys = [(key, dim) for part in conditional.layouts for key, dim in part.dims.items()]
        parts = [self._moved.get(key, np.zeros(dim)) for key, dim in keys]
        return np.concatenate([np.zeros(0), *parts])

    def due(self, seen: IntArray) -> IntArray:
        """Which features must become variables again: of those seen; none once the store closes."""
        if self._exchanges > _MAX_EXCHANGES:
            self.close()
        if not self._places:
            return np.zeros(0, np.int64)
        return np.array([j for j in seen.tolist() if j in self._places], dtype=np.int64)

    def close(self) -> None:
        """Marginalise all stored features for good, and take no more."""
        self.open = False
        self.forget()

    def recall(
        self, features: IntArray, prior: SquareRootInformation, state: State
    ) -> SquareRootInformation:
        """Make features variables of the state again.

        Args:
            features: ids of stored features.
            prior: over the offsets of the variables in the state.
            state: gets the features.

        Returns:
            The prior with the features before all other variables.
        """
        places = {int(j): self._places.pop(int(j)) for j in features}
        carried = Conditional.nothing()
        wanted = {L(j) for j in places}
        first = min(place.conditional for place in places.values())
        self._exchanges += self._end - first
        for k in range(first - self._dropped, len(self._conditionals)):
            self._conditionals[k], carried = _exchanged(self._conditionals[k], carried, wanted)
        carried = self._turned(carried, self._axes)
        if not self._has_first_axes:
            carried = replace(carried, rows=trapezoidal(carried.rows))
        carried = carried.shifted(self._bases(carried))
        for j, place in places.items():
            state.insert_point(j, place.first)
        state.update(carried.gone, carried.solution(state.offset(carried.given)))
        state.freeze(wanted)
        return _joined(carried, prior)


def _exchanged(
    conditional: Conditional, carried: Conditional, wanted: set[int]
) -> tuple[Conditional, Conditional]:
    """Change the order of elimination: wanted variables after the others of a conditional.

    Args:
        conditional: p(e, w | s), w being those of its variables that are wanted.
        carried: p(w' | e, …), the wanted variables that were eliminated before.
        wanted: keys of all wanted variables.

    Returns:
        p(e | w, w', s, …) and p(w, w' | s, …).
    """
    if not carried.gone.size and wanted.isdisjoint(conditional.gone.dims):
        return conditional, carried
    gone = [key for key in conditional.gone.dims if key not in wanted]
    found = [*carried.gone.dims, *(key for key in conditional.gone.dims if key in wanted)]
    parts = (conditional, carried)
    known = {*gone, *found}
    parents = dict.fromkeys([*conditional.given.dims, *carried.given.dims])
    given = [key for key in parents if key not in known]
    layout = Layout(dims_of([*gone, *found, *given]))
    rows = np.zeros((sum(len(part.rows) for part in parts), layout.size + 1))
    top = 0
    for part in parts:
        columns = np.append(layout.indices(part.keys), layout.size)
        rows[top : top + len(part.rows), columns] = part.rows
        top += len(part.rows)
    triangle = trapezoidal(rows)
    width = Layout(dims_of(gone)).size
    return (
        Conditional(
            Layout(dims_of(gone)),
            Layout(dims_of([*found, *given])),
            triangle[:width].copy(),  # a view would keep all rows
        ),
        Conditional(Layout(dims_of(found)), Layout(dims_of(given)), triangle[width:top, width:]),
    )


def _joined(carried: Conditional, prior: SquareRootInformation) -> SquareRootInformation:
    """p(w | s) p(s) as one Gaussian over (w, s)."""
    w, n = carried.gone.size, prior.layout.size
    layout = Layout({**carried.gone.dims, **prior.layout.dims})
    Rd = np.zeros((w + n + 1, w + n + 1), order="F")
    Rd[w:, w:] = prior.Rd
    Rd[:w, np.append(layout.indices(carried.keys), w + n)] = carried.rows
    return SquareRootInformation(layout, Rd)
