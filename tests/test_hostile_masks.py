# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Masks of cameras that claim much, are damaged, or cannot be read: an error, in little memory."""

import struct
import zlib
from pathlib import Path

import pytest
from damage import MOST_MB, memory_mb

from slam_graph import simulate
from slam_graph.errors import ConfigError
from slam_graph.frontend.extraction import camera_mask

SIDE = 30_000


def png(*chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG of chunks with right lengths and checksums."""
    parts = [b"\x89PNG\r\n\x1a\n"]
    for name, content in chunks:
        checksum = zlib.crc32(name + content)
        parts += [struct.pack(">I", len(content)), name, content, struct.pack(">I", checksum)]
    return b"".join(parts)


CLAIMING = {
    "png": png(
        (b"IHDR", struct.pack(">IIBBBBB", SIDE, SIDE, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(SIDE))),
        (b"IEND", b""),
    ),
    "bmp": b"BM" + bytes(12) + struct.pack("<Iiihh", 40, SIDE, SIDE, 1, 8) + bytes(24),
    "pgm": f"P5 {SIDE} {SIDE} 255 ".encode(),
}


@pytest.mark.parametrize("form", CLAIMING)
def test_what_a_mask_cannot_hold_is_not_decoded(tmp_path: Path, form: str) -> None:
    mask = tmp_path / "mask"
    mask.write_bytes(CLAIMING[form])
    refused_in_little_memory(mask, f"claims {SIDE}x{SIDE} pixels")


@pytest.mark.parametrize("chunk", [b"IDAT", b"IHDR"])
def test_a_mask_that_claims_a_long_part_is_not_decoded(tmp_path: Path, chunk: bytes) -> None:
    """OpenCV takes memory for it before it reads it: 700 MB for 16 bytes."""
    mask = tmp_path / "mask"
    mask.write_bytes(b"\x89PNG\r\n\x1a\n" + (757_000_000).to_bytes(4, "big") + chunk)
    refused_in_little_memory(mask, "truncated PNG")


def test_a_mask_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    refused_in_little_memory(tmp_path / "mask", "No such file")
    refused_in_little_memory(tmp_path, "Is a directory")


def refused_in_little_memory(mask: Path, why: str) -> None:
    memory_mb(reset=True)
    before_mb = memory_mb()
    with pytest.raises(ConfigError, match=f"the mask of a camera cannot be read.*{why}"):
        camera_mask(simulate(duration_s=1.0).rig.cameras[0].camera, mask, 21)
    assert memory_mb() < before_mb + MOST_MB
