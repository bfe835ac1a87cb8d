"""``hat synth``: a clip of any CAD model, with exact ground truth, written in the ``sequence`` layout."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hat_ros.array_types import Bool, Float, Float32, UInt8
from hat_ros.bench.datasets.image_files import FRAME_STEP_NS
from hat_ros.bench.datasets.sequence import write_labels
from hat_ros.bench.synth.backdrop import Earth, EarthView, Table, stars
from hat_ros.bench.synth.sunlit import Light, SunlitRenderer
from hat_ros.errors import UsageError
from hat_ros.geometry import lie
from hat_ros.io import own_folder
from hat_ros.target.mesh_file import copy_model
from hat_ros.target.model import Target
from hat_ros.target.srgb import srgb_from_linear
from hat_ros.types import Camera

Progress = Callable[[int, int], None]

# Full well of the sensor in electrons at exposed white: sets the shot noise.
_FULL_WELL = 9000.0
# Where stray light is brightest, of width and height, and over which share of the width it fades to a third.
_GLARE_AT, _GLARE_REACH = (0.85, 0.15), 0.11


@dataclass(frozen=True)
class ClipSpec:
    """Everything that decides a clip besides the model; the same spec gives the same bytes.

    Attributes:
        frames: number of frames, 0.1 s apart.
        width: image width in pixels.
        height: image height in pixels.
        focal_px: focal length in pixels, the principal point lies in the middle.
        range_m: distance of the target's centre at the first and at the last frame; changes at a constant ratio.
        drift: amplitude of the sideways motion, as a share of what would carry the centre to the image border.
        start_rotvec: rotation vector of the first attitude ``R_cam_target``, radians.
        spin_axis: axis of the rotation in the target frame, any length.
        spin_deg_per_frame: rate about it.
        precession_deg_per_frame: rate of the spin axis about the camera's y axis.
        to_sun_cam: direction to the sun in the camera frame, any length.
        exposure: what a white face square to the sun becomes, 1 = just saturated.
        ambient: even light from all sides, in the same unit.
        noise: sigma of the read noise, in the same unit; shot noise is added to it.
        psf_px: sigma of the point spread.
        star_count: stars in the field.
        earth: Earth behind the target, None = black sky.
        table: whether the target lies on a textured table, at rest, seen by a moving camera; the sun rests too.
        monochrome: a grey sensor.
        glare: stray light of a sun at the upper right, what it is there in the unit of ``exposure``; 0 = none.
        jpeg_quality: 0 writes PNG instead.
        supersample: rays per pixel and side.
        gloss: multiplies the specular reflection.
        seed: of noise, stars and textures.
        kind: free text kept in ``labels.json``.
    """

    frames: int = 200
    width: int = 640
    height: int = 480
    focal_px: float = 1000.0
    range_m: tuple[float, float] = (12.0, 6.0)
    drift: float = 0.3
    start_rotvec: tuple[float, float, float] = (1.0, 0.6, -0.4)
    spin_axis: tuple[float, float, float] = (0.3, 0.2, 1.0)
    spin_deg_per_frame: float = 1.0
    precession_deg_per_frame: float = 0.0
    to_sun_cam: tuple[float, float, float] = (-1.0, -0.8, -1.0)
    exposure: float = 0.85
    ambient: float = 0.01
    noise: float = 0.0008
    psf_px: float = 0.6
    star_count: int = 0
    earth: Earth | None = None
    table: bool = False
    monochrome: bool = False
    glare: float = 0.0
    jpeg_quality: int = 92
    supersample: int = 2
    gloss: float = 1.0
    seed: int = 0
    kind: str = "synthetic"

    def __post_init__(self) -> None:
        ranges = {"frames": (1, 100_000), "width": (16, 8192), "height": (16, 8192), "focal_px": (1, 1e6),
                  "supersample": (1, 8), "jpeg_quality": (0, 100), "drift": (0, 2), "exposure": (1e-6, 1e6),
                  "noise": (0, 1), "psf_px": (0, 20), "star_count": (0, 1_000_000), "glare": (0, 10)}  # fmt: skip
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise UsageError(f"synth: {name} must be between {low:g} and {high:g}, found {value}")
        if not min(self.range_m) > 0:
            raise UsageError(f"synth: range_m must be positive, found {self.range_m}")
        if not np.linalg.norm(self.spin_axis) > 0 or not np.linalg.norm(self.to_sun_cam) > 0:
            raise UsageError("synth: spin_axis and to_sun_cam must not be zero vectors")

    @property
    def camera(self) -> Camera:
        """The pinhole camera of the clip."""
        K = np.array([[self.focal_px, 0, (self.width - 1) / 2], [0, self.focal_px, (self.height - 1) / 2], [0, 0, 1.0]])
        return Camera(K, self.width, self.height)


@dataclass(frozen=True, eq=False)
class SynthFrame:
    """One rendered frame.

    Attributes:
        rgb: (H, W, 3) uint8.
        mask: (H, W) bool visible target, by the rays through the pixel centres.
        T_cam_target: (4, 4) ground truth.
    """

    rgb: UInt8
    mask: Bool
    T_cam_target: Float


def trajectory(spec: ClipSpec, target: Target) -> Float:
    """(N, 4, 4) ``T_cam_target``: constant spin about a body axis, slow precession, approach and sideways drift."""
    s = np.linspace(0.0, 1.0, spec.frames) if spec.frames > 1 else np.zeros(1)
    distance = spec.range_m[0] * (spec.range_m[1] / spec.range_m[0]) ** s
    border = np.array([spec.width, spec.height]) / (2 * spec.focal_px)
    sway = spec.drift * np.stack([np.sin(4.4 * s + 0.5), np.sin(2.9 * s + 2.2)], axis=-1)
    center = distance[:, None] * np.concatenate([sway * border, np.ones((spec.frames, 1))], axis=-1)

    index = np.arange(spec.frames)[:, None]
    axis = np.asarray(spec.spin_axis) / np.linalg.norm(spec.spin_axis)
    spin = lie.so3_exp(np.radians(spec.spin_deg_per_frame) * index * axis)
    precession = lie.so3_exp(np.radians(spec.precession_deg_per_frame) * index * np.array([0.0, 1.0, 0.0]))
    R = precession @ lie.so3_exp(np.asarray(spec.start_rotvec)) @ spin
    return lie.transform(R, center - R @ target.center_m)


def render_clip(target: Target, spec: ClipSpec, poses: Float | None = None) -> Iterator[SynthFrame]:
    """Render the frames of a clip one by one.

    Args:
        target: what is seen (give a mismatched model here to study wrong CAD files).
        spec: the clip.
        poses: (N, 4, 4) ``T_cam_target``; None = :func:`trajectory` of this target.
    """
    poses = trajectory(spec, target) if poses is None else poses
    camera = spec.camera
    renderer = SunlitRenderer(target, spec.supersample, spec.gloss)
    sky, glare = _Backdrop(spec, camera, target), _glare(spec)
    to_earth = None if spec.earth is None else np.asarray(spec.earth.nadir_cam, dtype=np.float64)
    to_sun = np.asarray(spec.to_sun_cam, dtype=np.float64)
    for index, T_cam_target in enumerate(poses):
        if spec.table and index:
            to_sun = T_cam_target[:3, :3] @ poses[index - 1][:3, :3].T @ to_sun
        light = Light(to_sun, spec.ambient, to_earth, 0.05)
        radiance, coverage = renderer.render(T_cam_target, camera, light)
        image = radiance + sky.radiance(index, T_cam_target) * (1 - coverage[..., None])
        image = image + glare
        mask = renderer.plain.render(T_cam_target, camera, color=False).mask
        yield SynthFrame(_expose(image, spec, index), mask, T_cam_target)


class _Backdrop:
    def __init__(self, spec: ClipSpec, camera: Camera, target: Target) -> None:
        self._camera = camera
        self._stars = stars(camera, spec.seed, spec.star_count)
        self._earth, self._table = None, None
        if spec.earth is not None:
            self._earth = EarthView(spec.earth, camera, np.asarray(spec.to_sun_cam, dtype=np.float64))
            self._stars = self._stars * ~self._earth.covers[..., None]
        if spec.table:
            self._table = Table(float(target.vertices_m[:, 2].min()), 4 * target.diameter_m, spec.seed)

    def radiance(self, index: int, T_cam_target: Float) -> Float32:
        if self._table is not None:
            return self._table.radiance(T_cam_target, self._camera)
        if self._earth is not None:
            return self._stars + self._earth.radiance(index * FRAME_STEP_NS * 1e-9)
        return self._stars


def _glare(spec: ClipSpec) -> Float32:
    """(H, W, 1) stray light before exposure."""
    x, y = np.arange(spec.width) - _GLARE_AT[0] * spec.width, np.arange(spec.height) - _GLARE_AT[1] * spec.height
    distance = np.hypot(x[None, :], y[:, None])
    glow = spec.glare / spec.exposure * np.exp(-distance / (_GLARE_REACH * spec.width))
    return glow[..., None].astype(np.float32)


def _expose(radiance: Float32, spec: ClipSpec, index: int) -> UInt8:
    """Optics and sensor: point spread, saturation, shot and read noise, sRGB encoding."""
    image = radiance * np.float32(spec.exposure)
    if spec.monochrome:
        image = image @ np.array([0.3, 0.55, 0.15], np.float32)
    if spec.psf_px > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), spec.psf_px), np.float32)
    rng = np.random.default_rng([spec.seed, 4, index])
    if spec.noise > 0:
        sigma = np.sqrt(np.float32(spec.noise**2) + np.clip(image, 0, 1) / np.float32(_FULL_WELL))
        image = image + sigma * rng.standard_normal(image.shape, dtype=np.float32)
    pixels = _SRGB[(np.clip(image, 0, 1) * np.float32(len(_SRGB) - 1) + np.float32(0.5)).astype(np.int32)]
    return np.repeat(pixels[..., None], 3, axis=2) if spec.monochrome else pixels


# sRGB encoding as a table: its steepest step is below half a grey level.
_SRGB = srgb_from_linear(np.linspace(0, 1, 8192))


def write_clip(
    seen: Target,
    model: Path,
    out: Path,
    spec: ClipSpec,
    poses: Float | None = None,
    progress: Progress | None = None,
    unit_scale: float = 1.0,
) -> Path:
    """Render a clip into a ``sequence`` folder; it appears under its name only when it is complete.

    Args:
        seen: what the camera sees.
        model: CAD file that goes with the clip; copied, with what it names.
        out: folder to create.
        spec: the clip.
        poses: see :func:`render_clip`.
        progress: called with (frames done, frames in all).
        unit_scale: metres per unit of ``model``.

    Raises:
        UsageError: ``out`` exists already.
    """
    if out.exists():
        raise UsageError(f"{out} exists already; choose another name or remove it")
    partial = out.with_name(out.name + ".partial")
    own_folder.remove(partial)
    for folder in ("images", "masks"):
        (partial / folder).mkdir(parents=True)
    own_folder.mark(partial)
    suffix = "jpg" if spec.jpeg_quality else "png"
    options = [cv2.IMWRITE_JPEG_QUALITY, spec.jpeg_quality] if spec.jpeg_quality else []
    names, truth = [], []
    for index, frame in enumerate(render_clip(seen, spec, poses)):
        names.append(f"{index:06d}.{suffix}")
        truth.append(frame.T_cam_target)
        cv2.imwrite(str(partial / "images" / names[-1]), frame.rgb[..., ::-1], options)
        cv2.imwrite(str(partial / "masks" / f"{index:06d}.png"), frame.mask.astype(np.uint8) * 255)
        if progress is not None:
            progress(index + 1, spec.frames)
    mesh = copy_model(model, partial, "target")
    write_labels(partial, spec.camera, mesh, spec.kind, np.array(truth), names, unit_scale)
    partial.rename(out)
    return out
