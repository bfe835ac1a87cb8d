"""Results of a campaign, made up: what came of each clip is told."""

import json
from dataclasses import asdict, replace

from hat_ros.bench.campaign.draw import draw_clip
from hat_ros.bench.campaign.map import map_cells
from hat_ros.bench.campaign.run import Result
from hat_ros.bench.campaign.score import figures_of_failure

CRAFTS = ("probe", "observer")


def result(index, found=False, on_map=False, crafts=CRAFTS, **figures):
    cell = map_cells()[index % len(map_cells())] if on_map else None
    clip = draw_clip(1, index, crafts, cell=cell)
    diameter_m = 3.0
    factors = clip.factors() | {"range_first_m": clip.spec(diameter_m).range_m[0]}
    place = None if cell is None else json.loads(json.dumps(asdict(cell)))
    base = figures_of_failure(50) | {"found": found, "E_p_mean": 0.01 if found else 0.9, "coverage": 1.0}
    base |= {"first_right": 3.0} if found else {}
    series = {"segmentation_ms": [float(index)] * 2, "frame_ms": [20.0] * 2}
    return Result(index, factors, place, base | figures, series)


def failed(index, sentence):
    return replace(result(index), failure=sentence, series={})
