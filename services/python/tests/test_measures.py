"""Measures and projections against their definitions, pixel by pixel."""

from __future__ import annotations

import math
import unittest

import numpy as np
from numpy.typing import NDArray

from segwild import Camera, boundary_iou, iou


def slow_boundary(mask: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """The pixels of a mask within `width` pixels, in chessboard distance, of what is outside of it or of the frame."""
    height, length = mask.shape
    near = np.zeros_like(mask)
    for y in range(height):
        for x in range(length):
            window = [
                0 <= v < height and 0 <= u < length and bool(mask[v, u])
                for v in range(y - width, y + width + 1)
                for u in range(x - width, x + width + 1)
            ]
            near[y, x] = mask[y, x] and not all(window)
    return near


class MeasuresTest(unittest.TestCase):
    def test_iou_counts_pixels(self) -> None:
        self.assertEqual(iou([[1, 1], [0, 0]], [[1, 0], [1, 0]]), 1 / 3)
        self.assertEqual(iou(np.zeros((3, 3)), np.zeros((3, 3))), 1.0)
        self.assertEqual(iou([True, False], [False, False]), 0.0)
        with self.assertRaises(ValueError):
            iou(np.zeros((3, 3)), np.zeros((3, 4)))

    def test_boundary_iou_counts_the_pixels_near_the_outlines(self) -> None:
        random = np.random.default_rng(11)
        for size in ((30, 41), (60, 80), (1, 9)):
            blobs = [np.kron(random.random((5, 5)) < 0.6, np.ones((20, 20), bool))[: size[0], : size[1]] for _ in range(2)]
            width = max(1, math.floor(math.hypot(*size) * 0.02 + 0.5))
            wanted = iou(slow_boundary(blobs[0], width), slow_boundary(blobs[1], width))
            self.assertEqual(boundary_iou(*blobs), wanted)
        with self.assertRaises(ValueError):
            boundary_iou([True], [True])


class CameraTest(unittest.TestCase):
    def test_a_point_has_the_pixel_of_its_ray(self) -> None:
        turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        camera = Camera(100, 80, 90.0, 95.0, 49.0, 41.0, turn, np.array([0.1, 0.2, 2.0]), False)
        for depth in (0.5, 3.0):
            for pixel, inside in (((49.0, 41.0), True), ((0.0, 0.0), True), ((99.9, 79.9), True), ((100.0, 5.0), False)):
                ray = np.linalg.inv(camera.intrinsics) @ [*pixel, 1.0]
                point = np.linalg.inv(camera.world_to_camera) @ [*(ray * depth), 1.0]
                pixels, depths, shown = camera.project(point[None, :3])
                np.testing.assert_allclose(pixels[0], pixel, atol=1e-9)
                self.assertAlmostEqual(depths[0], depth)
                if pixel != (0.0, 0.0):
                    self.assertEqual(shown[0], inside)
                half, _, _ = camera.resized(50, 40).project(point[None, :3])
                np.testing.assert_allclose(half[0], np.array(pixel) / 2, atol=1e-9)
        # Its own centre has no pixel, and neither has what is on the other side of it.
        pixels, depths, shown = camera.project([camera.centre, camera.centre - turn.T @ [0, 0, 1]])
        self.assertTrue(np.isnan(pixels).all() and not shown.any())
        np.testing.assert_allclose(depths, [0.0, -1.0], atol=1e-12)


if __name__ == "__main__":
    unittest.main()
