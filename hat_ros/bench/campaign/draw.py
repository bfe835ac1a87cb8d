"""What a campaign's clips show: every factor drawn from a stream of its own, by seed and number.

A stream is ``default_rng([seed, number of the clip, number of the factor])``, so that a new factor leaves all others as
they are, and clip 17 is the same in a campaign of 20 and of 2,000. Craft, background, sensor and mismatch are dealt
like cards: every hand of so many clips has each of them in its share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.synth.backdrop import Earth
from hat_ros.bench.synth.clips import ClipSpec
from hat_ros.bench.synth.mismatch import Mismatch
from hat_ros.geometry import lie

Choice = TypeVar("Choice")
Band = tuple[float, float]

BACKGROUNDS = ("sky", "earth", "limb")
SIZE_PX: Band = (70.0, 330.0)
RATE_DEG: Band = (0.3, 4.0)

# Numbers of the streams; a factor keeps its number for ever.
_CRAFT, _ATTITUDE, _SUN, _SIZE, _RATE, _PRECESSION, _BACKGROUND, _EARTH, _SENSOR, _GREY, _JPEG, _MISMATCH, _SEED = (
    range(13)
)

_DECK_OF_BACKGROUNDS = ("sky", "sky", "earth", "earth", "limb")
_DECK_OF_MISMATCHES = (*["none"] * 9, *["panels"] * 2, *["missing"] * 2, *["colours"] * 2)
_EARTH_RADIUS_KM = 6371.0
_ALTITUDE_KM: Band = (300.0, 2000.0)
# The ground's texture repeats: it is not looked at further from straight down than this.
_MAX_TILT_DEG = 45.0
# How far the horizon passes from the middle of the image, as a share of half the image's diagonal.
_LIMB_OFFSET = 0.6


@dataclass(frozen=True)
class View:
    """The camera and the length of all clips.

    Attributes:
        frames: of a clip.
        width: of the image in pixels.
        height: of the image in pixels.
        focal_px: focal length in pixels.
    """

    frames: int = 50
    width: int = 640
    height: int = 480
    focal_px: float = 1000.0

    @property
    def half_deg(self) -> float:
        """Angle from the middle of the image to its corner."""
        return float(np.degrees(np.arctan(0.5 * np.hypot(self.width, self.height) / self.focal_px)))


DEFAULT_VIEW = View()


@dataclass(frozen=True)
class Cell:
    """A place of the map: what a clip is told instead of drawing it.

    Attributes:
        background: one of :data:`BACKGROUNDS`.
        size_px: the craft's diameter at the first frame lies between these.
        phase_deg: the angle sun, craft, camera lies between these.
    """

    background: str
    size_px: Band
    phase_deg: Band


@dataclass(frozen=True)
class CampaignClip:
    """A clip of a campaign, in plain values.

    Attributes:
        index: number of the clip.
        craft: name of the craft.
        background: one of :data:`BACKGROUNDS`.
        mismatch_kind: ``none``, ``panels``, ``missing`` or ``colours``.
        mismatch: how the craft differs from its CAD model.
        size_px: the craft's diameter in pixels at the first and at the last frame.
        phase_deg: angle sun, craft, camera; 0 = the sun is behind the camera.
        film: how it is filmed; ``range_m`` in diameters of the craft.
        cell: its place on the map, None = drawn freely.
    """

    index: int
    craft: str
    background: str
    mismatch_kind: str
    mismatch: Mismatch
    size_px: Band
    phase_deg: float
    film: ClipSpec
    cell: Cell | None = None

    def spec(self, diameter_m: float) -> ClipSpec:
        """How a craft of this diameter is filmed."""
        first, last = self.film.range_m
        return replace(self.film, range_m=(first * diameter_m, last * diameter_m))

    def factors(self) -> dict[str, Any]:
        """What tables group by and ``by_clip.csv`` lists."""
        return {
            "craft": self.craft,
            "background": self.background,
            "grey": self.film.monochrome,
            "size_px": float(np.sqrt(self.size_px[0] * self.size_px[1])),
            "size_first_px": self.size_px[0],
            "size_last_px": self.size_px[1],
            "phase_deg": self.phase_deg,
            "rate_deg_per_frame": self.film.spin_deg_per_frame,
            "precession_deg_per_frame": self.film.precession_deg_per_frame,
            "mismatch": self.mismatch_kind,
            "exposure": self.film.exposure,
            "noise": self.film.noise,
            "psf_px": self.film.psf_px,
            "ambient": self.film.ambient,
            "jpeg_quality": self.film.jpeg_quality,
        }


def draw_clip(
    seed: int,
    index: int,
    crafts: Sequence[str],
    view: View = DEFAULT_VIEW,
    cell: Cell | None = None,
) -> CampaignClip:
    """Draw a clip.

    Args:
        seed: of the campaign.
        index: number of the clip.
        crafts: names to choose from.
        view: camera and length of the clip.
        cell: its place on the map, None = drawn freely.
    """

    def stream(factor: int) -> np.random.Generator:
        return np.random.default_rng([seed, index, factor])

    background = _dealt(seed, index, _BACKGROUND, _DECK_OF_BACKGROUNDS) if cell is None else cell.background
    earth = None if background == "sky" else _earth(stream(_EARTH), background, view.half_deg)
    to_sun = _to_sun(stream(_SUN), earth, (0.0, 180.0) if cell is None else cell.phase_deg)
    rng = stream(_SIZE)
    first = _log_uniform(rng, *(SIZE_PX if cell is None else cell.size_px))
    last, drift = first * _log_uniform(rng, 0.7, 1.4), float(rng.uniform(0.0, 0.3))
    rng = stream(_ATTITUDE)
    start = lie.so3_log(lie.matrix_from_quat(rng.normal(size=4)))
    axis = rng.normal(size=3)
    rate = _log_uniform(stream(_RATE), *RATE_DEG)
    kind, mismatch = _mismatch(stream(_MISMATCH), _dealt(seed, index, _MISMATCH, _DECK_OF_MISMATCHES))
    film = ClipSpec(
        frames=view.frames,
        width=view.width,
        height=view.height,
        focal_px=view.focal_px,
        range_m=(view.focal_px / first, view.focal_px / last),
        drift=drift,
        start_rotvec=_triple(start),
        spin_axis=_triple(axis),
        spin_deg_per_frame=rate,
        precession_deg_per_frame=_precession(stream(_PRECESSION), rate),
        to_sun_cam=_triple(to_sun),
        earth=earth,
        monochrome=_dealt(seed, index, _GREY, (False, True)),
        jpeg_quality=_jpeg_quality(stream(_JPEG)),
        seed=int(stream(_SEED).integers(2**31)),
        kind="campaign",
    )
    phase = float(np.degrees(np.arccos(np.clip(-to_sun[2], -1, 1))))
    craft = _dealt(seed, index, _CRAFT, crafts)
    film = _with_sensor(stream(_SENSOR), film)
    return CampaignClip(index, craft, background, kind, mismatch, (first, last), phase, film, cell)


def _dealt(seed: int, index: int, factor: int, deck: Sequence[Choice]) -> Choice:
    """Card ``index`` of a deck that is shuffled anew whenever it has been dealt."""
    hand, place = divmod(index, len(deck))
    order = np.random.default_rng([seed, hand, factor, 1]).permutation(len(deck))
    return deck[int(order[place])]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _triple(vector: Float) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def _disc_deg(altitude_km: float) -> float:
    """Half angle of the Earth's disc."""
    return float(np.degrees(np.arcsin(_EARTH_RADIUS_KM / (_EARTH_RADIUS_KM + altitude_km))))


def _earth(rng: np.random.Generator, background: str, half_deg: float) -> Earth:
    """An Earth that fills the image (as far as a very wide one allows), or whose limb crosses it."""
    altitude = _log_uniform(rng, *_ALTITUDE_KM)
    disc = _disc_deg(altitude)
    if background == "limb":
        tilt = disc + _LIMB_OFFSET * half_deg * rng.uniform(-1, 1)
    else:
        tilt = max(0.0, min(_MAX_TILT_DEG, disc - half_deg - 2.0)) * np.sqrt(rng.uniform())
    azimuth = rng.uniform(0, 2 * np.pi)
    slant = np.sin(np.radians(tilt))
    nadir = np.array([slant * np.cos(azimuth), slant * np.sin(azimuth), np.cos(np.radians(tilt))])
    return Earth(altitude, _triple(nadir), seed=int(rng.integers(2**31)))


def _to_sun(rng: np.random.Generator, earth: Earth | None, phase_deg: Band) -> Float:
    """(3,) unit direction, uniform where the phase angle is allowed and the Earth does not hide the sun."""
    low, high = (-np.cos(np.radians(angle)) for angle in phase_deg)
    while True:
        z, azimuth = rng.uniform(low, high), rng.uniform(0, 2 * np.pi)
        to_sun = np.array([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z])
        if earth is None or to_sun @ np.asarray(earth.nadir_cam) < np.cos(np.radians(_disc_deg(earth.altitude_km))):
            return to_sun


def _precession(rng: np.random.Generator, rate: float) -> float:
    """A third of the craft precess, at up to half their rate, either way."""
    return float(rate * rng.uniform(0.1, 0.5) * rng.choice((-1, 1))) if rng.uniform() < 1 / 3 else 0.0


def _with_sensor(rng: np.random.Generator, film: ClipSpec) -> ClipSpec:
    return replace(
        film,
        exposure=_log_uniform(rng, 0.5, 1.3),
        noise=_log_uniform(rng, 0.0005, 0.01),
        psf_px=float(rng.uniform(0.4, 1.2)),
        ambient=_log_uniform(rng, 0.002, 0.02),
        star_count=int(rng.integers(0, 200)),
    )


def _jpeg_quality(rng: np.random.Generator) -> int:
    """Half of the images are not compressed."""
    return int(rng.integers(60, 98)) if rng.uniform() < 0.5 else 0


def _mismatch(rng: np.random.Generator, kind: str) -> tuple[str, Mismatch]:
    seed, share = int(rng.integers(2**31)), float(rng.uniform())
    kinds = {
        "none": Mismatch(seed=seed),
        "panels": Mismatch(panel_turn_deg=5 + 15 * share, seed=seed),
        "missing": Mismatch(missing=0.1 + 0.2 * share, seed=seed),
        "colours": Mismatch(recolor=0.3 + 0.7 * share, seed=seed),
    }
    return kind, kinds[kind]
