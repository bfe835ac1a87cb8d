"""What the segmentation network is trained on, and for how long: a few numbers and CAD files determine all of it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from hat_ros.bench.synth.craft import generated_craft
from hat_ros.bench.synth.models import build_target, model_names
from hat_ros.errors import UsageError
from hat_ros.target.loading import load_target
from hat_ros.target.model import Target

Kind = Literal["cad", "model", "generated"]

# Seeds below this are for training, those from here on for data kept aside. Campaigns generate craft from 1,000,000 on.
FIRST_KEPT_SEED = 500_000
# A craft that a person modelled shows more than a generated one: so many times the views.
_CAD_VIEWS, _MODEL_VIEWS = 12.3, 5.75
# Kept aside: one craft per ten generated ones, one background per twenty, and of each craft so many views.
_CRAFT_PER_KEPT, _BACKGROUNDS_PER_KEPT = 10, 20
_KEPT_VIEWS, _KEPT_CAD_VIEWS = 6, 40
# Samples that calibration and figures are computed from; no more than steps of training, and at least one batch.
_MAX_KEPT_SAMPLES, _MIN_KEPT_SAMPLES = 1024, 32


@dataclass(frozen=True)
class Source:
    """A craft to render.

    Attributes:
        kind: a CAD file, a model of the package's own, or a generated craft.
        views: how many.
        path: of the CAD file.
        model: name of the model.
        seed: of the generated craft.
    """

    kind: Kind
    views: int
    path: Path = Path()
    model: str = ""
    seed: int = 0

    def load(self) -> Target:
        """The craft.

        Raises:
            MeshError: the CAD file cannot be used.
        """
        if self.kind == "cad":
            return load_target(self.path)
        return build_target(self.model) if self.kind == "model" else generated_craft(self.seed)


@dataclass(frozen=True)
class Collection:
    """What one set of samples is composed from.

    Attributes:
        sources: the craft.
        backgrounds: how many.
        seed: of views and backgrounds.
    """

    sources: tuple[Source, ...]
    backgrounds: int
    seed: int

    def fingerprint(self) -> dict[str, Any]:
        """All that determines the rendered data, in types that JSON has.

        Raises:
            MeshError: a CAD file cannot be used.
        """
        return {
            "cads": [
                {"file": source.path.name, "sha256": source.load().sha256, "views": source.views}
                for source in self._of_kind("cad")
            ],
            "models": [{"name": source.model, "views": source.views} for source in self._of_kind("model")],
            "generated": {
                "seeds": [source.seed for source in self._of_kind("generated")],
                "views": sum(source.views for source in self._of_kind("generated")),
            },
            "backgrounds": self.backgrounds,
            "seed": self.seed,
            "code_sha256": _code_sha256(),
        }

    def _of_kind(self, kind: Kind) -> Iterator[Source]:
        return (source for source in self.sources if source.kind == kind)


@cache
def _code_sha256() -> str:
    """Digest of the sources that render craft and backgrounds."""
    here = Path(__file__).parent
    files = [here / f"{name}.py" for name in ("backgrounds", "coding", "views")]
    files += sorted((here.parent / "synth").glob("*.py"))
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()


@dataclass(frozen=True)
class Recipe:
    """What to train on.

    Attributes:
        cads: CAD files in metres, or target.yaml files.
        kept_cads: likewise, never trained on: for calibration and figures.
        generated: craft of seeds 0 to ``generated`` - 1.
        views: of each generated craft.
        backgrounds: images to place craft before.
        steps: of the optimiser.
        seed: of everything that is drawn in training.

    Raises:
        UsageError: a number reaches into the seeds of data kept aside.
    """

    cads: tuple[Path, ...] = ()
    kept_cads: tuple[Path, ...] = ()
    generated: int = 840
    views: int = 20
    backgrounds: int = 4000
    steps: int = 9500
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value in (("generated", self.generated), ("seed", self.sample_seed)):
            if value > FIRST_KEPT_SEED:
                raise UsageError(
                    f"{name}: seeds from {FIRST_KEPT_SEED} on are those of data kept aside: choose a smaller number"
                )

    @property
    def training(self) -> Collection:
        """What is trained on."""
        per_cad, per_model = (max(1, round(factor * self.views)) for factor in (_CAD_VIEWS, _MODEL_VIEWS))
        sources = (
            *(Source("cad", per_cad, path=path) for path in self.cads),
            *(Source("model", per_model, model=name) for name in model_names()),
            *(Source("generated", self.views, seed=seed) for seed in range(self.generated)),
        )
        return Collection(sources, self.backgrounds, self.seed + 1)

    @property
    def kept(self) -> Collection:
        """What is kept aside; the same for every seed, so that figures of several trainings compare."""
        first = FIRST_KEPT_SEED
        sources = (
            *(Source("cad", _KEPT_CAD_VIEWS, path=path) for path in self.kept_cads),
            *(
                Source("generated", _KEPT_VIEWS, seed=first + number)
                for number in range(max(1, self.generated // _CRAFT_PER_KEPT))
            ),
        )
        return Collection(sources, max(1, self.backgrounds // _BACKGROUNDS_PER_KEPT), first)

    @property
    def sample_seed(self) -> int:
        """Of the composition of training samples."""
        return self.seed + 11

    @property
    def kept_samples(self) -> int:
        """Samples that calibration and figures are computed from."""
        return min(max(self.steps, _MIN_KEPT_SAMPLES), _MAX_KEPT_SAMPLES)
