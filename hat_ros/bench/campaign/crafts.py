"""The spacecraft of a campaign: CAD files and generated ones, by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from hat_ros.bench.synth.craft import generated_craft, generated_scene
from hat_ros.errors import UsageError
from hat_ros.target.loading import ModelFile, find_model, load_target
from hat_ros.target.model import Target

# Seeds of generated craft begin here, far from those that anything is trained on.
FIRST_SEED = 1_000_000


@dataclass(frozen=True)
class Craft:
    """A spacecraft by name.

    Attributes:
        name: in tables, unique within a campaign.
        path: its CAD file, None = generated.
        seed: of a generated one.
    """

    name: str
    path: Path | None = None
    seed: int = 0

    def load(self) -> Target:
        """The model, kept for the next clip of the same craft.

        Raises:
            MeshError: the CAD file cannot be used.
        """
        return _loaded(self)

    def sha256(self) -> str:
        """Digest of its model; of a generated craft its seed, since the digest of the code goes with it."""
        return f"generated {self.seed}" if self.path is None else self.load().sha256

    def model_file(self, folder: Path) -> ModelFile:
        """Its CAD file; that of a generated craft is written into a folder."""
        if self.path is not None:
            return find_model(self.path)
        path = folder / f"{self.name}.glb"
        if not path.exists():
            path.write_bytes(generated_scene(self.seed).export(file_type="glb"))
        return ModelFile(path, 1.0, self.name)


def crafts_named(paths: Sequence[Path], generated: int) -> list[Craft]:
    """The craft of a campaign, CAD files first.

    Args:
        paths: CAD files; two of the same name are told apart by number.
        generated: how many are generated beside them.

    Raises:
        UsageError: there is none at all.
        MeshError: a CAD file does not exist or cannot be used.
    """
    crafts: list[Craft] = []
    for path in paths:
        name = find_model(path).name
        same = sum(craft.name == name or craft.name.startswith(f"{name}-") for craft in crafts)
        craft = Craft(f"{name}-{same + 1}" if same else name, path.resolve())
        craft.load()
        crafts.append(craft)
    crafts += [Craft(f"generated-{number}", None, FIRST_SEED + number) for number in range(generated)]
    if not crafts:
        raise UsageError("campaign: no craft: name CAD files or ask for --generated ones")
    return crafts


@lru_cache(maxsize=64)
def _loaded(craft: Craft) -> Target:
    return generated_craft(craft.seed) if craft.path is None else load_target(craft.path)
