"""Run lengths against pycocotools, and against files that lie."""

from __future__ import annotations

import json
import unittest

import numpy as np

from segwild import CocoMasks, SegwildError, decode_rle

from .support import changed, temporary_folder

BLOCK = {
    "images": [
        {"id": 1, "file_name": "a.jpg", "width": 7, "height": 5},
        {"id": 2, "file_name": "b.jpg", "width": 4, "height": 3},
    ],
    "categories": [{"id": 1, "name": "statue"}, {"id": 2, "name": "object-2"}],
    "annotations": [{"image_id": 1, "category_id": 1, "segmentation": {"size": [5, 7], "counts": ";320009"}}],
}


class CocoTest(unittest.TestCase):
    def setUp(self) -> None:
        self.file = temporary_folder() / "coco.json"

    def open(self, value: object) -> CocoMasks:
        self.file.write_text(json.dumps(value))
        return CocoMasks(self.file)

    def test_run_lengths_are_those_of_pycocotools(self) -> None:
        from pycocotools import mask as reference

        random = np.random.default_rng(5)
        for _ in range(200):
            height, width = random.integers(1, 90, 2)
            mask = random.random((height, width)) < random.choice([0.0, 0.02, 0.5, 0.98, 1.0])
            runs = reference.encode(np.asfortranarray(mask, dtype=np.uint8))
            np.testing.assert_array_equal(decode_rle(runs["counts"], height, width), mask)
        large = np.zeros((900, 1300), bool)
        large[200:700, 300:1200] = True
        runs = reference.encode(np.asfortranarray(large, dtype=np.uint8))
        np.testing.assert_array_equal(decode_rle(runs["counts"].decode(), 900, 1300), large)

    def test_masks_are_found_by_name_and_number(self) -> None:
        masks = self.open(BLOCK)
        wanted = np.zeros((5, 7), bool)
        wanted[1:4, 2:5] = True
        for name in ("statue", 1):
            np.testing.assert_array_equal(masks.mask("a.jpg", name), wanted)
        np.testing.assert_array_equal(masks.mask("b.jpg", "object-2"), np.zeros((3, 4), bool))
        self.assertEqual((list(masks), len(masks), masks.photos), ([("a.jpg", 1)], 1, ("a.jpg", "b.jpg")))
        for photo, thing in (("c.jpg", 1), ("a.jpg", 3), ("a.jpg", "nobody")):
            with self.assertRaises(KeyError):
                masks.mask(photo, thing)

    def test_runs_that_do_not_fit_are_refused(self) -> None:
        for counts in (";32000", ";3200090", ";320008", "x!", "o" * 40, "\u20ac", ";3200\x7f"):
            with self.assertRaises(ValueError, msg=counts):
                decode_rle(counts, 5, 7)
        with self.assertRaises(ValueError):
            decode_rle("0", 1 << 20, 1 << 20)

    def test_a_file_that_does_not_fit_itself_is_refused(self) -> None:
        for change in ({"image_id": 9}, {"category_id": 9}, {"segmentation": {"size": [7, 5], "counts": ""}}, {"image_id": "1"}):
            with self.assertRaises(SegwildError, msg=change):
                self.open({**BLOCK, "annotations": [{**BLOCK["annotations"][0], **change}]})
        with self.assertRaisesRegex(SegwildError, "pixels"):
            self.open({**BLOCK, "images": [{"id": 1, "file_name": "a.jpg", "width": 1 << 20, "height": 1 << 20}]})
        wrong = {**BLOCK["annotations"][0], "segmentation": {"size": [5, 7], "counts": ";3"}}
        with self.assertRaisesRegex(SegwildError, "object 1 on a.jpg"):
            self.open({**BLOCK, "annotations": [wrong]}).mask("a.jpg", 1)

    def test_changed_bytes_are_read_or_refused_and_nothing_else(self) -> None:
        refused = 0
        for data in changed(json.dumps(BLOCK).encode(), 500, 3):
            self.file.write_bytes(data)
            try:
                masks = CocoMasks(self.file)
                for photo, number in masks:
                    masks.mask(photo, number)
            except SegwildError:
                refused += 1
        self.assertGreater(refused, 200)


if __name__ == "__main__":
    unittest.main()
