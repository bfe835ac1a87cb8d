import numpy as np
import pytest

from hat_ros.bench.synth.craft import generated_craft


@pytest.mark.parametrize("seed", range(12))
def test_a_craft_is_some_metres_long_and_has_faces(seed: int) -> None:
    craft = generated_craft(seed)
    assert 0.5 < craft.diameter_m < 15.0
    assert (craft.face_areas_m2 > 0).all()
    assert len(np.unique(craft.face_rgb, axis=0)) + len(craft.surface.textures) > 1


def test_the_seed_decides_the_craft() -> None:
    first, again, other = (generated_craft(seed) for seed in (5, 5, 6))
    assert first.sha256 == again.sha256 != other.sha256
    assert np.array_equal(first.vertices_m, again.vertices_m)
