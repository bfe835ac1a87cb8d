"""Which rays a silhouette needs, against the definition by windows."""

import cv2
import numpy as np
import pytest

from hat_ros.target.silhouette import spread_grid


@pytest.mark.parametrize("seed", range(5))
def test_outline_pixels_are_those_of_blocks_next_to_the_other_side(seed):
    rng = np.random.default_rng(seed)
    rows, cols = 9, 13
    hit = cv2.GaussianBlur(rng.random((rows, cols)), (0, 0), 1.5) > 0.5
    face = np.where(hit, rng.integers(0, 100, hit.shape), -1).astype(np.int32).ravel()
    mask, depth, x, y = spread_grid(face, np.arange(face.size, dtype=np.float32), 2 * cols, 2 * rows)
    np.testing.assert_array_equal(mask, np.kron(hit, np.ones((2, 2), bool)))
    np.testing.assert_array_equal(depth[::2, ::2].ravel(), np.arange(face.size))
    around = np.pad(hit, 1)  # beyond the crop nothing is hit
    windows = np.lib.stride_tricks.sliding_window_view(around, (3, 3))
    inner = np.lib.stride_tricks.sliding_window_view(np.pad(hit, 1, mode="edge"), (3, 3))
    mixed = inner.any(axis=(2, 3)) & ~windows.all(axis=(2, 3))
    expected = np.kron(mixed, np.array([[0, 1], [1, 1]], bool))
    asked = np.zeros_like(expected)
    asked[y, x] = True
    np.testing.assert_array_equal(asked, expected)
    assert len(x) == expected.sum(), "no pixel twice"
