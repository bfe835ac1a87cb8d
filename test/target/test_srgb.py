import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hat_ros.target.srgb import linear_from_srgb, srgb_from_linear


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 255))
def test_srgb_round_trip(value):
    assert srgb_from_linear(linear_from_srgb(np.uint8(value))) == value
