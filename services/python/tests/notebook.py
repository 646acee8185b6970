"""The notebook, cell by cell, in an empty folder, or in `SEGWILD_TEST_NOTEBOOK`, which may have its run already.

Without that run it trains a scene, so it is no part of the other tests.
"""

from __future__ import annotations

import json
import os
import unittest
from pathlib import Path
from typing import Any

import numpy as np

from segwild import Run, read_ply

from .support import NEEDS_PROGRAM, PROGRAM, temporary_folder

NOTEBOOK = Path(__file__).parents[3] / "docs/notebooks/photos_to_labelled_cloud.ipynb"


@unittest.skipUnless(PROGRAM, NEEDS_PROGRAM)
class NotebookTest(unittest.TestCase):
    def test_its_cells_run_in_order_and_leave_a_labelled_cloud(self) -> None:
        # Figures need no screen.
        os.environ["MPLBACKEND"] = "Agg"
        cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
        self.assertGreater(len(cells), 6)
        before = Path.cwd()
        folder = Path(os.environ.get("SEGWILD_TEST_NOTEBOOK") or temporary_folder())
        names: dict[str, Any] = {}
        os.chdir(folder)
        try:
            for number, cell in enumerate(cells, 1):
                with self.subTest(cell=number):
                    exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
        finally:
            os.chdir(before)
        cloud = np.load(folder / "labelled-cloud/labelled_cloud.npz")
        solid = read_ply(folder / "labelled-cloud/run/scene.ply").opacities > 0.5
        self.assertEqual({len(cloud[name]) for name in cloud.files}, {int(solid.sum())})
        self.assertGreater(int(cloud["pavilion"].sum()), 50)
        self.assertGreater(len(np.unique(cloud["objects"])), 3)
        self.assertGreater(names["mean_iou"], 0.5)
        self.assertEqual(Run(folder / "labelled-cloud/run").selections, ("pavilion",))

    def test_it_is_kept_without_outputs(self) -> None:
        for cell in json.loads(NOTEBOOK.read_text())["cells"]:
            self.assertEqual((cell.get("outputs", []), cell.get("execution_count")), ([], None))


if __name__ == "__main__":
    unittest.main()
