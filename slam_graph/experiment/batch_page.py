# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a batch: one HTML file with a row and a picture of the path for each recording."""

from __future__ import annotations

import base64
import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from statistics import median
from urllib.parse import quote

import cv2

from slam_graph.errors import DataError
from slam_graph.experiment.batch_summary import NOT_DONE, Row
from slam_graph.experiment.path_thumbnail import CAUSAL, SMOOTHED, TRUE, thumbnail
from slam_graph.image_files import ImageFile
from slam_graph.results import ResultFolder, load_result

_PICTURE = "trajectory.png"
_PICTURE_WIDTH, _PICTURE_QUALITY = 1100, 70

_STYLE = """
:root{color-scheme:light}
body{font:15px/1.45 system-ui,sans-serif;color:#222;max-width:78em;margin:2em auto;padding:0 1.2em}
h1{font-size:1.5em;margin:0 0 .2em}
.tiles{display:flex;flex-wrap:wrap;gap:.8em;margin:1em 0}
.tile{border:1px solid #ddd;border-radius:.5em;padding:.5em .9em;min-width:7em}
.tile b{display:block;font-size:1.35em}.tile span{color:#666;font-size:.85em}
.key{color:#555;font-size:.9em}
.key i{display:inline-block;width:1.6em;height:0;margin:0 .35em 0 1em;
border-top:3px solid;vertical-align:middle}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th{position:sticky;top:0;background:#fff;border-bottom:2px solid #999;
white-space:nowrap;padding:.4em .6em;text-align:right;font-weight:600}
th[tabindex]{cursor:pointer}th[tabindex]:hover{background:#f2f2f2}
th[aria-sort]::after{content:"\\2009▾";color:#0072b2}th[aria-sort=ascending]::after{content:"\\2009▴"}
td{border-bottom:1px solid #e4e4e4;padding:.3em .6em;text-align:right}
.text{text-align:left}.name{font-weight:600;overflow-wrap:anywhere}
small{display:block;color:#666;font-weight:400;overflow-wrap:anywhere}
.badge{border-radius:.8em;padding:.1em .6em;font-size:.85em;white-space:nowrap;border:1px solid}
.ok{color:#00664a;background:#e3f4ee}.bad{color:#a34700;background:#fdeee2}
.none{color:#555;background:#eee}
svg{display:block}button{all:unset;cursor:zoom-in}
dialog{border:0;border-radius:.5em;max-width:94vw;max-height:94vh;box-shadow:0 1em 4em #0006}
dialog::backdrop{background:#0008}dialog img{max-width:90vw;max-height:86vh;display:block}
.table{overflow-x:auto}
@media(min-width:60em){.table{overflow:visible}}
@media(max-width:60em){.wide{display:none}td,th{padding:.3em .4em}svg{width:6em;height:auto}
.name{overflow-wrap:normal;min-width:6em}.name small{min-width:8em}}
"""

_SCRIPT = """
document.querySelectorAll('th[tabindex]').forEach(head => head.onclick = () => {
  const body = document.querySelector('tbody'), column = head.cellIndex;
  const up = head.getAttribute('aria-sort') !== 'ascending';
  document.querySelectorAll('th').forEach(other => other.removeAttribute('aria-sort'));
  head.setAttribute('aria-sort', up ? 'ascending' : 'descending');
  const key = row => row.cells[column].dataset.key;
  [...body.rows].sort((a, b) => {
    const x = key(a), y = key(b), p = Number(x), q = Number(y);
    if (x === '' || y === '') return (x === '') - (y === '');
    const order = isNaN(p) || isNaN(q) ? x.localeCompare(y) : p - q;
    return up ? order : -order;
  }).forEach(row => body.append(row));
});
document.onkeydown = pressed => {
  if (pressed.key === 'Enter' && pressed.target.matches('th')) pressed.target.click();
};
const shown = document.querySelector('dialog');
document.querySelectorAll('button').forEach(button => button.onclick = () => {
  shown.querySelector('img').src = button.dataset.picture;
  shown.showModal();
});
shown.onclick = () => shown.close();
"""

_NUMBERS: tuple[tuple[str, str, Callable[[float], str], str], ...] = (
    ("recorded_s", "length", lambda s: f"{s:.1f} s", " wide"),
    ("coverage", "coverage", lambda part: f"{part:.1%}", ""),
    ("ate_m", "causal ATE", lambda m: f"{m:.3f} m", ""),
    ("smoothed_ate_m", "smoothed ATE", lambda m: f"{m:.3f} m", ""),
    ("rotation_deg", "rotation", lambda deg: f"{deg:.2f}°", " wide"),
    ("real_time_factor", "speed", lambda factor: f"{factor:.1f} ×", ""),
)
"""Columns of numbers: name, title, text of a value, and further classes of the cell."""

_EXPLANATION = (
    "ATE and rotation: root mean square errors against the ground truth, where there is one, after "
    "alignment of what nothing measured (yaw and position with an IMU). Speed: recorded time over "
    "the time of the causal estimate. A dot is the start. "
    "A click on the title of a column sorts, one on a path shows more of the run."
)


def write_page(folder: ResultFolder, rows: Sequence[Row]) -> None:
    """Write `index.html`, with everything that it shows in it."""
    titles = ("path", "recording", "status", *(title for _, title, *_ in _NUMBERS), "warnings")
    wide = {title: extra for _, title, _, extra in _NUMBERS}
    heads = "".join(
        f'<th class="{"text" if k < 3 else ""}{wide.get(title, "")}"'
        f"{' tabindex=0' if k else ''}>{title}</th>"
        for k, title in enumerate(titles)
    )
    lines = [
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        f"<title>Batch {escape(folder.folder.name)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{len(rows)} recordings</h1>",
        f'<div class="tiles">{_tiles(rows)}</div>',
        f'<p class="key">Paths from above:{_key()}<br>{escape(_EXPLANATION)}</p>',
        f'<div class="table"><table><thead><tr>{heads}</tr></thead><tbody>',
        *(_line(row, folder.folder) for row in rows),
        "</tbody></table></div><dialog><img alt='the run'></dialog>",
        f"<script>{_SCRIPT}</script></body></html>\n",
    ]
    folder.text("index.html", ["\n".join(lines)])


def _tiles(rows: Sequence[Row]) -> str:
    """The batch in a few figures."""
    states = Counter(row["status"] for row in rows)
    figures = [(str(count), state.replace("_", " ")) for state, count in states.most_common()]
    length_s = sum(row["recorded_s"] or 0.0 for row in rows)
    figures.append((f"{length_s / 60:.1f} min", "recorded"))
    for name, title in (("ate_m", "median causal ATE"), ("smoothed_ate_m", "median smoothed ATE")):
        values = [row[name] for row in rows if row[name] is not None and row["status"] == "ok"]
        if values:
            figures.append((f"{median(values):.3f} m", title))
    return "".join(
        f'<div class="tile"><b>{escape(value)}</b><span>{escape(title)}</span></div>'
        for value, title in figures
    )


def _key() -> str:
    """What the colours of the paths mean."""
    names = ((TRUE, "ground truth"), (CAUSAL, "causal"), (SMOOTHED, "smoothed"))
    return "".join(f'<i style="color:{color}"></i>{name}' for color, name in names)


def _line(row: Row, folder: Path) -> str:
    """The row of a recording."""
    done = row["folder"] is not None
    name = escape(row["name"])
    if done:
        link = quote(os.path.relpath(row["folder"], folder))
        name = f'<a href="{link}/">{name}</a>'
    about = ", ".join(str(row[key]) for key in ("algorithm", "format") if row[key] is not None)
    kind = {"ok": "ok", NOT_DONE: "none"}.get(row["status"], "bad")
    state = row["status"].replace("_", " ")
    message = f"<small>{escape(row['message'])}</small>" if row["message"] else ""
    cells = [
        _cell(_path(Path(row["folder"])) if done else "", row["name"], "text"),
        _cell(f"{name}<small>{escape(about)}</small>", row["name"], "text name"),
        _cell(f'<span class="badge {kind}">{escape(state)}</span>{message}', state, "text"),
    ]
    for key, _, text, extra in _NUMBERS:
        value = row[key]
        known = value is not None and math.isfinite(value)
        cells.append(_cell(text(value) if known else "–", value if known else "", extra.strip()))
    warnings = row["warnings"]
    kinds = escape(row["warning_kinds"] or "", quote=True)
    shown = "–" if warnings is None else f'<span title="{kinds}">{warnings}</span>'
    cells.append(_cell(shown, "" if warnings is None else warnings, ""))
    return f"<tr>{''.join(cells)}</tr>"


def _cell(content: str, key: object, kind: str) -> str:
    """A cell, and what it is sorted by."""
    return f'<td class="{kind}" data-key="{escape(str(key), quote=True)}">{content}</td>'


def _path(folder: Path) -> str:
    """The picture of a path; a click shows the picture of the run, if there is one."""
    try:
        drawn = thumbnail(load_result(folder))
    except DataError:
        return ""
    picture = _embedded(folder / _PICTURE)
    return drawn if picture is None else f'<button data-picture="{picture}">{drawn}</button>'


def _embedded(path: Path) -> str | None:
    """A picture as an address that holds it, smaller than it was."""
    try:
        image = ImageFile.decode(path.read_bytes(), cv2.IMREAD_COLOR)
    except OSError:
        return None
    if isinstance(image, str):
        return None
    height, width = image.shape[:2]
    if width > _PICTURE_WIDTH:
        size = (_PICTURE_WIDTH, round(height * _PICTURE_WIDTH / width))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _PICTURE_QUALITY])
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode("ascii")
