# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the readers of images: files of images, TUM RGB-D, folders and videos.

As `test_parser_properties`: what is written is read again, and anything is judged.
"""

import shutil
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from damage import MOST_MB, memory_mb
from hypothesis import given
from hypothesis import strategies as st
from properties import (
    ANYTHING,
    LARGEST_STAMP_NS,
    dressed,
    edited,
    examples,
    in_seconds,
    instead,
    parsed,
    rows_as_bytes,
    stamps,
)
from recordings import SIZE
from recordings_loose import CHAIN, write_flight_video, write_image_folder
from recordings_public import write_tum_rgbd
from sound import sound_dataset, sound_recording, sound_stamps

from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.formats.image_folder import read_stamps, stamps_from_names
from slam_graph.datasets.streams.images import Fault, decode_grey
from slam_graph.sensors import CameraFrame

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]


# --- files of images ------------------------------------------------------------------------------


@st.composite
def pictures(draw: st.DrawFn, most: int = 40, kind: type = np.uint8) -> np.ndarray:
    """Grey images of any size up to some, all of one shade or of noise."""
    shape = draw(st.integers(1, most)), draw(st.integers(1, most))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shades = rng.integers(0, np.iinfo(kind).max, shape, kind, endpoint=True)
    return shades if draw(st.booleans()) else np.full(shape, shades[0, 0])


EXACT = (".png", ".bmp", ".tiff", ".pgm", ".webp")
KINDS = (*EXACT, ".jpg", ".ppm")


def packed(image: np.ndarray, suffix: str) -> bytes:
    if suffix == ".ppm":
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []
    done, data = cv2.imencode(suffix, image, options)
    assert done
    return data.tobytes()


@examples()
@given(image=pictures(), suffix=st.sampled_from(KINDS))
def test_images(image: np.ndarray, suffix: str) -> None:
    """To the bit where the format has no loss."""
    found = decode_grey(packed(image, suffix), "here")
    assert isinstance(found, np.ndarray), found
    assert found.shape == image.shape
    if suffix in EXACT:
        np.testing.assert_array_equal(found, image)


@examples(150)
@given(data=st.data())
def test_damaged_images(data: st.DataObject) -> None:
    """Some bytes of an image are others, or are missing: an image of bounded size, or a fault."""
    whole = bytearray(packed(data.draw(pictures()), data.draw(st.sampled_from(KINDS))))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(whole) - 1) | st.integers(0, min(40, len(whole) - 1)))
        content = data.draw(st.binary(min_size=1, max_size=4))
        whole[at : at + len(content)] = content
    cut = data.draw(st.integers(0, len(whole)) | st.just(len(whole)))
    check_image(bytes(whole[:cut]))


STARTS = [packed(np.zeros((3, 4), np.uint8), suffix) for suffix in KINDS]


@examples(100)
@given(start=st.sampled_from(STARTS), kept=st.integers(0, 60), content=ANYTHING)
def test_anything_as_an_image(start: bytes, kept: int, content: bytes) -> None:
    check_image(start[:kept] + content)


def check_image(data: bytes) -> None:
    found = decode_grey(data, "here")
    if isinstance(found, Fault):
        assert "\n" not in found.message
        assert len(found.message) < 300
    else:
        assert found.ndim == 2
        assert found.dtype == np.uint8
        assert found.size <= max(2**24, 100 * len(data))


def png(width: int, height: int, rows: bytes) -> bytes:
    """A PNG of one channel, valid but for what its rows may lack."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + check

    header = struct.pack(">II", width, height) + b"\x08\0\0\0\0"
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def jpeg(width: int, height: int) -> bytes:
    """A small JPEG that claims another size."""
    data = bytearray(packed(np.zeros((8, 8), np.uint8), ".jpg"))
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.fixture(scope="module")
def huge() -> dict[str, bytes]:
    """Small files of many pixels. The PNG is valid: seconds to make, and only where it is used."""
    return {
        "jpeg": jpeg(30_000, 30_000),
        "png": png(20_000, 20_000, bytes(20_001 * 20_000)),
        "bmp": b"BM" + bytes(12) + struct.pack("<IiiHH", 40, 30_000, -30_000, 1, 8) + bytes(24),
        "pgm": b"P5 30000 30000 255\n" + bytes(100),
        "tiff": b"II*\0" + struct.pack("<IHHHIIHHII", 8, 2, 256, 4, 1, 30_000, 257, 4, 1, 30_000),
        "webp": b"RIFF\x40\0\0\0WEBPVP8L\x20\0\0\0\x2f" + struct.pack("<I", 16382 | 16382 << 14),
    }


@pytest.mark.parametrize("kind", ["jpeg", "png", "bmp", "pgm", "tiff", "webp"])
def test_an_image_that_claims_too_many_pixels_is_not_decoded(
    huge: dict[str, bytes], kind: str
) -> None:
    """A JPEG of 300 bytes took 1.7 GB."""
    memory_mb(reset=True)
    before_mb = memory_mb()
    found = decode_grey(huge[kind], "here")
    assert isinstance(found, Fault)
    assert "pixels in" in found.message
    assert memory_mb() < before_mb + MOST_MB


# --- times of images ------------------------------------------------------------------------------

APART_NS = 10**6
"""Frames closer in time are taken for stamps of another unit."""


@st.composite
def times(draw: st.DrawFn, fewest: int = 1) -> np.ndarray:
    """Times of frames, at least a millisecond apart."""
    end = LARGEST_STAMP_NS // APART_NS
    return draw(stamps(fewest, 5, 1, end)) * APART_NS - draw(st.integers(0, APART_NS - 1))


@examples()
@given(data=st.data())
def test_tables_of_times(folder: Path, data: st.DataObject) -> None:
    """Nanoseconds, or seconds with a decimal point; with names of files, or without."""
    written, seconds = data.draw(times()), data.draw(st.booleans())
    if seconds:
        written = np.minimum(written, LARGEST_STAMP_NS // 10**9 * 10**9 - 1)
        written = np.unique(written)
    texts = [in_seconds(t) if seconds else str(t) for t in written.tolist()]
    name = data.draw(st.sampled_from(["", ",a.png", " a.png", ", a.png", ",b,c"]))
    path = folder / "timestamps.csv"
    path.write_bytes(data.draw(dressed("\n".join(text + name for text in texts))))
    found, names = read_stamps(path)
    np.testing.assert_array_equal(found, written)
    assert set(names) == {name.strip(", ").partition(",")[0]}


@examples()
@given(data=st.data())
def test_times_in_names(data: st.DataObject) -> None:
    written, seconds = data.draw(times()), data.draw(st.booleans())
    if seconds:
        written = np.unique(np.minimum(written, LARGEST_STAMP_NS // 10**9 * 10**9 - 1))
    texts = [in_seconds(t) if seconds else str(t) for t in written.tolist()]
    found = stamps_from_names([Path(f"{text}.png") for text in texts])
    assert found is not None
    np.testing.assert_array_equal(found, written)


NAMES = st.text(
    st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="/\\"),
    min_size=1,
    max_size=30,
)


@examples()
@given(names=st.lists(NAMES | st.from_regex(r"[0-9._+-]{1,25}", fullmatch=True), max_size=5))
def test_names_of_any_kind(names: list[str]) -> None:
    found = stamps_from_names([Path(f"{name}.png") for name in names])
    if found is not None:
        sound_stamps(np.unique(found))


# --- recordings -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_image_folder(tmp_path_factory.mktemp("images") / "flight", count=3)


def shorten(path: Path, lines: int) -> None:
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:lines]))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    shades = [np.full(SIZE[::-1], shade, np.uint8) for shade in (40, 90, 160)]
    path = write_flight_video(tmp_path_factory.mktemp("video"), shades)
    shorten(path.with_suffix(".imu.csv"), 40)
    return path


@pytest.fixture(scope="module")
def rgbd(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A sequence of small images, and its calibration."""
    root = tmp_path_factory.mktemp("rgbd")
    chain = root / "chain.yaml"
    chain.write_text(CHAIN)
    return write_tum_rgbd(root / "flight", frames=3, size=SIZE), chain


@examples(25)
@given(data=st.data())
def test_folders_of_images(images: Path, data: st.DataObject) -> None:
    """The times of a table belong to the images in the order of their numbers."""
    written = data.draw(stamps(3, 3, 1, 4 * 10**12)) * APART_NS
    table = images / "timestamps.csv"
    with instead(table, data.draw(dressed("\n".join(map(str, written.tolist()))))):
        sequence = open_dataset(images)
        assert isinstance(sequence, RecordedSequence)
        frames = list(sequence.frames())
    assert [frame.stamp_ns for frame in frames] == written.tolist()
    files = sorted((images / "images").iterdir())
    for frame, file in zip(frames, files, strict=True):
        assert isinstance(frame, CameraFrame)
        np.testing.assert_array_equal(frame.images[0], cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))


@pytest.mark.parametrize("name", ["timestamps.csv", "imu.csv", "calibration.yaml"])
@examples(40)
@given(data=st.data())
def test_edited_files_of_a_folder(images: Path, name: str, data: st.DataObject) -> None:
    file = images / name
    rows = rows_as_bytes(",", 2)
    with instead(file, data.draw(edited(file.read_text(), " ,:[]") | rows)):
        parsed(sound_dataset, images)


@pytest.mark.parametrize("suffix", [".csv", ".imu.csv", ".yaml"])
@examples(25)
@given(data=st.data())
def test_edited_files_beside_a_video(video: Path, suffix: str, data: st.DataObject) -> None:
    file = video.with_suffix(suffix)
    with instead(file, data.draw(edited(file.read_text(), " ,:[]") | ANYTHING)):
        parsed(sound_dataset, video)


@examples(25)
@given(data=st.data())
def test_anything_as_a_video(video: Path, data: st.DataObject) -> None:
    whole = video.read_bytes()
    kept = data.draw(st.integers(0, len(whole)))
    with instead(video, whole[:kept] + data.draw(ANYTHING)):
        parsed(sound_dataset, video)


@examples(25)
@given(data=st.data())
def test_rgbd(rgbd: tuple[Path, Path], data: st.DataObject) -> None:
    """The images of a list with their times, and depth at the same ones."""
    folder, chain = rgbd
    end = LARGEST_STAMP_NS // 10**9 * 10**9
    written = data.draw(stamps(3, 3, 0, end // 10**8)) * 10**8
    for kind in ("rgb", "depth"):
        files = sorted(f"{kind}/{file.name}" for file in (folder / kind).iterdir())
        lines = map(" ".join, zip(map(in_seconds, written.tolist()), files, strict=True))
        (folder / f"{kind}.txt").write_bytes(data.draw(dressed("\n".join(lines))))
    sequence = open_dataset(folder, calibration=chain)
    assert isinstance(sequence, RecordedSequence)
    sound_recording(sequence)
    frames = [frame for frame in sequence.frames() if isinstance(frame, CameraFrame)]
    assert [frame.stamp_ns for frame in frames] == written.tolist()
    assert [frame.depth_ns for frame in frames] == written.tolist()
    assert all(image is not None for frame in frames for image in frame.images)


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt"])
@examples(40)
@given(data=st.data())
def test_edited_lists(rgbd: tuple[Path, Path], name: str, data: st.DataObject) -> None:
    folder, chain = rgbd
    file = folder / name
    rows = rows_as_bytes(" ", 2)
    with instead(file, data.draw(edited(file.read_text(), " /") | rows)):
        parsed(lambda: sound_dataset(folder, calibration=chain))


def test_a_list_names_files_of_the_recording_only(rgbd: tuple[Path, Path], tmp_path: Path) -> None:
    """Also where a folder in it is named twice, or through itself."""
    folder, chain = rgbd
    shutil.copy(next((folder / "rgb").iterdir()), tmp_path / "secret.png")
    for name in ("../secret.png", "rgb/../../secret.png", str(tmp_path / "secret.png")):
        with instead(folder / "rgb.txt", f"1.0 {name}\n".encode()):
            assert parsed(lambda: open_dataset(folder, calibration=chain)) is None
