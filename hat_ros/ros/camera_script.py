"""When a camera sends which image under which stamp: rate, jitter, drops, clock steps. No middleware."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from hat_ros.errors import ConfigError


@dataclass(frozen=True)
class ClockStep:
    """The camera's clock is moved.

    Attributes:
        at_s: seconds after the first image.
        by_s: seconds that are added from then on, negative = back.
    """

    at_s: float
    by_s: float

    @classmethod
    def parse(cls, text: str) -> ClockStep:
        """From ``AT:BY`` in seconds, for example ``4:-60``.

        Raises:
            ConfigError: it is none.
        """
        try:
            at_s, by_s = map(float, text.split(":"))
        except ValueError:
            raise ConfigError(f"clock_steps: expected AT:BY in seconds, such as 4:-60, found '{text}'") from None
        return cls(at_s, by_s)


@dataclass(frozen=True)
class Shot:
    """One image to be sent.

    Attributes:
        due_s: when it goes out, seconds after the start; never before the one ahead of it.
        index: of the image in the clip.
        offset_ns: exposure by the camera's clock, nanoseconds after the start.
    """

    due_s: float
    index: int
    offset_ns: int


@dataclass(frozen=True)
class CameraScript:
    """What a camera does over time; the same seed gives the same.

    Attributes:
        n_images: images of the clip; it is played forth and back, so that the target never jumps.
        rate_hz: images per second.
        jitter_ms: an image is sent up to this much after its exposure.
        drop_share: share of the images that are lost on the way, 0 to 1.
        clock_steps: of the clock that stamps the images.
        seed: of jitter and drops.
    """

    n_images: int
    rate_hz: float
    jitter_ms: float = 0.0
    drop_share: float = 0.0
    clock_steps: Sequence[ClockStep] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.rate_hz > 0:
            raise ConfigError(f"rate_hz must be positive, found {self.rate_hz:g}")
        if not 0 <= self.drop_share <= 1 or not self.jitter_ms >= 0:
            raise ConfigError(
                f"drop_share must lie in 0 to 1 and jitter_ms must not be negative, "
                f"found {self.drop_share:g} and {self.jitter_ms:g}"
            )

    def shots(self) -> Iterator[Shot]:
        """All images in the order of their exposures, without end."""
        chance, last_due_s, number = random.Random(self.seed), 0.0, 0
        period = max(1, 2 * (self.n_images - 1))
        while True:
            exposed_s = number / self.rate_hz
            last_due_s = max(last_due_s, exposed_s + 1e-3 * self.jitter_ms * chance.random())
            if chance.random() >= self.drop_share:
                step_s = sum(step.by_s for step in self.clock_steps if step.at_s <= exposed_s)
                place = number % period
                index = place if place < self.n_images else period - place
                yield Shot(last_due_s, index, round(1e9 * (exposed_s + step_s)))
            number += 1
