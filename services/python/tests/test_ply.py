"""The reader of splats against plyfile, and against files that lie."""

from __future__ import annotations

import struct
import unittest
from pathlib import Path

import numpy as np

from segwild import SegwildError, Splats, read_ply

from .support import changed, temporary_folder

NAMES = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(9))]
NAMES += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
COMMENTS = ("comment SplatRenderMode: mip", "comment offset 448262 5411933 35")


def written(count: int, comments: tuple[str, ...] = COMMENTS, named: int | None = None) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {count if named is None else named}"]
    lines += [f"property float {name}" for name in NAMES] + ["property uchar label", "end_header", ""]
    random = np.random.default_rng(3)
    body = b"".join(
        struct.pack(f"<{len(NAMES)}fB", *random.normal(size=len(NAMES)), k % 2) for k in range(count)
    )
    return "\n".join(lines).encode() + body


class PlyTest(unittest.TestCase):
    def setUp(self) -> None:
        self.file = temporary_folder() / "a.ply"

    def read(self, data: bytes) -> Splats:
        self.file.write_bytes(data)
        return read_ply(self.file)

    def refused(self, data: bytes, words: str) -> None:
        with self.assertRaisesRegex(SegwildError, words) as caught:
            self.read(data)
        self.assertEqual(Path(caught.exception.path), self.file)

    def test_the_arrays_are_those_that_plyfile_reads(self) -> None:
        from plyfile import PlyData

        splats = self.read(written(17))
        table = PlyData.read(str(self.file))["vertex"]
        for k, name in enumerate("xyz"):
            np.testing.assert_array_equal(splats.means[:, k], table[name])
        for k in range(3):
            np.testing.assert_array_equal(splats.log_scales[:, k], table[f"scale_{k}"])
            np.testing.assert_array_equal(splats.sh[:, 0, k], table[f"f_dc_{k}"])
            for band in range(3):
                np.testing.assert_array_equal(splats.sh[:, 1 + band, k], table[f"f_rest_{3 * k + band}"])
        for k in range(4):
            np.testing.assert_array_equal(splats.rotations[:, k], table[f"rot_{k}"])
        np.testing.assert_array_equal(splats.logits, table["opacity"])
        np.testing.assert_array_equal(splats.extra["label"], table["label"])
        self.assertEqual((len(splats), splats.degree, splats.render_mode), (17, 1, "mip"))
        np.testing.assert_array_equal(splats.offset, [448262.0, 5411933.0, 35.0])

    def test_what_is_derived_follows_from_its_definition(self) -> None:
        splats = self.read(written(5, ()))
        np.testing.assert_allclose(splats.scales, np.exp(splats.log_scales))
        np.testing.assert_allclose(splats.opacities, 1 / (1 + np.exp(-splats.logits.astype(float))), rtol=1e-6)
        np.testing.assert_array_equal(splats.offset, np.zeros(3))
        turned = splats.rotation_matrices
        np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-5)
        # A quarter turn about z takes x to y.
        quarter = Splats(
            splats.means[:1], splats.log_scales[:1], np.array([[1.0, 0.0, 0.0, 1.0]], np.float32), np.array([-200.0], np.float32),
            splats.sh[:1], {}, np.zeros(3), "",
        )  # fmt: skip
        np.testing.assert_allclose(quarter.rotation_matrices[0] @ [1, 0, 0], [0, 1, 0], atol=1e-6)
        self.assertEqual(quarter.opacities[0], 0.0)

    def test_a_count_that_the_file_does_not_hold_is_refused_before_memory_is_taken(self) -> None:
        for named in (18, 10**6, 10**11):
            self.refused(written(17, named=named), "cut short")
        self.refused(written(17, named=-4), "list of vertices")
        self.refused(written(17, named=10**15), "list of vertices")

    def test_what_is_no_file_of_splats_is_named(self) -> None:
        good = written(3)
        self.refused(b"", "no .ply")
        self.refused(good.replace(b"binary_little_endian", b"ascii"), "little-endian")
        self.refused(good.replace(b"property float opacity", b"property float opaque"), "opacity")
        self.refused(good.replace(b"property float f_rest_8", b"property float f_rest_7"), "one name")
        self.refused(good.replace(b"property float f_rest_8", b"property float f_more_8"), "whole degree")
        self.refused(good.replace(b"property float nx", b"property list uchar int nx"), "not read here")
        self.refused(good.replace(b"offset 448262", b"offset 1e999x"), "offset")
        self.refused(b"ply\n" + b"comment\n" * 10_000 + good, "header")

    def test_changed_bytes_are_read_or_refused_and_nothing_else(self) -> None:
        refused = 0
        for data in changed(written(12), 500, 2):
            try:
                self.read(data)
            except SegwildError:
                refused += 1
        self.assertGreater(refused, 100)


if __name__ == "__main__":
    unittest.main()
