"""Run folders that another person made: nothing outside is read, nothing is trusted, and what is wrong is named."""

from __future__ import annotations

import json
import os
import unittest
from pathlib import Path
from typing import Any

import numpy as np

from segwild import Click, ObjectFolder, Run, SegwildError

from .support import temporary_folder
from .test_ply import written
from .test_png import grey

CAMERA = {
    "photo": "a/b.jpg", "image": "a/b.png", "width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 2.0, "cy": 1.5,
    "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 2], "distorted": False,
}  # fmt: skip

#: Kind of the records of feature fields with numbers of 32 bits, as earlier versions wrote them.
WIDE = b"features"


def features(count: int, channels: int, values: int, kind: bytes = b"features/2", unit: float = 1.0) -> bytes:
    before = b"" if kind == WIDE else np.array([unit], "<f4").tobytes()
    numbers = np.arange(values, dtype="<f4" if kind == WIDE else "<f2")
    payload = channels.to_bytes(8, "little") + before + count.to_bytes(8, "little") + numbers.tobytes()
    head = b"\x89SGW\r\n\x1a\n" + (1).to_bytes(2, "little") + bytes([len(kind)]) + kind
    return head + len(payload).to_bytes(8, "little") + bytes(32) + payload


class FolderTest(unittest.TestCase):
    def setUp(self) -> None:
        self.folder = temporary_folder() / "run"
        skipped = [{"name": "c", "reason": "odd"}]
        self.write("scene.json", {"photos": ["a/b.jpg"], "held_out": ["a/b.jpg"], "skipped": skipped})
        self.write("cameras.json", {"offset": [1, 2, 3], "photos": [CAMERA]})
        self.write("scene.ply", written(4))
        points = [{"x": 1, "y": 2, "inside": True}]
        self.write("selections/it/prompts.json", {"prompts": [{"photo": "a/b.jpg", "points": points}]})
        self.write("selections/it/labels.ply", written(4))
        self.mask = grey(np.eye(3, 4, dtype=np.uint8) * 255, [0, 2, 4])
        self.write("selections/it/masks/a/b.png", self.mask)

    def write(self, name: str, value: Any) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(value if isinstance(value, bytes) else json.dumps(value).encode())
        return path

    def refused(self, words: str) -> Any:
        return self.assertRaisesRegex(SegwildError, words)

    def test_a_small_run_is_read(self) -> None:
        run = Run(self.folder)
        photo = run.photo("a/b.jpg")
        self.assertEqual((photo.size, photo.held_out, run.selections, run.skipped), ((4, 3), True, ("it",), {"c": "odd"}))
        np.testing.assert_array_equal(run.offset, [1, 2, 3])
        np.testing.assert_array_equal(photo.camera.centre, [0, 0, -2])
        selection = run.selection("it")
        np.testing.assert_array_equal(selection.mask("a/b.jpg"), np.eye(3, 4, dtype=bool))
        np.testing.assert_array_equal(selection.labels(), [False, True, False, True])
        prompts = selection.prompts[0]
        self.assertEqual((prompts.photo, prompts.clicks, prompts.boxes), ("a/b.jpg", (Click(1.0, 2.0, True),), ()))
        self.assertEqual((run.objects, run.evaluation, dict(selection.masks("amodal"))), ((), None, {}))
        for find in (run.photo, run.selection, selection.mask, run.transient_mask, run.held_out_render):
            with self.assertRaises(KeyError):
                find("x")
        with self.refused("no such file.*makes the selection again"):
            selection.splats()
        with self.refused("no such file.*writes the rest"):
            run.features()
        with self.refused("not scored"):
            run.held_out_render("a/b.jpg")

    def test_what_is_no_run_says_what_to_do(self) -> None:
        for folder in (self.folder / "selections", self.folder / "nobody", self.folder / "scene.json"):
            with self.refused("scene.json.*segwild run SCENE"):
                Run(folder)
        (self.folder / "cameras.json").unlink()
        with self.refused("cameras.json.*earlier version.*segwild run"):
            Run(self.folder).photos

    def test_names_and_links_that_lead_out_are_not_followed(self) -> None:
        outside = self.folder.parent / "outside.png"
        outside.write_bytes(self.mask)
        names = ["../../../../outside.png", "/etc/passwd", str(outside), "a/../../x.png", "a//b.png"]
        for image in [*names, "", "C:x.png", "a\\b.png", "x\0"]:
            self.write("cameras.json", {"offset": [0, 0, 0], "photos": [{**CAMERA, "image": image}]})
            with self.refused("outside of it"):
                Run(self.folder).selection("it").mask("a/b.jpg")
        self.write("cameras.json", {"offset": [0, 0, 0], "photos": [CAMERA]})
        mask = self.folder / "selections/it/masks/a/b.png"
        mask.unlink()
        mask.symlink_to(outside)
        with self.refused("leads out"):
            Run(self.folder).selection("it").mask("a/b.jpg")
        # A link within the run is followed.
        mask.unlink()
        self.write("c.png", self.mask)
        mask.symlink_to(self.folder / "c.png")
        self.assertEqual(Run(self.folder).selection("it").mask("a/b.jpg").sum(), 3)
        # So is a folder of selections that lies elsewhere not.
        os.rename(self.folder / "selections", self.folder.parent / "selections")
        (self.folder / "selections").symlink_to(self.folder.parent / "selections")
        with self.refused("leads out"):
            Run(self.folder).selections

    @unittest.skipUnless(hasattr(os, "mkfifo"), "this system has no pipes")
    def test_a_pipe_instead_of_a_file_does_not_block(self) -> None:
        (self.folder / "scene.ply").unlink()
        os.mkfifo(self.folder / "scene.ply")
        with self.refused("no plain file"):
            Run(self.folder).splats()

    def test_values_of_another_type_or_size_are_refused(self) -> None:
        changes: list[dict[str, Any]] = [
            {"width": 0}, {"width": "4"}, {"width": True}, {"height": 1 << 40}, {"fx": 0}, {"fx": None}, {"fx": 10**400},
            {"rotation": [[1, 0, 0]]}, {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, {"translation": [0, 0]},
            {"translation": [0, 0, "x"]}, {"photo": 7}, {"distorted": 1},
        ]  # fmt: skip
        for change in changes:
            self.write("cameras.json", {"offset": [0, 0, 0], "photos": [{**CAMERA, **change}]})
            with self.subTest(change), self.refused("cameras.json"):
                Run(self.folder).photos
        for text in (b"", b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b'{"offset": NaN}', b'{"offset": [1, 2]}'):
            self.write("cameras.json", text)
            with self.subTest(text[:9]), self.refused("cameras.json"):
                Run(self.folder).offset
        self.write("scene.json", {"held_out": [1]})
        with self.refused("held_out"):
            Run(self.folder)

    def test_labels_of_another_training_are_refused(self) -> None:
        self.write("selections/it/labels.ply", written(5))
        with self.refused("trained again.*--prompts"):
            Run(self.folder).selection("it").labels()
        self.write("selections/it/labels.ply", written(4).replace(b"uchar label", b"uchar other"))
        with self.refused("no property `label`"):
            Run(self.folder).selection("it").labels()

    def test_features_are_read_from_a_whole_record_of_their_kind_alone(self) -> None:
        for kind, unit in ((b"features/2", 1.0), (b"features/2", 0.25), (WIDE, 1.0)):
            self.write("features.bin", features(8, 2, 8, kind, unit))
            values = Run(self.folder).features().values
            self.assertEqual(values.dtype, np.float32)
            np.testing.assert_array_equal(values, unit * np.arange(8).reshape(4, 2))
        # What follows the vectors belongs to the record, too.
        self.write("features.bin", features(8, 2, 20))
        np.testing.assert_array_equal(Run(self.folder).features().values, np.arange(8).reshape(4, 2))
        good = features(8, 2, 8)
        for data, words in (
            (features(6, 2, 6), "3 splats"),
            (features(8, 0, 8), "damaged"),
            (features(7, 2, 8), "damaged"),
            (features(1 << 62, 2, 8), "damaged"),
            (features(8, 2, 7), "damaged"),
            (features(8, 2, 7, WIDE), "damaged"),
            (features(8, 2, 8, unit=0.0), "no unit"),
            (features(8, 2, 8, unit=-1.0), "no unit"),
            (features(8, 2, 8, unit=3.0), "no unit"),
            (features(8, 2, 8, unit=float("nan")), "no unit"),
            (features(8, 2, 8, unit=2.0**127), "unit are not finite"),
            (good[:-16] + np.full(8, np.inf, "<f2").tobytes(), "not finite"),
            (features(8, 2, 8, b"features/3"), "`features/3` and not `features/2`"),
            (features(8, 2, 8, b"model"), "`model` and not `features/2`"),
            (good[:-1], "cut short"),
            (good + b"x", "too long"),
            (good[:30], "cut short"),
            (good[:8] + b"\2\0" + good[10:], "format 2"),
            (b"", "no record"),
        ):
            self.write("features.bin", data)
            with self.subTest(words), self.refused(words):
                Run(self.folder).features()

    def test_similar_features_have_a_cosine_of_one_and_none_has_zero(self) -> None:
        before, after = np.arange(8, dtype="<f2"), np.array([1, 0, 2, 0, 0, 3, 0, 0], "<f2")
        self.write("features.bin", features(8, 2, 8).replace(before.tobytes(), after.tobytes()))
        np.testing.assert_allclose(Run(self.folder).features().similarity(0), [1, 1, 0, 0])

    def test_a_history_that_a_kill_cut_short_is_read_up_to_there(self) -> None:
        line = {"step": 10, "loss": 0.5, "psnr": 20.0, "splats": 4, "left_out": 0.1}
        text = json.dumps(line) + "\n[1]\n" + json.dumps({**line, "step": 20, "loss": None}) + "\n" + json.dumps(line)[:20]
        self.write("history.jsonl", text.encode())
        history = Run(self.folder).history
        np.testing.assert_array_equal(history["step"], [10])
        np.testing.assert_array_equal(history["psnr"], [20])

    def test_an_error_shows_no_sign_that_a_terminal_obeys(self) -> None:
        self.write("cameras.json", {"offset": [0, 0, 0], "photos": [{**CAMERA, "image": "../\x1b[2J\u202e\nx"}]})
        with self.assertRaises(SegwildError) as caught:
            Run(self.folder).selection("it").mask("a/b.jpg")
        self.assertTrue(str(caught.exception).isprintable())

    def test_a_folder_of_objects_that_is_none_is_refused(self) -> None:
        with self.refused("objects.json.*segwild objects"):
            ObjectFolder(self.folder)
        self.write("objects.json", {"objects": [{"number": 1}]})
        with self.refused("`pixel` is missing"):
            ObjectFolder(self.folder)


if __name__ == "__main__":
    unittest.main()
