"""Rasterising with OpenGL through pyrender on EGL, no display needed: filtered textures, and speed on a GPU.

Depth and albedo come from OpenGL. Face indices and normals come from the ray caster at the same pixel centres, because
pyrender blends the samples of its frame buffer, which indices do not survive; at silhouette pixels where the two
disagree, OpenGL decides what is a miss and the ray caster's face is kept only where OpenGL has depth.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from hat_ros.array_types import Float
from hat_ros.errors import MissingDependencyError
from hat_ros.target.model import Target
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.rendering import Rendering
from hat_ros.types import Camera

# OpenGL cameras look along -z with y up.
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


class PyrenderRenderer:
    """See the module's text. Needs the extra ``gl`` and an EGL driver.

    Raises:
        MissingDependencyError: pyrender or EGL is missing.
    """

    def __init__(self, target: Target) -> None:
        self._gl = _import_pyrender()
        self._target = target
        self._rays = RayRenderer(target)
        self._scene = self._gl.Scene(bg_color=np.zeros(4), ambient_light=np.ones(3))
        for mesh in _meshes(target):
            self._scene.add(self._gl.Mesh.from_trimesh(mesh, smooth=False))
        self._camera_node: Any = None
        self._canvas: Any = None

    def render(self, T_cam_target: Float, camera: Camera, color: bool = True) -> Rendering:
        """See :meth:`hat_ros.target.rendering.Renderer.render`."""
        traced = self._rays.render(T_cam_target, camera, color=False)
        self._point(T_cam_target, camera)
        rgb, depth = self._canvas.render(self._scene, flags=self._gl.RenderFlags.FLAT)
        hit = (depth > 0) & (traced.face_id >= 0)
        return Rendering(
            np.where(hit, depth, np.float32(0)).astype(np.float32),
            traced.normal_cam * hit[..., None],
            np.where(hit, traced.face_id, np.int32(-1)),
            (rgb if color else np.zeros_like(rgb)) * hit[..., None],
        )

    def close(self) -> None:
        """Give the OpenGL context back."""
        if self._canvas is not None:
            self._canvas.delete()
            self._canvas = None

    def _point(self, T_cam_target: Float, camera: Camera) -> None:
        gl, K = self._gl, camera.K
        distance = float(np.linalg.norm(T_cam_target[:3, :3] @ self._target.center_m + T_cam_target[:3, 3]))
        near = max(distance - 1.1 * self._target.bounding_radius_m, 1e-3 * distance, 1e-6)
        # OpenGL counts pixels from the corner: the centre of the first pixel is at one half.
        view = gl.IntrinsicsCamera(
            K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, znear=near, zfar=distance + self._target.diameter_m
        )
        if self._camera_node is not None:
            self._scene.remove_node(self._camera_node)
        # pyrender asks for the camera's pose in the world, here the target frame.
        self._camera_node = self._scene.add(view, pose=np.linalg.inv(T_cam_target) @ _GL_FROM_CV)
        if self._canvas is None:
            self._canvas = _canvas(gl, camera)
        self._canvas.viewport_width, self._canvas.viewport_height = camera.width, camera.height


def _meshes(target: Target) -> list[trimesh.Trimesh]:
    """One mesh per texture, corners unshared because coordinates of texture and colour belong to corners."""
    surface, out = target.surface, []
    for index in np.unique(surface.texture_id):
        mine = surface.texture_id == index
        corners = target.vertices_m[target.faces[mine]].reshape(-1, 3)
        mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
        if index >= 0:
            material = trimesh.visual.material.PBRMaterial(
                baseColorTexture=Image.fromarray(surface.textures[index]), baseColorFactor=[255, 255, 255, 255]
            )
            mesh.visual = trimesh.visual.TextureVisuals(uv=surface.corner_uv[mine].reshape(-1, 2), material=material)
        else:
            face_rgb = np.repeat(target.face_rgb[mine], 3, axis=0)
            rgb = face_rgb if surface.corner_rgb is None else surface.corner_rgb[mine].reshape(-1, 3)
            mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=rgb)
        out.append(mesh)
    return out


def _import_pyrender() -> Any:
    # PyOpenGL chooses its platform on first import; a platform chosen by the user stays.
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    try:
        import pyrender
    except (ImportError, AttributeError, OSError) as error:
        raise MissingDependencyError(
            f"renderer 'pyrender' cannot be loaded ({error}): run `pip install 'hat_ros[gl]'` and install EGL "
            f"(`apt install libegl1`), or use the renderer 'rays', which needs neither"
        ) from None
    return pyrender


def _canvas(gl: Any, camera: Camera) -> Any:
    try:
        return gl.OffscreenRenderer(camera.width, camera.height)
    except Exception as error:  # PyOpenGL raises what the driver makes of it
        raise MissingDependencyError(
            f"renderer 'pyrender' got no OpenGL context from EGL ({type(error).__name__}: {error}): install a driver "
            f"(`apt install libegl1 libgl1-mesa-dri`), or use the renderer 'rays'"
        ) from None
