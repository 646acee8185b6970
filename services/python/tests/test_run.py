"""A real run: what is read equals what the program prints, and what plyfile, pycocotools and COLMAP's own files hold."""

from __future__ import annotations

import json
import math
import os
import shutil
import struct
import subprocess
import sys
import unittest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import segwild
from segwild import ObjectFolder, Run, SegwildError, boundary_iou, iou, read_mask, read_ply, read_png

from .support import NEEDS_PROGRAM, PROGRAM, changed, exported, scene_and_run, selected, temporary_folder
from .support import segwild as program


def colmap_images(path: Path) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Rotations and translations of COLMAP's `images.bin`, world to camera, by the names of the photos."""
    data, found, at = path.read_bytes(), {}, 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        w, x, y, z, *translation = struct.unpack_from("<7d", data, at + 4)
        end = data.index(b"\0", at + 64)
        u = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        found[data[at + 64 : end].decode()] = (np.eye(3) + 2 * (w * u + u @ u), np.array(translation))
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    return found


@unittest.skipUnless(PROGRAM, NEEDS_PROGRAM)
class RunTest(unittest.TestCase):
    def setUp(self) -> None:
        self.scene, folder = scene_and_run()
        self.run_folder = Run(folder)

    def test_poses_are_those_of_the_scene_and_photos_those_of_the_run(self) -> None:
        run = self.run_folder
        scene_json = json.loads((run.path / "scene.json").read_text())
        self.assertEqual([photo.name for photo in run.photos], scene_json["photos"])
        self.assertEqual([photo.name for photo in run.photos if photo.held_out], scene_json["held_out"])
        poses = colmap_images(self.scene / "sparse/0/images.bin")
        self.assertEqual(set(poses), set(scene_json["photos"]))
        for photo in run.photos:
            rotation, translation = poses[photo.name]
            np.testing.assert_allclose(photo.camera.rotation, rotation, atol=1e-5)
            np.testing.assert_allclose(photo.camera.translation, translation, atol=1e-4)
            self.assertEqual(read_png(self.scene / "images" / photo.name).shape[1::-1], photo.size)

    def test_splats_are_those_that_plyfile_reads(self) -> None:
        from plyfile import PlyData

        splats = self.run_folder.splats()
        table = PlyData.read(str(self.run_folder.path / "scene.ply"))["vertex"]
        self.assertEqual(len(splats), table.count)
        np.testing.assert_array_equal(splats.means, np.stack([table[name] for name in "xyz"], axis=1))
        np.testing.assert_array_equal(splats.logits, table["opacity"])
        bands = splats.sh.shape[1] - 1
        for colour in range(3):
            np.testing.assert_array_equal(splats.sh[:, 0, colour], table[f"f_dc_{colour}"])
            for band in range(bands):
                np.testing.assert_array_equal(splats.sh[:, 1 + band, colour], table[f"f_rest_{colour * bands + band}"])
        self.assertIn(splats.render_mode, ("mip", "default"))

    def test_a_selection_has_the_splats_and_photos_that_the_program_printed(self) -> None:
        _, printed = selected()
        selection = self.run_folder.selection("it")
        self.assertEqual(len(selection.splats()), printed["splats"])
        self.assertEqual(int(selection.labels().sum()), printed["splats"])
        self.assertEqual(sum(bool(mask.any()) for _, mask in selection.masks()), printed["photos"])
        self.assertEqual(selection.summary["provider"], printed["provider"])
        self.assertEqual(selection.summary["splats"], printed["splats"])
        # The labels pick the object's splats out of the scene, in their order.
        scene, labels = selection.labelled_scene()
        np.testing.assert_array_equal(scene.means[labels], selection.splats().means)
        self.assertEqual(len(scene), len(self.run_folder.splats()))
        prompted = dict(selection.masks("prompted"))
        self.assertEqual(list(prompted), [prompts.photo for prompts in selection.prompts])
        for photo, mask in prompted.items():
            self.assertEqual(mask.shape, self.run_folder.photo(photo).size[::-1])
            self.assertTrue(mask.any())

    def test_measures_of_masks_are_those_of_the_program(self) -> None:
        name, _ = selected()
        truth = self.scene / "truth" / name
        run = str(self.run_folder.path)
        score = json.loads(program("eval", run, "--selection", "it", "--truth", str(truth), "--json"))
        self.assertGreater(len(score["photos"]), 3)
        selection, means = self.run_folder.selection("it"), []
        for row in score["photos"]:
            true = read_mask((truth / row["photo"]).with_suffix(".png"))
            visible, amodal = selection.mask(row["photo"]), selection.mask(row["photo"], "amodal")
            self.assertAlmostEqual(iou(visible, true), row["iou"], delta=1e-9)
            self.assertAlmostEqual(boundary_iou(visible, true), row["boundary_iou"], delta=1e-9)
            self.assertAlmostEqual(iou(amodal, true), row["amodal_iou"], delta=1e-9)
            means += [] if row["prompted"] else [iou(visible, true)]
        self.assertAlmostEqual(float(np.mean(means)), score["iou"], delta=1e-9)

    def test_splats_of_an_object_lie_in_its_masks(self) -> None:
        """The space of cameras and splats is one: what an object's splats cover is where they are projected to."""
        selection, inside, in_frame, areas = self.run_folder.selection("it"), 0, 0, []
        means = selection.splats().means
        for photo in self.run_folder.photos:
            pixels, depths, shown = photo.camera.project(means)
            self.assertTrue((depths[shown] > 0).all())
            x, y = np.floor(pixels[shown]).astype(int).T
            mask = selection.mask(photo.name, "amodal")
            inside += int(mask[y, x].sum())
            areas.append(mask.mean())
            in_frame += int(shown.sum())
        self.assertGreater(in_frame, 100)
        # A short training leaves some splats at the edge of the object. By chance as many would lie in it as it covers.
        share = inside / in_frame
        self.assertGreater(share, 0.4)
        self.assertGreater(share, 5 * np.mean(areas))

    def test_objects_and_their_masks_are_those_of_the_program_and_of_pycocotools(self) -> None:
        from pycocotools.coco import COCO
        from plyfile import PlyData

        out, printed = exported()
        folder = ObjectFolder(out)
        self.assertEqual([o.splats for o in folder.objects], [o["splats"] for o in printed["objects"]])
        self.assertEqual(folder.objects, self.run_folder.objects)
        self.assertEqual(folder.objects[0].label, "first")
        labels = folder.labels()
        np.testing.assert_array_equal(labels, PlyData.read(str(out / "labels.ply"))["vertex"]["object"])
        for thing in folder.objects:
            self.assertEqual(int((labels == thing.number).sum()), thing.splats)
            self.assertEqual(len(read_ply(out / f"{thing.label}.ply")), thing.splats)
            x, y = thing.pixel
            self.assertTrue(folder.masks().mask(thing.photo, thing.number)[int(y), int(x)])
        masks, reference = folder.masks(), COCO(str(out / "coco.json"))
        self.assertEqual(len(masks), printed["exported"]["masks"])
        self.assertEqual(len(masks), len(reference.anns))
        for annotation in reference.anns.values():
            photo = reference.imgs[annotation["image_id"]]["file_name"]
            mask = masks.mask(photo, annotation["category_id"])
            np.testing.assert_array_equal(mask, reference.annToMask(annotation).astype(bool))
            self.assertEqual(int(mask.sum()), annotation["area"])

    def test_scores_are_those_that_the_program_prints(self) -> None:
        printed = json.loads(program("eval", str(self.run_folder.path), "--json"))
        held = self.run_folder.evaluation
        assert held is not None
        self.assertEqual((held.protocol, held.psnr, held.ssim), (printed["protocol"], printed["psnr"], printed["ssim"]))
        self.assertEqual([s.photo for s in held.photos], [p["photo"] for p in printed["photos"]])
        self.assertAlmostEqual(held.psnr, float(np.mean([s.psnr for s in held.photos])), delta=1e-3)
        for score in held.photos:
            render = read_png(self.run_folder.held_out_render(score.photo))
            self.assertEqual(render.shape[2:], (3,))

    def test_features_transients_and_history_fit_the_scene(self) -> None:
        run = self.run_folder
        splats = run.splats()
        field = run.features()
        self.assertEqual(len(field.values), len(splats))
        lengths = np.linalg.norm(field.values, axis=1)
        self.assertTrue(np.isfinite(field.values).all() and (lengths > 0).mean() > 0.5)
        seen = int(np.argmax(lengths))
        self.assertAlmostEqual(float(field.similarity(seen)[seen]), 1.0, delta=1e-5)
        trained = next(photo for photo in run.photos if not photo.held_out)
        # At the size of the training: --size 96.
        height, width = run.transient_mask(trained.name).shape
        self.assertEqual(max(height, width), 96)
        self.assertAlmostEqual(width / height, trained.size[0] / trained.size[1], delta=0.02)
        history = run.history
        self.assertTrue((np.diff(history["step"]) > 0).all())
        self.assertEqual(int(history["splats"][-1]), len(splats))
        self.assertTrue(math.isfinite(history["loss"][-1]))

    def test_changed_bytes_of_real_files_are_read_or_refused_and_nothing_else(self) -> None:
        selected()
        folder = temporary_folder() / "run"
        names = ["cameras.json", "scene.json", "scene.ply", "features.bin", "evaluation.json", "objects/objects.json"]
        names += ["selections/it/prompts.json", "selections/it/labels.ply", "selections/it/object.ply"]
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(self.run_folder.path / name, folder / name)

        def read() -> None:
            run = Run(folder)
            selection = run.selection("it")
            for part in (run.photos, run.offset, run.splats(), run.features(), run.evaluation, run.objects):
                self.assertIsNot(part, run)
            selection.labels(), selection.splats(), selection.prompts

        read()
        refused = 0
        for seed, name in enumerate(names):
            good = (folder / name).read_bytes()
            for data in changed(good, 60, seed):
                (folder / name).write_bytes(data)
                try:
                    read()
                except SegwildError:
                    refused += 1
            (folder / name).write_bytes(good)
        self.assertGreater(refused, 60 * len(names) // 4)

    def test_the_package_starts_the_program_that_was_installed_with_it(self) -> None:
        # The layout of `pip install --target FOLDER`.
        folder = temporary_folder()
        shutil.copytree(Path(segwild.__file__).parent, folder / "segwild")
        (folder / "bin").mkdir()
        os.symlink(PROGRAM, folder / "bin" / "segwild")
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}
        command = [sys.executable, "-m", "segwild", "--version"]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder, check=True)
        self.assertEqual(done.stdout, program("--version"))


if __name__ == "__main__":
    unittest.main()
