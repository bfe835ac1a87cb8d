"""Two campaigns over the same clips, before and after: what was won, what was lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.campaign.intervals import bootstrap
from hat_ros.bench.campaign.report import described, strata, summary
from hat_ros.bench.campaign.run import Result
from hat_ros.bench.evaluation.tables import Column, Table
from hat_ros.errors import UsageError


@dataclass(frozen=True)
class Comparison:
    """What changed from one campaign to another.

    Attributes:
        table: by stratum.
        won: clips found only after, described.
        lost: clips found only before, described.
        alone: how many clips only one of the campaigns has; they are left out.
    """

    table: Table
    won: tuple[str, ...]
    lost: tuple[str, ...]
    alone: int

    def text(self) -> str:
        """For people."""
        lines = [self.table.text()]
        for title, names in (("won", self.won), ("lost", self.lost)):
            lines += [f"{title}: {len(names)}", *(f"  {name}" for name in names)]
        if self.alone:
            lines.append(f"{self.alone} clips that only one of the campaigns has are left out")
        return "\n".join(lines) + "\n"


def compare(before: Sequence[Result], after: Sequence[Result]) -> Comparison:
    """Compare the clips that both campaigns have.

    Raises:
        UsageError: there are none, or a clip of one number shows different things.
    """
    earlier = {result.index: result for result in before}
    pairs = {result.index: (earlier[result.index], result) for result in after if result.index in earlier}
    if not pairs:
        raise UsageError("campaign: the two campaigns have no clip in common")
    for index, (a, b) in pairs.items():
        if (a.factors, a.cell) != (b.factors, b.cell):
            raise UsageError(
                f"campaign: clip {index} is not the same in both campaigns: compare campaigns of the same craft, "
                f"--seed, --frames and --map"
            )
    rows = []
    for factor, name, members in strata([a for a, _ in pairs.values()]):
        chosen = [pairs[result.index] for result in members]
        rows.append({"factor": factor, "stratum": name} | _difference([a for a, _ in chosen], [b for _, b in chosen]))
    won, lost = (
        tuple(described(a) for a, b in pairs.values() if b.figures["found"] is wanted and a.figures["found"] != wanted)
        for wanted in (True, False)
    )
    alone = len(earlier) + len(after) - 2 * len(pairs)
    return Comparison(Table("campaign: before and after", _COLUMNS, rows), won, lost, alone)


_COLUMNS = (
    Column("factor", "factor"),
    Column("stratum", "stratum"),
    Column("clips", "clips", "d"),
    Column("found_before", "found before", ".0%"),
    Column("found_after", "after", ".0%"),
    Column("gain", "change", "+.0%"),
    Column("gain_low", "low", "+.0%"),
    Column("gain_high", "high", "+.0%"),
    Column("won", "won", "d"),
    Column("lost", "lost", "d"),
    Column("tracking_wrong_before", "TRACKING wrong before", ".1%"),
    Column("tracking_wrong_after", "after", ".1%"),
    Column("right_tracking_before", "right TRACKING before", ".0%"),
    Column("right_tracking_after", "after", ".0%"),
    Column("mask_iou_before", "IoU before", ".3f"),
    Column("mask_iou_after", "after", ".3f"),
    Column("first_right_before", "frames to right before", ".0f"),
    Column("first_right_after", "after", ".0f"),
)


def _difference(before: Sequence[Result], after: Sequence[Result]) -> dict[str, Any]:
    """Figures of the same clips in both campaigns; the change of the share found with its 95 % interval."""
    a, b = summary(before), summary(after)
    found = np.array([[bool(r.figures["found"]) for r in side] for side in (before, after)], dtype=np.float64)
    low, high = bootstrap(found[1] - found[0], _mean)
    row: dict[str, Any] = {"clips": len(before), "gain": b["found"] - a["found"], "gain_low": low, "gain_high": high}
    row |= {"won": int(np.sum(found[1] > found[0])), "lost": int(np.sum(found[1] < found[0]))}
    for key in ("found", "tracking_wrong", "right_tracking", "mask_iou", "first_right"):
        row |= {f"{key}_before": a[key], f"{key}_after": b[key]}
    return row


def _mean(samples: Float) -> Float:
    return np.asarray(samples.mean(axis=1))
