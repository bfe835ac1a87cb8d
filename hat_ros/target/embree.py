"""Ray casting with Intel Embree (the ``embreex`` wheel): no GL, and the same bytes every time."""

from __future__ import annotations

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float
from hat_ros.target.rays import Hits


class EmbreeCaster:
    """See :class:`hat_ros.target.rays.RayCaster`.

    Args:
        corners_m: (F, 3, 3) corners of the triangles.
    """

    def __init__(self, corners_m: Float) -> None:
        self._scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self._scene, np.ascontiguousarray(corners_m, dtype=np.float32))
        # The first rays make Embree build its tree: here, where no other thread can cast any yet.
        self.trace(np.zeros((1, 3)), np.ones((1, 3)))

    def trace(self, origins_m: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """See the protocol."""
        hits = self._scene.run(
            np.ascontiguousarray(origins_m, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            output=True,
        )
        return Hits(hits["primID"], hits["tfar"], hits["u"], hits["v"])

    def occluded(self, origins_m: NDArray[np.floating], directions: NDArray[np.floating]) -> Bool:
        """See the protocol."""
        hits = self._scene.run(
            np.ascontiguousarray(origins_m, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            query="OCCLUDED",
        )
        return np.asarray(hits) != -1
