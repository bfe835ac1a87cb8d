"""Bodies with symmetries, 1 to 2 m large, symmetric about their z axis."""

import numpy as np
import trimesh

from hat_ros.target.loading import target_from_scene


def colored(mesh, rgba):
    """The mesh with a colour for all faces (4,), or one each (F, 4)."""
    mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=np.broadcast_to(rgba, (len(mesh.faces), 4)))
    return mesh


def rocket():
    """A cylinder with a nose and a darker nozzle."""
    nose = trimesh.creation.revolve(np.array([[0, 0.7], [0.25, 0.7], [0.08, 0.95], [0, 0.95]]), sections=64)
    nozzle = trimesh.creation.revolve(np.array([[0, -1.0], [0.2, -1.0], [0.05, -0.7], [0, -0.7]]), sections=64)
    parts = [(trimesh.creation.cylinder(0.25, 1.4, sections=64), 200), (nose, 200), (nozzle, 90)]
    return [colored(mesh, (grey, grey, grey, 255)) for mesh, grey in parts]


_BODIES = {
    "cube": lambda: [trimesh.creation.box((1, 1, 1))],
    "box": lambda: [trimesh.creation.box((0.8, 1.2, 2.0))],
    "prism": lambda: [trimesh.creation.box((1, 1, 2.0))],
    "hexagon": lambda: [trimesh.creation.cylinder(0.6, 1.5, sections=6)],
    "drum": lambda: [trimesh.creation.cylinder(0.5, 1.5, sections=48)],
    "rocket": rocket,
}


def body(name, place=None):
    """The target of this name, its file moved by a (4, 4) motion."""
    scene = trimesh.Scene(_BODIES[name]())
    if place is not None:
        scene.apply_transform(place)
    return target_from_scene(scene, name)
