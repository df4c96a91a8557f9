# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps of frames, and exposure, sharpness and repetition of images."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.diagnosis.finding import Finding, graded
from slam_graph.diagnosis.image_quality import ImageFigures, ImageSurvey

_PAUSE_PERIODS, _JITTER, _PAUSED = 3.0, 0.25, 0.05
"""A pause is so many periods; stamps may scatter by such a part of one; and pauses that take up
such a share of the time are a warning."""
_BLANK_STD = 4.0
"""Standard deviation of the grey levels of a blank image."""
_BRIGHT, _BRIGHT_MEAN = 0.3, 200.0
_DARK, _DARK_MEAN = 0.6, 25.0
"""Shares of pixels and means of images that are overexposed, or dark."""
_BLURRED = 0.8
"""Blur from which on corners are hard to locate."""
_SOME, _MANY = 0.02, 0.5
"""Shares of the images from which on a fault is a warning, and an error."""
_FEW_TRACKS = 25
"""Features in a frame below which an estimate is poor."""


def check_stamps(frames: list[IntArray]) -> list[Finding]:
    """Findings about rate, pauses and scatter of the frames."""
    steps = np.concatenate([np.diff(stamps) for stamps in frames] or [np.zeros(0)])
    if len(steps) < 2:
        return [Finding("frames_missing", "error", "hardly any frames", "record images")]
    period = float(np.median(steps))
    text = f"{1e9 / period:.1f} frames a second"
    found = [Finding("frame_rate", "info", text, values={"rate_hz": 1e9 / period})]
    pauses = steps > _PAUSE_PERIODS * period
    if np.any(pauses):
        share = float(np.sum(steps[pauses]) / np.sum(steps))
        what = f"{np.sum(pauses)} pauses between frames, the longest {1e-9 * steps.max():.2f} s"
        fix = "look for lost images: disk or bus too slow"
        found.append(Finding("frame_pauses", "warning" if share > _PAUSED else "info", what, fix))
    # a frame that is missing is no jitter
    off = np.abs(steps / period - np.round(steps / period))[~pauses]
    jitter = float(np.sqrt(np.mean(off**2)))
    if jitter > _JITTER:
        what = f"the stamps of the frames scatter by {jitter:.0%} of the period"
        fix = "use the stamps of the exposure, and not those of arrival"
        found.append(Finding("frame_jitter", "warning", what, fix, values={"jitter": jitter}))
    return found


def check_tracks(counts: list[int]) -> list[Finding]:
    """A finding if frames have few features; `counts` of the features of the frames."""
    usual = float(np.median(counts)) if counts else 0.0
    if usual >= _FEW_TRACKS or not counts:
        return []
    what = f"only {usual:.0f} features in most frames"
    fix = "look at the images with `slam-graph frontend run`; frontend.equalization=clahe"
    return [Finding("few_tracks", "info", what, fix, values={"features": usual})]


def check_images(survey: ImageSurvey) -> list[Finding]:
    """Findings about the images of all cameras."""
    found = []
    for c, figures in enumerate(survey.figures):
        total = len(figures) + survey.missing[c]
        if total == 0:
            continue
        found += _missing(c, survey.missing[c], total)
        for kind, seen, what, fix in _FAULTS:
            bad = [f for f in figures if seen(f)]
            share = len(bad) / total
            if share > _SOME and len(bad) > 1:
                severity = graded(share > _MANY)
                text = f"{share:.0%} of the images of camera {c} {what}, first at {bad[0].stamp_ns}"
                values = {"camera": c, "share": share}
                found.append(Finding(kind, severity, text, fix, values=values))
    return found


def _missing(camera: int, missing: int, total: int) -> list[Finding]:
    if missing <= _SOME * total:
        return []
    text = f"camera {camera} has no usable image in {missing / total:.0%} of the frames"
    fix = "look for lost or damaged files: `slam-graph data check --images`"
    return [Finding("images_missing", graded(missing > _MANY * total), text, fix)]


def _overexposed(f: ImageFigures) -> bool:
    return f.bright > _BRIGHT and f.mean > _BRIGHT_MEAN


def _blank(f: ImageFigures) -> bool:
    return f.std < _BLANK_STD and not _overexposed(f)


def _dark(f: ImageFigures) -> bool:
    return not _blank(f) and f.dark > _DARK and f.mean < _DARK_MEAN


def _blurred(f: ImageFigures) -> bool:
    return not _blank(f) and not _overexposed(f) and not _dark(f) and f.blur > _BLURRED


def _repeated(f: ImageFigures) -> bool:
    return f.repeated and not _blank(f)


_FAULTS = (
    ("image_blank", _blank, "are blank", "check the camera's cable, lens cap and exposure"),
    ("image_repeated", _repeated, "repeat the one before", "look for a driver that is stuck"),
    ("image_overexposed", _overexposed, "are overexposed", "shorten the exposure time"),
    ("image_dark", _dark, "are dark", "lengthen the exposure; frontend.equalization=clahe"),
    ("image_blurred", _blurred, "are blurred", "focus the lens; shorten the exposure time"),
)
