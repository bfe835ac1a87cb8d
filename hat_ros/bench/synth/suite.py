"""Named clips: the demo, and a benchmark modelled on the paper's four data sets, from the project's own CAD models.

Rates per frame are the paper's medians (Sec. "Rapid-Rotation Challenges on SHIRT"); image sizes and focal lengths are
those of the data sets; ranges are scaled to the size of our models, so that they span as many pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from hat_ros.bench.datasets.importer import Progress, import_dataset
from hat_ros.bench.synth.backdrop import Earth
from hat_ros.bench.synth.clips import ClipSpec, trajectory, write_clip
from hat_ros.bench.synth.mismatch import Mismatch, apply_mismatch
from hat_ros.bench.synth.models import write_model
from hat_ros.errors import UsageError
from hat_ros.io import own_folder
from hat_ros.target.loading import find_model, load_target


@dataclass(frozen=True)
class Clip:
    """A clip by name.

    Attributes:
        model: own model's name, a CAD file, or a ``target.yaml`` that names one.
        spec: how it is filmed.
        asymmetry: of an own model, see ``models.build_model``.
        mismatch: how the spacecraft differs from its CAD file.
    """

    model: str
    spec: ClipSpec
    asymmetry: float = 1.0
    mismatch: Mismatch = field(default_factory=Mismatch)

    def within(self, width_px: int | None) -> Clip:
        """The same view with images at most this wide; None = any width."""
        spec = self.spec
        if width_px is None or width_px >= spec.width:
            return self
        scale = width_px / spec.width
        small = replace(
            spec, width=round(spec.width * scale), height=round(spec.height * scale), focal_px=spec.focal_px * scale
        )
        return replace(self, spec=small)


_SPARK = ClipSpec(
    frames=300, width=1440, height=1080, focal_px=1745.0, range_m=(13.0, 5.0), drift=0.25,
    spin_deg_per_frame=0.41, to_sun_cam=(-1.0, -0.7, -1.0), kind="spark",
)  # fmt: skip
_SHIRT = ClipSpec(
    frames=200, width=1920, height=1200, focal_px=2988.0, range_m=(14.0, 9.0), drift=0.15, monochrome=True,
    spin_deg_per_frame=4.1, to_sun_cam=(-0.8, -1.0, -1.2), star_count=80, kind="shirt",
)  # fmt: skip
_SWISSCUBE = ClipSpec(
    frames=200, width=1024, height=1024, focal_px=607.57, range_m=(1.2, 4.0), drift=0.3,
    spin_deg_per_frame=1.627, to_sun_cam=(-0.7, -1.0, -0.3), earth=Earth(nadir_cam=(0.1, 0.5, 1.0)), kind="swisscube",
)  # fmt: skip
_YCBV = ClipSpec(
    frames=300, width=640, height=480, focal_px=1067.0, range_m=(1.6, 1.3), drift=0.25, table=True,
    start_rotvec=(2.2, 0.0, 0.0), spin_axis=(0.0, 0.0, 1.0), spin_deg_per_frame=0.12,
    to_sun_cam=(-0.5, -1.0, -0.6), exposure=0.6, ambient=0.35, noise=0.003, kind="ycbv",
)  # fmt: skip

DEMO = Clip(
    "observer",
    ClipSpec(
        frames=200, focal_px=1000.0, range_m=(11.0, 6.5), drift=0.3, start_rotvec=(1.45, 0.39, -0.06),
        spin_axis=(0.25, 0.15, 1.0), spin_deg_per_frame=1.2, precession_deg_per_frame=0.15,
        to_sun_cam=(-1.0, -0.6, -1.3), ambient=0.012, star_count=120, jpeg_quality=90, kind="demo",
    ),
    asymmetry=0.4,
)  # fmt: skip

CLIPS: dict[str, Clip] = {
    "demo": DEMO,
    "spark_observer": Clip("observer", _SPARK, 0.6),
    "spark_far": Clip("observer", replace(_SPARK, range_m=(16.0, 9.0), start_rotvec=(1.9, -0.4, 0.8), seed=1), 0.6),
    "shirt_synthetic": Clip("probe", _SHIRT),
    "shirt_lightbox": Clip(
        "probe",
        replace(_SHIRT, to_sun_cam=(1.2, -0.2, -0.9), exposure=1.4, ambient=0.03, noise=0.004, star_count=0, gloss=2.0,
                start_rotvec=(-0.5, 1.2, 0.3), seed=2),
    ),
    "swisscube_near": Clip("cubesat", _SWISSCUBE),
    "swisscube_limb": Clip(
        "cubesat",
        replace(_SWISSCUBE, earth=Earth(nadir_cam=(0.2, 1.0, 0.4), seed=3), start_rotvec=(0.3, -1.1, 2.0), seed=3),
    ),
    "ycbv_cubesat": Clip("cubesat", _YCBV),
    "ycbv_probe": Clip("probe", replace(_YCBV, range_m=(6.5, 5.0), seed=4)),
}  # fmt: skip

SUITE: dict[str, tuple[str, ...]] = {
    "spark": ("spark_observer", "spark_far"),
    "shirt": ("shirt_synthetic", "shirt_lightbox"),
    "swisscube": ("swisscube_near", "swisscube_limb"),
    "ycbv": ("ycbv_cubesat", "ycbv_probe"),
}

# What the paper gives its methods: masks before the Earth and on the table, and there a camera that moves through a
# static scene, which motion may look at as a whole.
SUITE_SETTINGS: dict[str, tuple[str, ...]] = {
    "swisscube": ("segmentation.backend=annotated",),
    "ycbv": ("segmentation.backend=annotated", "slam.masked=false"),
}


def synthesize(clip: Clip, out: str | Path, as_bag: bool = True, progress: Progress | None = None) -> Path:
    """Render a clip to a bag, or to a ``sequence`` folder.

    Args:
        clip: what to render.
        out: folder to create.
        as_bag: a bag (images stored as JPEG, byte for byte those of the folder), else the folder.
        progress: called with (name, frames done, frames in all).

    Raises:
        UsageError: ``out`` exists.
        MeshError: the CAD file is bad.
    """
    out = own_folder.checked_out(out)
    if out.exists():
        raise UsageError(f"{out} exists already; choose another name or remove it")
    work = out.with_name(f"{out.name}.work")
    with own_folder.NewFolder(work):
        model = find_model(_model_file(clip, work))
        target = load_target(model.mesh, model.unit_scale)
        seen = apply_mismatch(target, clip.mismatch)
        report = None if progress is None else lambda done, total: progress(out.name, done, total)
        folder = write_clip(
            seen, model.mesh, work / out.name, clip.spec, trajectory(clip.spec, target), report, model.unit_scale
        )
        if as_bag:
            import_dataset("sequence", folder, out)
        else:
            folder.rename(out)
    own_folder.remove(work)
    return out


def write_suite(
    out: str | Path, width_px: int | None = None, limit: int | None = None, progress: Progress | None = None
) -> list[Path]:
    """Render the benchmark into ``out/GROUP/CLIP`` bags; those that exist are left alone.

    Args:
        out: folder to fill.
        width_px: images at most this wide, so that no data set costs more per frame than another; None = any width.
        limit: at most this many frames per clip, over the whole approach.
        progress: see :func:`synthesize`.

    Returns:
        The bags.
    """
    out, bags = own_folder.checked_out(out), []
    for group, names in SUITE.items():
        for name in names:
            bag, clip = out / group / name, CLIPS[name].within(width_px)
            if limit is not None:
                clip = replace(clip, spec=replace(clip.spec, frames=min(limit, clip.spec.frames)))
            bags.append(bag if bag.exists() else synthesize(clip, bag, progress=progress))
    return bags


def _model_file(clip: Clip, folder: Path) -> Path:
    path = Path(clip.model)
    if path.suffix:
        return path
    model = folder / f"{clip.model}.glb"
    write_model(clip.model, model, clip.asymmetry)
    return model
