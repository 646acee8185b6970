"""The reader of PNG against an encoder of its own with every filter."""

from __future__ import annotations

import random
import struct
import unittest
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from segwild import SegwildError, read_mask, read_png
from segwild.png import PIXEL_LIMIT

from .support import changed, temporary_folder


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def predicted(kind: int, a: int, b: int, c: int) -> int:
    """The five predictors of the specification: left, above, and the corner between them."""
    if kind == 4:
        p = a + b - c
        return min((a, b, c), key=lambda v: abs(p - v))
    return (0, a, b, (a + b) // 2)[kind]


def encoded(rows: list[bytes], size: tuple[int, int], depth: int, colour: int, filters: list[int], step: int) -> bytes:
    out, above = b"", bytes(len(rows[0]))
    for row, kind in zip(rows, filters, strict=True):
        line = bytearray([kind])
        for i, value in enumerate(row):
            a, c = (row[i - step], above[i - step]) if i >= step else (0, 0)
            line.append((value - predicted(kind, a, above[i], c)) & 255)
        out, above = out + bytes(line), row
    head = struct.pack(">IIBBBBB", *size, depth, colour, 0, 0, 0)
    packed = zlib.compress(out)
    half = len(packed) // 2
    data = chunk(b"IDAT", packed[:half]) + chunk(b"IDAT", packed[half:])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"tEXt", b"Comment\0made") + data + chunk(b"IEND", b"")


def grey(pixels: NDArray[np.uint8], filters: list[int]) -> bytes:
    height, width = pixels.shape
    return encoded([row.tobytes() for row in pixels], (width, height), 8, 0, filters, 1)


class PngTest(unittest.TestCase):
    def setUp(self) -> None:
        self.file = temporary_folder() / "a.png"
        self.random = np.random.default_rng(7)

    def read(self, data: bytes) -> NDArray[np.uint8]:
        self.file.write_bytes(data)
        return read_png(self.file)

    def refused(self, data: bytes, words: str) -> None:
        with self.assertRaisesRegex(SegwildError, words) as caught:
            self.read(data)
        self.assertEqual(Path(caught.exception.path), self.file)

    def test_every_filter_of_grey_and_colours_is_undone(self) -> None:
        for colour, samples in ((0, 1), (2, 3), (4, 2), (6, 4)):
            pixels = self.random.integers(0, 256, (11, 9, samples), dtype=np.uint8)
            # Two filters that predict from empty rows, too.
            pixels[3:6] = 0
            for kind in range(5):
                rows = [row.tobytes() for row in pixels]
                data = encoded(rows, (9, 11), 8, colour, [kind] * 11, samples)
                np.testing.assert_array_equal(self.read(data), pixels[..., 0] if samples == 1 else pixels)
            mixed = [random.Random(samples).randrange(5) for _ in rows]
            image = self.read(encoded(rows, (9, 11), 8, colour, mixed, samples)).reshape(pixels.shape)
            np.testing.assert_array_equal(image, pixels)

    def test_grey_of_fewer_bits_is_spread_over_the_whole_range(self) -> None:
        for depth in (1, 2, 4):
            values = self.random.integers(0, 1 << depth, (5, 13), dtype=np.uint8)
            bits = (values[:, :, None] >> np.arange(depth - 1, -1, -1)) & 1
            rows = [np.packbits(row).tobytes() for row in bits.reshape(5, -1).astype(np.uint8)]
            image = self.read(encoded(rows, (13, 5), depth, 0, [0, 1, 2, 3, 4], 1))
            np.testing.assert_array_equal(image, values * (255 // ((1 << depth) - 1)))

    def test_a_mask_is_white_and_has_no_colours(self) -> None:
        pixels = np.array([[0, 255, 127], [128, 0, 255]], np.uint8)
        self.file.write_bytes(grey(pixels, [0, 0]))
        np.testing.assert_array_equal(read_mask(self.file), [[False, True, False], [True, False, True]])
        self.file.write_bytes(encoded([bytes(9)], (3, 1), 8, 2, [0], 3))
        with self.assertRaisesRegex(SegwildError, "no mask"):
            read_mask(self.file)

    def test_a_header_does_not_take_memory_that_the_file_does_not_fill(self) -> None:
        def with_size(width: int, height: int, pixels: bytes) -> bytes:
            head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
            return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")

        self.refused(with_size(1 << 31, 1 << 31, b""), str(PIXEL_LIMIT))
        self.refused(with_size(14_000, 14_000, b"few"), "do not fit")
        # A stream that inflates to more than the size.
        self.refused(with_size(4, 4, bytes(100 << 20)), "do not fit")
        self.refused(with_size(0, 4, b""), "damaged")

    def test_what_is_not_read_is_named(self) -> None:
        self.refused(b"GIF89a", "no PNG")
        self.refused(encoded([bytes(2)], (1, 1), 16, 0, [0], 2), "16 bits")
        good = grey(np.zeros((2, 2), np.uint8), [0, 0])
        self.refused(good.replace(b"IEND", b"iEND"), "check sum")
        self.refused(good[:-12], "cut short")
        self.refused(grey(np.zeros((2, 2), np.uint8), [0, 0])[:20], "cut short")

    def test_changed_bytes_are_read_or_refused_and_nothing_else(self) -> None:
        good = grey(self.random.integers(0, 256, (20, 20), dtype=np.uint8), [0, 1, 2, 3, 4] * 4)
        refused = 0
        for data in changed(good, 500, 1):
            try:
                self.read(data)
            except SegwildError:
                refused += 1
        self.assertGreater(refused, 400)


if __name__ == "__main__":
    unittest.main()
