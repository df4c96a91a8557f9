# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the readers of labels of objects: label images, boxes, classes, recorded labels.

As `test_parser_properties`: what is written is read again, and anything is judged.
"""

import re
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import (
    ANYTHING,
    LARGEST_STAMP_NS,
    dressed,
    edited,
    examples,
    finite,
    in_seconds,
    instead,
    parsed,
    rows_as_bytes,
    stamps,
    trajectories,
)
from sound import sound_dataset, sound_trajectory

from slam_graph.datasets import TrackRecorder
from slam_graph.datasets.streams.mask_images import (
    LARGEST_LABEL,
    MaskFolder,
    classes_text,
    read_classes,
    sampled,
)
from slam_graph.datasets.streams.object_truth import object_truth_lines, read_object_truth
from slam_graph.errors import DataError
from slam_graph.sensors import FeatureFrame
from slam_graph.simulation.simulator import simulate

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]

SIZE = (12, 9)
"""Width and height of the frames."""

LABELS = st.integers(1, LARGEST_LABEL)


def empty(folder: Path) -> Path:
    """A folder without files."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


# --- label images ---------------------------------------------------------------------------------


@examples(40)
@given(data=st.data(), wide=st.booleans(), seconds=st.booleans())
def test_label_images(folder: Path, data: st.DataObject, wide: bool, seconds: bool) -> None:
    """Of 8 or 16 bits, named by their times in ns or in s, and found at these."""
    masks = empty(folder / "masks")
    kind = np.uint16 if wide else np.uint8
    times = data.draw(stamps(1, 3, 0, 10**10)) * 10**8
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    drawn = {
        stamp: rng.integers(0, np.iinfo(kind).max, SIZE[::-1], kind, endpoint=True)
        for stamp in times.tolist()
    }
    for stamp, image in drawn.items():
        name = in_seconds(stamp) if seconds else str(stamp)
        assert cv2.imwrite(str(masks / f"{name}.png"), image)
    found = MaskFolder(masks)
    assert len(found) == len(drawn)
    for stamp, image in drawn.items():
        np.testing.assert_array_equal(found.image(stamp, SIZE), image)
        assert found.image(stamp + 2_000_000, SIZE) is None


@examples()
@given(
    stamp=st.integers(-LARGEST_STAMP_NS, LARGEST_STAMP_NS),
    name=st.from_regex(r"[0-9]{0,22}(\.[0-9]{0,11})?", fullmatch=True)
    | st.from_regex(r"[0-9eE.+_-]{1,24}", fullmatch=True),
    content=ANYTHING,
)
def test_any_name_and_content_of_a_label_image(
    folder: Path, stamp: int, name: str, content: bytes
) -> None:
    masks = empty(folder / "any")
    (masks / f"{name}.png").write_bytes(content)
    found = parsed(lambda: MaskFolder(masks).image(stamp, SIZE))
    assert found is None or found.shape == SIZE[::-1]


@examples()
@given(
    label=LABELS,
    pixels=st.lists(st.tuples(finite(1e17), finite(1e17)), max_size=6),
)
def test_labels_at_any_pixels(label: int, pixels: list[tuple[float, float]]) -> None:
    """Of pixels beyond the image those at its edge."""
    image = np.zeros(SIZE[::-1], np.uint16)
    image[:, 6:] = label
    columns = np.array(pixels).reshape(-1, 2)[:, 0]
    found = sampled(image, np.array(pixels).reshape(-1, 2))
    assert np.all(found[columns > 8.0] == label)
    assert np.all(found[columns < 4.0] == 0)


# --- boxes ----------------------------------------------------------------------------------------


@st.composite
def boxes(draw: st.DrawFn) -> tuple[int, int, list[float]]:
    """A time, a label and a box, some of which is beyond the image."""
    left, right = sorted([draw(st.floats(-20.0, 20.0)), draw(st.floats(-20.0, 20.0))])
    top, bottom = sorted([draw(st.floats(-20.0, 20.0)), draw(st.floats(-20.0, 20.0))])
    return draw(st.integers(1, 3)) * 10**8, draw(LABELS), [left, top, right, bottom]


@examples()
@given(data=st.data(), drawn=st.lists(boxes(), min_size=1, max_size=5))
def test_boxes(
    folder: Path, data: st.DataObject, drawn: list[tuple[int, int, list[float]]]
) -> None:
    """A pixel has the label of the last box that it is in."""
    masks = empty(folder / "boxes")
    text = "\n".join(f"{t},{label},{','.join(map(repr, box))}" for t, label, box in drawn)
    (masks / "boxes.csv").write_bytes(data.draw(dressed(text)))
    found = MaskFolder(masks)
    assert len(found) == len({stamp for stamp, _, _ in drawn})
    column, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    for stamp in {stamp for stamp, _, _ in drawn}:
        wanted = np.zeros(SIZE[::-1], np.uint16)
        for _, label, (left, top, right, bottom) in (one for one in drawn if one[0] == stamp):
            inside = (column >= left) & (column <= right) & (row >= top) & (row <= bottom)
            wanted[inside] = label
        np.testing.assert_array_equal(found.image(stamp, SIZE), wanted)


BOXES = (
    "#stamp,label,l,t,r,b\n100000000,3,2,1,3,9\n200000000,300,1.5,-10,3,9\n200000000,7,0,0,1,1\n"
)


@examples(100)
@given(
    data=st.data(), stamp=st.sampled_from([10**8, 2 * 10**8, 0]) | st.integers(-(2**63), 2**63 - 1)
)
def test_edited_boxes(folder: Path, data: st.DataObject, stamp: int) -> None:
    """Labels are those of the file; a frame at any other time has none."""
    masks = empty(folder / "edited")
    rows = rows_as_bytes(",", 6)
    (masks / "boxes.csv").write_bytes(data.draw(edited(BOXES) | rows))
    found = parsed(MaskFolder, masks)
    if found is None:
        return
    text = (masks / "boxes.csv").read_text(errors="replace")
    for at in (stamp, 10**8, 2 * 10**8, 1 - 2**62):
        image = found.image(at, SIZE)
        if image is not None:
            written = {int(cell) for cell in re.findall(r",\s*([0-9]+)", text)}
            assert set(np.unique(image).tolist()) <= {0, *written}
            near = [int(t) for t in re.findall(r"^\s*([+-]?[0-9]+)", text, re.MULTILINE)]
            assert min(abs(at - t) for t in near) <= 10**6


@pytest.mark.parametrize("stamp", [2**62, -(2**62), 2**63 - 1, -(2**63)])
def test_boxes_that_are_of_no_time_are_refused(tmp_path: Path, stamp: int) -> None:
    """The distance to the frame at 0 does not fit into 64 bits, and was negative: near enough."""
    (tmp_path / "boxes.csv").write_text(f"{stamp},1,0,0,5,5\n")
    with pytest.raises(DataError, match=r"boxes\.csv:1: .* is not a time in nanoseconds"):
        MaskFolder(tmp_path)


# --- classes --------------------------------------------------------------------------------------


CLASS_NAMES = st.text(
    st.characters(exclude_categories=["Cs", "Cc", "Zl", "Zp"]), min_size=1, max_size=20
).filter(lambda name: name == " ".join(name.split()))


@examples()
@given(
    data=st.data(), classes=st.dictionaries(st.integers(0, LARGEST_LABEL), CLASS_NAMES, max_size=4)
)
def test_classes(folder: Path, data: st.DataObject, classes: dict[int, str]) -> None:
    (text,) = classes_text(classes).values() if classes else ("",)
    (folder / "classes.csv").write_bytes(data.draw(dressed(text)))
    assert read_classes(folder) == classes


def test_a_class_of_no_label_is_refused(tmp_path: Path) -> None:
    (tmp_path / "classes.csv").write_text("65536,car\n")
    with pytest.raises(DataError, match=r"classes\.csv:1: expected a label"):
        read_classes(tmp_path)


@examples(100)
@given(content=ANYTHING | edited("7,car\n3,person on a bike\n# a,b\n\n300,bus\n"))
def test_edited_classes(folder: Path, content: bytes) -> None:
    (folder / "classes.csv").write_bytes(content)
    found = parsed(read_classes, folder)
    for label, name in (found or {}).items():
        assert 0 <= label <= LARGEST_LABEL
        assert name == " ".join(name.split()) != ""


# --- labels and moving features of recordings -----------------------------------------------------


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose features have labels, and some of which move."""
    root = tmp_path_factory.mktemp("labels") / "flight"
    settings = {"tracks": {"features": 5}, "objects": {"count": 1, "masks": True}}
    sequence = simulate(duration_s=0.6, rate_hz=5.0, cameras=1, **settings)
    with TrackRecorder(root, sequence.rig) as recorder:
        for packet in sequence.packets():
            assert isinstance(packet.frame, FeatureFrame)
            seen = packet.frame.cameras[0]
            labels = np.arange(len(seen)) * 5 % LARGEST_LABEL
            both = (replace(seen, labels=labels),)
            recorder.write(packet.imu, replace(packet.frame, cameras=both, moving=both))
    return root


@pytest.mark.parametrize("name", ["labels.bin", "moving.bin", "moving_frames.bin"])
@examples(40)
@given(data=st.data())
def test_labels_of_other_numbers(flight: Path, name: str, data: st.DataObject) -> None:
    """Files of the right length, with some words of four bytes that are any."""
    file = flight / name
    whole = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = 4 * data.draw(st.integers(0, len(whole) // 4 - 1))
        number = data.draw(st.integers(-3, 70_000) | st.integers(-(2**31), 2**31 - 1))
        whole[at : at + 4] = struct.pack("<i", number)
    with instead(file, bytes(whole)):
        parsed(sound_dataset, flight)


# --- true poses of objects ------------------------------------------------------------------------


@examples(80)
@given(data=st.data())
def test_edited_true_poses(folder: Path, data: st.DataObject) -> None:
    truth = {number: data.draw(trajectories(1e6, (7,))) for number in (1, 2)}
    path = folder / "objects_truth.csv"
    path.write_bytes(data.draw(edited("".join(object_truth_lines(truth)))))
    for found in (parsed(read_object_truth, path) or {}).values():
        sound_trajectory(found)


@pytest.mark.parametrize("place", ["1e300", "-1e154", "inf", "nan"])
def test_an_object_that_is_nowhere_is_refused(tmp_path: Path, place: str) -> None:
    path = tmp_path / "objects_truth.csv"
    path.write_text(f"1,1,{place},0,0,0,0,0,1\n")
    with pytest.raises(DataError, match="not finite or too far"):
        read_object_truth(path)
