# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Images of a recording: damaged ones are refused without noise, good ones come ahead of time."""

import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import FRAME_PERIOD_NS, START_NS, write_euroc

from slam_graph.datasets.formats.euroc import EurocSequence
from slam_graph.datasets.streams.images import prefetch
from slam_graph.image_files import find_damage
from slam_graph.sensors.measurements import CameraFrame


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_euroc(tmp_path / "flight")


def image(folder: Path, camera: int, frame: int) -> Path:
    stamp = START_NS + frame * FRAME_PERIOD_NS + camera * 300
    return folder / "mav0" / f"cam{camera}" / "data" / f"{stamp}.png"


def run_through(path: Path) -> tuple[EurocSequence, list[CameraFrame]]:
    sequence = EurocSequence(path)
    frames = []
    for packet in sequence.packets():
        assert isinstance(packet.frame, CameraFrame)
        frames.append(packet.frame)
    return sequence, frames


def test_images_come_as_they_were_written(folder: Path) -> None:
    sequence, frames = run_through(folder)
    assert sequence.info().name == "flight"
    for k, frame in enumerate(frames):
        assert frame.stamp_ns == START_NS + k * FRAME_PERIOD_NS
        for camera in range(2):
            stored = cv2.imread(str(image(folder, camera, k)), cv2.IMREAD_GRAYSCALE)
            assert np.array_equal(frame.images[camera], stored)


def test_both_folders_open(folder: Path) -> None:
    assert EurocSequence(folder).info() == EurocSequence(folder / "mav0").info()


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "text", "missing"])
def test_unreadable_image_is_none_and_counted(
    folder: Path, damage: str, capfd: pytest.CaptureFixture[str]
) -> None:
    file = image(folder, 1, 3)
    data = file.read_bytes()
    if damage == "missing":
        file.unlink()
    else:
        file.write_bytes(
            {
                "truncated": data[: len(data) // 2],
                "flipped": data[:900] + bytes([data[900] ^ 255]) + data[901:],
                "empty": b"",
                "text": b"not an image",
            }[damage]
        )
    sequence, frames = run_through(folder)
    assert [frame.images[1] is None for frame in frames] == [k == 3 for k in range(8)]
    assert all(frame.images[0] is not None for frame in frames)
    assert sequence.diagnostics.counts == {"image_unreadable": 1}
    assert capfd.readouterr().err == ""


def test_truncated_jpeg_is_damaged() -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (40, 40), dtype=np.uint8)
    data = cv2.imencode(".jpg", pixels)[1].tobytes()
    assert find_damage(data) is None
    assert find_damage(data[: len(data) // 2]) is not None


def test_image_of_wrong_size_is_none_and_counted(folder: Path) -> None:
    cv2.imwrite(str(image(folder, 0, 2)), np.zeros((20, 30), np.uint8))
    sequence, frames = run_through(folder)
    assert frames[2].images[0] is None
    assert frames[2].stamp_ns == START_NS + 2 * FRAME_PERIOD_NS
    assert sequence.diagnostics.counts == {"image_wrong_size": 1}


def test_without_images_nothing_is_decoded(folder: Path) -> None:
    image(folder, 0, 1).write_bytes(b"not an image")
    image(folder, 0, 2).unlink()
    sequence = EurocSequence(folder).without_images()
    frames = [packet.frame for packet in sequence.packets()]
    assert all(f.images == (None, None) for f in frames if isinstance(f, CameraFrame))
    assert sequence.diagnostics.counts == {"image_unreadable": 1}


def test_decoding_stops_with_the_reader(folder: Path) -> None:
    packets = EurocSequence(folder).packets()
    next(packets)
    assert decoding_threads() == 1
    packets.close()  # type: ignore[attr-defined]
    assert decoding_threads() == 0


def decoding_threads() -> int:
    return sum(thread.name.startswith("slam_graph-images") for thread in threading.enumerate())


def test_prefetch_keeps_the_order_and_its_bound() -> None:
    taken = []

    def jobs() -> Iterator[object]:
        for k in range(20):
            taken.append(k)
            yield lambda k=k: k * k

    results = prefetch(jobs(), ahead=3)  # type: ignore[arg-type]
    for k in range(20):
        assert next(results) == k * k
        assert len(taken) <= k + 4


@pytest.mark.data
def test_corrupt_image_of_mh01(data_dir: Path, capfd: pytest.CaptureFixture[str]) -> None:
    sequence = EurocSequence(data_dir / "euroc" / "MH_01_easy_17s")
    corrupt = 1403636592913555456
    reach = FRAME_PERIOD_NS + 1000
    near = list(sequence.packets(corrupt - reach, corrupt + reach))
    images = [p.frame.images for p in near if isinstance(p.frame, CameraFrame)]
    assert [right is None for _, right in images] == [False, True, False]
    assert all(left is not None for left, _ in images)
    assert sequence.diagnostics.counts == {"image_unreadable": 1}
    assert sequence.info().frames == 341
    assert "libpng" not in capfd.readouterr().err
