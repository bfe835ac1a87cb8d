import numpy as np
import pytest

from hat_ros.refinement.solver import edge_offset


@pytest.mark.parametrize("position", [20.0, 20.3, 21.7])
@pytest.mark.parametrize("levels", [(200, 0), (90, 160)])
def test_an_edge_is_found_at_its_half_level(position, levels):
    inside, outside = levels
    x = np.arange(40)
    share = np.clip(position + 0.5 - x, 0, 1)  # of pixel x covered by the target on the left
    row = np.rint(inside * share + outside * (1 - share)).astype(np.uint8)
    image = np.repeat(np.repeat(row[None, :, None], 20, axis=0), 3, axis=2)
    offset, quality = edge_offset(image, 20.0, 10.0, 1.0, 0.0, 6.0, 6.0, 0.75, np.empty((64, 3)), np.empty(64))
    assert offset == pytest.approx(position - 20.0, abs=0.2)
    assert quality > 0.7


def test_an_even_image_has_no_edge():
    image = np.full((20, 40, 3), 77, np.uint8)
    _, quality = edge_offset(image, 20.0, 10.0, 1.0, 0.0, 4.0, 4.0, 0.5, np.empty((64, 3)), np.empty(64))
    assert quality == 0.0
