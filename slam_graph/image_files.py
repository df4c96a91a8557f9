# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Image files are decoded only if they are whole, and can hold the pixels that they claim.

A decoder takes memory for what is claimed: a damaged JPEG of 400 bytes may claim 10⁹ pixels. So
width and height are read from the first bytes before.
"""

from __future__ import annotations

import re
import struct
import zlib
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["ImageFile"]

_PNG_BEGIN, _JPEG_BEGIN, _JPEG_END = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"\xff\xd9"

_FORMATS = "PNG, JPEG, BMP, TIFF, PGM, PPM, WebP"
"""Image files that are read."""

_MOST_PIXELS, _MOST_PER_BYTE = 2**26, 100
"""An image of more pixels than any camera has no more of them for each byte of its file than this.
Labels take few bytes."""

_PNM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+([0-9]{1,9})(?:\s|#[^\n]*\n)+([0-9]{1,9})")

_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of segments with the size."""
_JPEG_SCAN = 0xDA

_TIFF_SIZES = {256: 0, 257: 1, 322: 2, 323: 3}
"""Tags of width, height, and width and height of a tile."""
_MOST_TAGS = 1000

Size = tuple[int, int]


class ImageFile:
    """What is done with the bytes of an image file."""

    @staticmethod
    def decode(data: bytes, flags: int) -> NDArray[Any] | str:
        """The image in the bytes of a file, or what is wrong with them.

        Args:
            data: bytes of the file.
            flags: OpenCV's, of `cv2.imdecode`.
        """
        fault = find_damage(data) or _fault_of_size(data)
        if fault is not None:
            return fault
        try:
            image: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            return str(error.err)
        return "not an image that OpenCV can read" if image is None else image

    @staticmethod
    def fault_of_claim(size: Size, length: int) -> str | None:
        """What is wrong with a file that claims images of so many pixels for its bytes."""
        if size[0] * size[1] > max(_MOST_PIXELS, _MOST_PER_BYTE * length):
            return f"claims {size[0]}x{size[1]} pixels in {length} bytes"
        return None


def find_damage(data: bytes) -> str | None:
    """What is wrong with the bytes of an image file, as far as is known without decoding it."""
    if not data:
        return "empty file"
    if data.startswith(_PNG_BEGIN):
        return _find_png_damage(data)
    if data.startswith(_JPEG_BEGIN) and _JPEG_END not in data[-1024:]:
        return "truncated JPEG"
    return None


def _find_png_damage(data: bytes) -> str | None:
    """Compare the checksums of the chunks of a PNG file (0.1 ms for EuRoC's)."""
    view = memoryview(data)
    position = len(_PNG_BEGIN)
    while position + 12 <= len(data):
        end = position + 12 + int.from_bytes(view[position : position + 4], "big")
        if end > len(data):
            break
        if zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            return f"damaged PNG (checksum at byte {position})"
        if data[position + 4 : position + 8] == b"IEND":
            return None
        position = end
    return "truncated PNG"


def _fault_of_size(data: bytes) -> str | None:
    """Why an image file is not to be decoded, by its format and claimed size; None if it is."""
    try:
        size = _claimed_size(data)
    except struct.error:
        size = None
    if size is None:
        return f"not an image ({_FORMATS}), or damaged"
    return ImageFile.fault_of_claim(size, len(data))


def _claimed_size(data: bytes) -> Size | None:
    """Width and height; None if the file is of no known format, or ends before them.

    Raises:
        struct.error: if it ends before them, too.
    """
    if data.startswith(_PNG_BEGIN):
        return _pair(">II", data, 16) if data[12:16] == b"IHDR" else None
    if data.startswith(_JPEG_BEGIN):
        return _of_jpeg(data)
    if data.startswith(b"BM"):
        (header,) = struct.unpack_from("<I", data, 14)
        width, height = _pair("<HH" if header == 12 else "<ii", data, 18)
        return abs(width), abs(height)
    if data.startswith((b"II*\0", b"MM\0*")):
        return _of_tiff(data, "<" if data.startswith(b"I") else ">")
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return _of_webp(data)
    found = _PNM.match(data[:4096])
    return None if found is None else (int(found[1]), int(found[2]))


def _pair(form: str, data: bytes, offset: int) -> Size:
    """Two numbers from `offset` on."""
    first, second = struct.unpack_from(form, data, offset)
    return int(first), int(second)


def _of_jpeg(data: bytes) -> Size | None:
    """The size in the first segment that has one."""
    position = len(_JPEG_BEGIN)
    while position + 4 <= len(data):
        if data[position] != 0xFF:  # decoders skip what is no marker
            position = data.find(b"\xff", position)
            if position < 0:
                return None
            continue
        marker = data[position + 1]
        if marker in _JPEG_FRAMES:
            height, width = _pair(">HH", data, position + 5)
            return width, height
        if marker == _JPEG_SCAN:
            return None
        if marker == 0xFF:
            position += 1
        elif marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD9:  # without content
            position += 2
        else:
            (length,) = struct.unpack_from(">H", data, position + 2)
            position += 2 + max(length, 2)
    return None


def _of_tiff(data: bytes, order: str) -> Size | None:
    """The size of the first image, or of its tiles if these are larger."""
    (directory,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, directory)
    sizes = [0] * len(_TIFF_SIZES)
    for k in range(min(count, _MOST_TAGS)):
        at = directory + 2 + 12 * k
        tag, kind = struct.unpack_from(f"{order}HH", data, at)
        if tag in _TIFF_SIZES:
            (value,) = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", data, at + 8)
            sizes[_TIFF_SIZES[tag]] = max(sizes[_TIFF_SIZES[tag]], value)
    width, height, tile_width, tile_height = sizes
    if not width or not height:
        return None
    larger = tile_width * tile_height > width * height
    return (tile_width, tile_height) if larger else (width, height)


def _of_webp(data: bytes) -> Size | None:
    """The size in the first chunk."""
    chunk = data[12:16]
    if chunk == b"VP8X":
        three = [int.from_bytes(data[k : k + 3], "little") for k in (24, 27)]
        return three[0] + 1, three[1] + 1
    if chunk == b"VP8 ":
        width, height = _pair("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if chunk == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    return None
