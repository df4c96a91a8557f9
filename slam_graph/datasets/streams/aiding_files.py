# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Files of fixes, known poses and odometry beside a recording.

``gnss.csv`` has a row for each fix, with one of these headers:

- ``#timestamp [ns],latitude [deg],longitude [deg],altitude [m],sigma_east [m],sigma_north [m],
  sigma_up [m]``; the first fix is the origin of the local world;
- ``#timestamp [ns],east [m],north [m],up [m],sigma_east [m],sigma_north [m],sigma_up [m]``, with an
  optional line ``# datum: latitude, longitude, altitude`` before the rows;
- NMEA sentences GGA, each after a time stamp: ``1403636579763555584,$GPGGA,…``.

Units may be left out of a header, and sigmas be called otherwise. Fixes without such a header are
refused, as degrees are not told from metres.

``odometry.csv`` has a row for each sample: ``#timestamp [ns],x [m],y [m],z [m],qx,qy,qz,qw``, the
pose of the body in the frame of the odometry.

``poses.csv`` has a row for each known pose: ``#timestamp [ns],x [m],y [m],z [m],qx,qy,qz,qw,
sigma_x [m],sigma_y [m],sigma_z [m],sigma_rx [rad],sigma_ry [rad],sigma_rz [rad]``, the pose of the
sensor in the world, and standard deviations along and about the axes of the world. Where the three
sigmas of position or orientation are ``inf``, that was not measured.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.datasets.streams.csv_rows import Rows, read_rows
from slam_graph.datasets.streams.geodesy import Datum, local_positions
from slam_graph.datasets.streams.pairing import in_order
from slam_graph.datasets.streams.vector_lengths import lengths_of
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.sensors import AidingData

FIXES, ODOMETRY, POSES = "gnss.csv", "odometry.csv", "poses.csv"

_FIX_ROW = [("stamp", "i8"), ("position", "f8", (3,)), ("sigma", "f8", (3,))]
_ODOMETRY_ROW = [("stamp", "i8"), ("position", "f8", (3,)), ("quaternion", "f8", (4,))]
_POSE_ROW = [*_ODOMETRY_ROW, ("sigma", "f8", (6,))]
_POSE_HEADER = (
    "#timestamp [ns],x [m],y [m],z [m],qx,qy,qz,qw,sigma_x [m],sigma_y [m],sigma_z [m],"
    "sigma_rx [rad],sigma_ry [rad],sigma_rz [rad]"
)
_LOCAL_HEADER = (
    "#timestamp [ns],east [m],north [m],up [m],sigma_east [m],sigma_north [m],sigma_up [m]"
)
_GEODETIC_COLUMNS = r"timestamp(\[ns])?,latitude(\[deg])?,longitude(\[deg])?,altitude(\[m])?,.*"
_LOCAL_COLUMNS = r"timestamp(\[ns])?,east(\[m])?,north(\[m])?,up(\[m])?,.*"
_DATUM = "# datum:"
_NMEA_SIGMA_M = 2.5
"""Standard deviation of a position whose dilution of precision (HDOP) is 1, of a code receiver."""
_NMEA_QUALITY_SIGMA_M = {"4": 0.02, "5": 0.3}
"""The same of a carrier-phase solution: integers fixed, or not."""
_VERTICAL = 2.0
"""Heights are so much less accurate."""
LARGEST_GEODETIC = np.array([90.0, 360.0, 1e6])
"""Latitudes and longitudes (degrees) and heights (m) are no larger."""
_FARTHEST_M, _LEAST_SIGMA = 1e6, 1e-9
"""Bounds on known poses: coordinates, and standard deviations in m and rad; these of fixes too."""


def read_aiding(
    folders: Sequence[Path], named: Mapping[str, str], diagnostics: Diagnostics
) -> AidingData:
    """Fixes, known poses and odometry in files; nothing where there are none.

    Args:
        folders: where the files are looked for.
        named: files of ``gnss``, ``poses`` and ``odometry`` instead.
        diagnostics: as for `read_fixes`.

    Raises:
        DataError: if a file that was named is missing, or a row cannot be read.
    """
    data = AidingData.empty()
    fixes = _find("gnss", FIXES, folders, named)
    odometry = _find("odometry", ODOMETRY, folders, named)
    if fixes is not None:
        data = read_fixes(fixes, diagnostics)
    if odometry is not None:
        data = data.with_odometry(*_read_odometry(odometry, diagnostics))
    poses = _find("poses", POSES, folders, named)
    if poses is not None and ("poses" in named or "sigma" in _header(poses)[0]):
        data = data.with_poses(*_read_poses(poses, diagnostics))
    return data


def _find(sensor: str, name: str, folders: Sequence[Path], named: Mapping[str, str]) -> Path | None:
    """The file of a sensor."""
    if sensor in named:
        path = Path(named[sensor])
        if not path.is_file():
            raise DataError(f"{path}: no such file of '{sensor}'")
        return path
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def read_fixes(path: Path, diagnostics: Diagnostics) -> AidingData:
    """The fixes of a file; see the module.

    Args:
        path: of the file.
        diagnostics: counts `gnss_dropped`: fixes that are not finite, have no solution, or are not
            in the order of time.

    Raises:
        DataError: if a row cannot be read, or the header is another one.
    """
    header, datum = _header(path)
    stamps: list[IntArray] = []
    positions: list[FloatArray] = []
    sigmas: list[FloatArray] = []
    nmea = False
    for rows in read_rows(path):
        nmea = nmea or "GGA," in rows.lines[0]
        if nmea:
            parsed = [_gga(rows, k) for k in range(len(rows.lines))]
            stamps.append(np.array([row[0] for row in parsed], np.int64))
            positions.append(np.array([row[1] for row in parsed]))
            sigmas.append(np.array([row[2] for row in parsed]))
            continue
        table = rows.parse(_FIX_ROW, "stamp [ns], three coordinates, three sigmas")
        stamps.append(table["stamp"])
        positions.append(table["position"])
        sigmas.append(table["sigma"])
    if not stamps:
        raise DataError(f"{path}: no fixes in this file")
    local = not nmea and _are_local(header, path)
    covariances = covariances_of(np.concatenate(sigmas))
    found = np.concatenate(stamps), np.concatenate(positions), covariances
    return fixes_from(*found, path, diagnostics, (local, datum))


def covariances_of(sigmas: FloatArray) -> FloatArray:
    """Covariances (N, 3, 3) of standard deviations (N, 3); NaN of those that are not positive."""
    with np.errstate(over="ignore"):  # what is too large is infinite, and dropped
        variances = np.where(sigmas > 0, sigmas, np.nan) ** 2
    covariances = np.zeros((len(sigmas), 3, 3))
    covariances[:, range(3), range(3)] = variances
    return covariances


def fixes_from(
    stamps_ns: IntArray,
    positions: FloatArray,
    covariances: FloatArray,
    path: Path,
    diagnostics: Diagnostics,
    frame: tuple[bool, Datum | None] = (False, None),
) -> AidingData:
    """The fixes that can be used, in a local world.

    Args:
        stamps_ns: (N,) of the fixes.
        positions: (N, 3) latitude, longitude and height, or local ones.
        covariances: (N, 3, 3) east, north, up, m².
        path: of the file, for messages.
        diagnostics: as for `read_fixes`.
        frame: whether positions are local, and the datum; the first fix if None.
    """
    local, datum = frame
    whole = np.column_stack([positions, covariances.reshape(-1, 9)])
    good = Files.are_measurable(whole).all(axis=1)
    good &= (np.diagonal(covariances, axis1=1, axis2=2) >= _LEAST_SIGMA**2).all(axis=1)
    if not local:
        good &= (np.abs(positions) <= LARGEST_GEODETIC).all(axis=1)
    good = np.asarray(good, np.bool_)
    kept = kept_of(stamps_ns, good, "gnss_dropped", f"{path}: fix", diagnostics)
    stamps_ns, positions, covariances = stamps_ns[kept], positions[kept], covariances[kept]
    if not local and len(positions):
        datum = datum or (float(positions[0, 0]), float(positions[0, 1]), float(positions[0, 2]))
        positions = local_positions(positions, datum)
    return AidingData.of_fixes(stamps_ns, positions, covariances, datum)


def kept_of(
    stamps_ns: IntArray, good: BoolArray, kind: str, what: str, diagnostics: Diagnostics
) -> IntArray:
    """Indices of the measurements that are good and in the order of time.

    Args:
        stamps_ns: (N,) of the measurements.
        good: (N,) which can be used, but for their order.
        kind: under which each of the others is counted.
        what: they are and where, for messages.
        diagnostics: counts them.
    """
    good = good & Files.are_times(stamps_ns)
    for stamp_ns in stamps_ns[~good].tolist():
        diagnostics.warn(kind, f"{what} at {stamp_ns} dropped, it has no values that can be used")
    whole = np.flatnonzero(good)
    stamps_ns = stamps_ns[whole]

    def dropped(index: int, _: int) -> None:
        late = f"{what} at {stamps_ns[index]} dropped, not in the order of time"
        diagnostics.warn(kind, late)

    return whole[in_order(stamps_ns, dropped)]


def _header(path: Path) -> tuple[str, Datum | None]:
    """The first line of a file in small letters, and the datum in its comments."""
    first = ""
    datum: Datum | None = None
    cells: list[float]
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(map(str.strip, file)):
            first = first or line.lower()
            if line.startswith(_DATUM):
                try:
                    cells = [float(cell) for cell in line[len(_DATUM) :].split(",")]
                except ValueError:
                    cells = []
                if len(cells) != 3 or not np.all(np.abs(cells) <= LARGEST_GEODETIC):
                    raise DataError(
                        f"{path}:{number + 1}: expected '{_DATUM} latitude, longitude, altitude', "
                        "in degrees and m"
                    )
                datum = cells[0], cells[1], cells[2]
            if "timestamp" in line.lower():
                first = line.lower()
            elif line and line[0] not in "#%":
                break
    return first, datum


def _are_local(header: str, path: Path) -> bool:
    """Whether a file of fixes says that they are local; an error if it says nothing of it."""
    columns = header.lstrip("# ").replace(" ", "")
    local = re.fullmatch(_LOCAL_COLUMNS, columns) is not None
    if not local and re.fullmatch(_GEODETIC_COLUMNS, columns) is None:
        raise DataError(
            f"{path}: nothing says whether these fixes are in degrees or metres; begin it with "
            "'#timestamp [ns],latitude [deg],longitude [deg],altitude [m],sigma_east [m],"
            f"sigma_north [m],sigma_up [m]' or '{_LOCAL_HEADER}'"
        )
    return local


def _gga(rows: Rows, index: int) -> tuple[int, FloatArray, FloatArray]:
    """Time, geodetic position and sigmas of a row of a stamp and a GGA sentence of NMEA 0183.

    A sentence without a solution gives NaN.
    """
    stamp, *cells = rows.lines[index].strip().split(",")
    nothing = np.full(3, np.nan)
    try:
        stamp_ns = int(stamp)
        if abs(stamp_ns) >= Files.LARGEST_STAMP_NS:
            raise ValueError
        if cells[6] == "0" or not cells[2]:
            return stamp_ns, nothing, nothing
        position = np.array(
            [
                _degrees(cells[2]) * (-1.0 if cells[3] == "S" else 1.0),
                _degrees(cells[4]) * (-1.0 if cells[5] == "W" else 1.0),
                float(cells[9]) + float(cells[11] or 0.0),  # of the sea, and of the geoid
            ]
        )
        hdop = float(cells[8] or 1.0)
        sigma = _NMEA_QUALITY_SIGMA_M.get(cells[6], _NMEA_SIGMA_M) * hdop
        return stamp_ns, position, sigma * np.array([1.0, 1.0, _VERTICAL])
    except (ValueError, IndexError):
        raise DataError(
            f"{rows.where(index)}: expected a stamp [ns] and a GGA sentence: "
            f"'{rows.lines[index].strip()[:80]}'"
        ) from None


def _degrees(text: str) -> float:
    """Degrees of NMEA's dddmm.mmmm."""
    point = text.index(".") - 2
    return float(text[:point] or 0.0) + float(text[point:]) / 60.0


def _read_odometry(path: Path, diagnostics: Diagnostics) -> tuple[IntArray, FloatArray, FloatArray]:
    """Stamps, positions and quaternions of the odometry in a file."""
    what = "stamp [ns], x, y, z, qx, qy, qz, qw"
    tables = [rows.parse(_ODOMETRY_ROW, what) for rows in read_rows(path)]
    if not tables:
        raise DataError(f"{path}: no odometry in this file")
    table = np.concatenate(tables)
    stamps, lengths = table["stamp"], lengths_of(table["quaternion"])
    good = Files.are_measurable(table["position"]).all(axis=1) & (np.abs(lengths - 1.0) < 1e-2)
    table = table[kept_of(stamps, good, "odometry_dropped", f"{path}: odometry", diagnostics)]
    return table["stamp"], table["position"], table["quaternion"]


def _read_poses(
    path: Path, diagnostics: Diagnostics
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Stamps, positions, quaternions and sigmas of the known poses in a file.

    Raises:
        DataError: if a row cannot be read, or there is none.
    """
    what = "stamp [ns], x, y, z, qx, qy, qz, qw, three sigmas [m], three sigmas [rad]"
    tables = [rows.parse(_POSE_ROW, what) for rows in read_rows(path)]
    if not tables:
        raise DataError(f"{path}: no poses in this file")
    table = np.concatenate(tables)
    columns = (table["stamp"], table["position"], table["quaternion"], table["sigma"])
    return known_poses_from(*columns, f"{path}: pose", diagnostics)


def known_poses_from(
    stamps_ns: IntArray,
    positions: FloatArray,
    quaternions: FloatArray,
    sigmas: FloatArray,
    what: str,
    diagnostics: Diagnostics,
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Those of some known poses that can be used, in the order of time.

    Args:
        stamps_ns: (N,) of the poses.
        positions: (N, 3) world, m.
        quaternions: (N, 4) x, y, z, w.
        sigmas: (N, 6) standard deviations, m along and rad about the axes of the world; three of
            them are infinite where the position, or the orientation, was not measured.
        what: they are and where, for messages.
        diagnostics: counts the others (`poses_dropped`).

    Returns:
        The same four arrays without the others.
    """
    positions, quaternions = positions.copy(), quaternions.copy()
    parts = sigmas.reshape(-1, 2, 3)
    measured = np.asarray(np.isfinite(parts).all(axis=2), np.bool_)
    unknown = np.asarray((parts == np.inf).all(axis=2), np.bool_)
    # what was not measured may have any value
    positions[unknown[:, 0]], quaternions[unknown[:, 1]] = 0.0, (0, 0, 0, 1)
    lengths = lengths_of(quaternions)
    good = np.isfinite(positions).all(axis=1) & (np.abs(lengths - 1.0) < 1e-2)
    good &= (measured | unknown).all(axis=1) & measured.any(axis=1)
    good &= (np.abs(positions) <= _FARTHEST_M).all(axis=1)
    good &= (sigmas >= _LEAST_SIGMA).all(axis=1)
    good = np.asarray(good, np.bool_)
    kept = kept_of(stamps_ns, good, "poses_dropped", what, diagnostics)
    return stamps_ns[kept], positions[kept], quaternions[kept], sigmas[kept]


def aiding_texts(data: AidingData) -> dict[str, str]:
    """The contents of the files above by their names; nothing of what there is not."""
    texts = {}
    if len(data.fix_stamps_ns):
        lines = [] if data.datum is None else [f"{_DATUM} " + ", ".join(map(repr, data.datum))]
        lines.append(_LOCAL_HEADER)
        sigmas = np.sqrt(np.diagonal(data.fix_covariances, axis1=1, axis2=2))
        numbers = np.hstack([data.fix_positions, sigmas])
        lines += _rows(data.fix_stamps_ns, numbers)
        texts[FIXES] = "\n".join(lines) + "\n"
    if len(data.odometry_stamps_ns):
        numbers = np.hstack([data.odometry_positions, data.odometry_quaternions])
        lines = ["#timestamp [ns],x [m],y [m],z [m],qx,qy,qz,qw"]
        lines += _rows(data.odometry_stamps_ns, numbers)
        texts[ODOMETRY] = "\n".join(lines) + "\n"
    if len(data.pose_stamps_ns):
        numbers = np.hstack([data.pose_positions, data.pose_quaternions, data.pose_sigmas])
        lines = [_POSE_HEADER, *_rows(data.pose_stamps_ns, numbers)]
        texts[POSES] = "\n".join(lines) + "\n"
    return texts


def _rows(stamps_ns: IntArray, numbers: FloatArray) -> list[str]:
    """Rows of a stamp and numbers, exact to the last bit."""
    pairs = zip(stamps_ns.tolist(), numbers.tolist(), strict=True)
    return [",".join([str(stamp), *map(repr, row)]) for stamp, row in pairs]
