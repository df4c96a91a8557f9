# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rigs, samples and times of frames that the property-based tests write and read again."""

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st
from properties import (
    NAMES,
    finite,
    poses,
    vectors,
)

from slam_graph.datasets.calibration.calibration_yaml import MAX_OFFSET_S
from slam_graph.datasets.calibration.euroc_calibration import MAX_READOUT_S
from slam_graph.sensors import (
    CAMERA_MODELS,
    Camera,
    ImuData,
    ImuNoise,
    Rig,
    RigCamera,
)


@st.composite
def cameras(draw: st.DrawFn, size: tuple[int, int] | None = None) -> Camera:
    """Cameras of all models, with images of any size or of a given one."""
    model = CAMERA_MODELS[
        draw(st.sampled_from(["none", "radtan", "equidistant", "mei", "double_sphere"]))
    ]()
    ranges = [model.ranges.get(name, (-1e6, 1e6)) for name in model.coefficient_names]
    bounds = [(max(low, -1e6), min(high, 1e6)) for low, high in ranges]
    coefficients = tuple(draw(st.floats(*pair)) for pair in bounds)
    focal, centre = st.floats(1e-3, 1e6), finite(1e6)
    width, height = size or (draw(st.integers(1, 20000)), draw(st.integers(1, 20000)))
    values = (draw(focal), draw(focal), draw(centre), draw(centre))
    return Camera(*values, model.name, coefficients, width, height)


@st.composite
def rigs(draw: st.DrawFn, most: int = 3, size: tuple[int, int] | None = None) -> Rig:
    """Rigs of one to a few cameras, some with a rolling shutter."""
    mounted, known = [], draw(st.booleans())
    for _ in range(draw(st.integers(1, most))):
        one = RigCamera(
            draw(cameras(size)),
            draw(poses()),
            draw(finite(MAX_OFFSET_S)),
            draw(NAMES),
            rotation_known=known,
        )
        if draw(st.booleans()):
            readout, row = (
                draw(finite(MAX_READOUT_S)),
                draw(st.sampled_from(["first", "middle", "last"])),
            )
            one = replace(
                one,
                rolling_shutter=True,
                readout_s=readout,
                stamped_row=row if readout else "first",
            )
        mounted.append(one)
    density = st.floats(1e-12, 1e6)
    noise = ImuNoise(*(draw(density) for _ in range(5)))
    return Rig(tuple(mounted), noise)


def same_rig(found: Rig, written: Rig, of_kalibr: bool) -> None:
    """The numbers to the bit, mountings to the rounding of their inverses."""
    assert len(found.cameras) == len(written.cameras)
    assert found.imu == written.imu
    for k, (mine, its) in enumerate(zip(found.cameras, written.cameras, strict=True)):
        assert mine.camera == its.camera
        assert mine.time_offset_s == its.time_offset_s
        for name in ("rolling_shutter", "readout_s", "stamped_row"):
            assert getattr(mine, name) == getattr(its, name)
        assert mine.name == (its.name if of_kalibr else f"cam{k}")
        assert mine.rotation_known == its.rotation_known
        wanted = its.body_T_camera
        size = 1.0 + np.abs([wanted.matrix(), written.cameras[0].body_T_camera.matrix()]).max()
        if of_kalibr and not its.rotation_known:  # nothing but the mounting on the first one
            wanted = written.cameras[0].body_T_camera.between(wanted)
        found_pose = mine.body_T_camera.matrix()
        np.testing.assert_allclose(found_pose, wanted.matrix(), atol=1e-12 * size)


def frame_stamps(least: int = 10**9, end: int = 2**62 - 10**9) -> st.SearchStrategy[np.ndarray]:
    """Times of one to four frames, 50 ms to some seconds apart."""

    def spread(first: int, steps: list[int]) -> np.ndarray:
        return first + np.cumsum([0, *steps])

    steps = st.lists(st.integers(50 * 10**6, 10**9), max_size=3)
    return st.builds(spread, st.integers(least, end - 5 * 10**9), steps)


@st.composite
def samples(draw: st.DrawFn, frames: np.ndarray) -> ImuData:
    """Some samples from before the first frame to after the last, none of which looks wrong."""
    inside = st.integers(int(frames[0]) - 10**8, int(frames[-1]) + 10**8)
    times = np.array(sorted(draw(st.lists(inside, min_size=2, max_size=6, unique=True))), np.int64)
    gyro = np.array([draw(vectors(3, 1.0)) for _ in times])
    accel = np.array([draw(vectors(3, 10.0)) for _ in times])
    return ImuData(times, gyro, accel)


def same_samples(found: ImuData, written: ImuData) -> None:
    np.testing.assert_array_equal(found.stamps_ns, written.stamps_ns)
    np.testing.assert_array_equal(found.gyro, written.gyro)
    np.testing.assert_array_equal(found.accel, written.accel)
