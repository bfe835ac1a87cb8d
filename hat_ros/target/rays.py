"""Ray casting against a target's triangles, with one scene per geometry and process.

Intel Embree casts the rays where the ``embreex`` wheel exists. Elsewhere (aarch64 Linux) compiled code of our own does,
which finds the same hits up to rounding and is several times slower.
"""

from __future__ import annotations

import hashlib
import threading
import weakref
from importlib.util import find_spec
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Float32, Int32
from hat_ros.target.model import Target
from hat_ros.types import Camera


class Hits(NamedTuple):
    """Nearest hits of N rays.

    Attributes:
        face: (N,) int32 index into ``Target.faces``, -1 = miss.
        distance: (N,) float32 ray parameter of the hit, in units of the direction's length; unspecified where missed.
        u, v: (N,) float32 barycentric weights of the face's second and third corner; unspecified where missed.
    """

    face: Int32
    distance: Float32
    u: Float32
    v: Float32

    def taken(self, rays: NDArray[np.intp]) -> Hits:
        """The hits of some rays: (M,) indices or (N,) bool."""
        return Hits(self.face[rays], self.distance[rays], self.u[rays], self.v[rays])

    @property
    def barycentric(self) -> Float32:
        """(N, 3) weights of the face's corners."""
        return np.stack([1.0 - self.u - self.v, self.u, self.v], axis=-1)


class RayCaster(Protocol):
    """Casts bundles of rays against one target, in the target frame; safe to use from several threads."""

    def trace(self, origins_m: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """Nearest hits of rays: (N, 3) metres, (N, 3) of any length."""
        ...

    def occluded(self, origins_m: NDArray[np.floating], directions: NDArray[np.floating]) -> Bool:
        """Whether anything lies on each ray: (N, 3) metres, (N, 3) of any length -> (N,)."""
        ...


# A scene lives for as long as anyone uses it. The key is the geometry itself, so equal models share one scene.
_casters: weakref.WeakValueDictionary[bytes, RayCaster] = weakref.WeakValueDictionary()
_building = threading.Lock()


def ray_caster(target: Target) -> RayCaster:
    """The ray caster of a target: built for the first who asks, shared with all who ask while it is in use."""
    key = hashlib.sha256(target.vertices_m.tobytes() + target.faces.tobytes()).digest()
    with _building:
        caster = _casters.get(key)
        if caster is None:
            caster = _casters[key] = build_caster(target.corners_m)
        return caster


def build_caster(corners_m: Float) -> RayCaster:
    """A new scene of triangles (F, 3, 3)."""
    if find_spec("embreex") is not None:
        from hat_ros.target.embree import EmbreeCaster

        return EmbreeCaster(corners_m)
    from hat_ros.target.bvh import BvhCaster

    return BvhCaster(corners_m)


def pixel_rays(camera: Camera, u_px: NDArray[np.number], v_px: NDArray[np.number]) -> Float:
    """Ray directions with z = 1 through a grid of image points: (U,), (V,) px -> (V, U, 3), camera frame."""
    y = (np.asarray(v_px, dtype=np.float64) - camera.K[1, 2]) / camera.K[1, 1]
    x = (np.asarray(u_px, dtype=np.float64)[None] - camera.K[0, 2] - camera.K[0, 1] * y[:, None]) / camera.K[0, 0]
    return np.stack([x, np.broadcast_to(y[:, None], x.shape), np.ones_like(x)], axis=-1)
