"""Cameras of photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole. Axes of the camera are COLMAP's: x right, y down, z ahead. (0, 0) is the outer corner of the first pixel."""

    #: Size of the photo in pixels.
    width: int
    height: int
    #: Focal lengths and principal point in pixels, of the photo after undistortion.
    fx: float
    fy: float
    cx: float
    cy: float
    #: World to camera, ``[3, 3]``: ``x_camera = rotation @ x + translation``, where ``x`` is a position of ``scene.ply``.
    rotation: NDArray[np.float64]
    #: ``[3]``, in units of the reconstruction.
    translation: NDArray[np.float64]
    #: Whether the photo as taken is distorted. Masks have its pixels; :meth:`project` gives those after undistortion.
    distorted: bool

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """The matrix K, ``[3, 3]``."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """The pose as a matrix, ``[4, 4]``."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation, self.translation
        return pose

    @property
    def centre(self) -> NDArray[np.float64]:
        """Where the camera stands, ``[3]``, in the space of ``scene.ply``."""
        return -self.rotation.T @ self.translation

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same photo at another size."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy,
            self.rotation, self.translation, self.distorted,
        )  # fmt: skip

    def project(
        self, points: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Pixels of positions, such as the means of splats.

        Args:
            points: ``[n, 3]``, in the space of ``scene.ply``.

        Returns:
            Pixel positions ``[n, 2]`` (x, y), ``nan`` where a point is not before the camera; depths ``[n]`` along z, in units of
            the reconstruction; and whether each lies in the frame, ``[n]``. What stands before it is not taken into account.
        """
        at = np.asarray(points, dtype=np.float64).reshape(-1, 3) @ self.rotation.T + self.translation
        depth = at[:, 2]
        ahead = depth > 0.0
        divisor = np.where(ahead, depth, np.nan)
        pixels = np.stack([self.fx * at[:, 0] / divisor + self.cx, self.fy * at[:, 1] / divisor + self.cy], axis=1)
        low, high = pixels >= 0.0, pixels < (self.width, self.height)
        return pixels, depth, ahead & low.all(axis=1) & high.all(axis=1)
