"""ROS image encodings: the same picture comes out of every one of them, and nonsense is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hat_ros.errors import FrameError
from hat_ros.io import images, messages

WIRE = messages.Wire.ros()


def picture(height=20, width=30):
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 8, y * 12, 255 - x * 4], axis=-1).astype(np.uint8)


def message(encoding, pixels):
    return WIRE.image(10**9, "cam", encoding, pixels)


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", picture()),
        ("bgr8", picture()[..., ::-1]),
        ("8UC3", picture()[..., ::-1]),
        ("rgba8", np.dstack([picture(), np.full((20, 30), 9, np.uint8)])),
        ("bgra8", np.dstack([picture()[..., ::-1], np.full((20, 30), 9, np.uint8)])),
    ],
)
def test_colour_encodings_agree(encoding, pixels):
    assert np.array_equal(images.decode_image(message(encoding, pixels)), picture())


def test_grey_encodings_agree():
    grey = picture()[..., 0]
    expected = np.dstack([grey] * 3)
    assert np.array_equal(images.decode_image(message("mono8", grey)), expected)
    wide = np.stack([np.full_like(grey, 77), grey], axis=-1)  # little-endian 16 bit: low byte first
    sixteen = message("mono16", wide)
    assert np.array_equal(images.decode_image(sixteen), expected)
    swapped = message("mono16", wide[..., ::-1])
    swapped.is_bigendian = 1
    assert np.array_equal(images.decode_image(swapped), expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_reconstruct_flat_colours(pattern):
    rgb = {"r": 200, "g": 120, "b": 40}
    tile = np.array([[rgb[pattern[0]], rgb[pattern[1]]], [rgb[pattern[2]], rgb[pattern[3]]]], dtype=np.uint8)
    mosaic = np.tile(tile, (8, 8))
    found = images.decode_image(message(f"bayer_{pattern}8", mosaic))
    assert found[8, 8].tolist() == [200, 120, 40]


def test_row_padding_is_left_out():
    padded = np.zeros((20, 40, 3), dtype=np.uint8)
    padded[:, :30] = picture()
    m = message("rgb8", padded)
    m.width = 30
    assert np.array_equal(images.decode_image(m), picture())


@pytest.mark.parametrize("extension", [".png", ".jpg"])
def test_compressed_images_decode(extension):
    data = cv2.imencode(extension, picture()[..., ::-1])[1].tobytes()
    found = images.decode_image(WIRE.compressed(10**9, "cam", extension[1:], data))
    assert found.shape == (20, 30, 3)
    if extension == ".png":
        assert np.array_equal(found, picture())
    else:
        assert np.abs(found.astype(int) - picture()).mean() < 6


def with_size(data, width, height):
    """A PNG that claims another size."""
    return data[:16] + width.to_bytes(4, "big") + height.to_bytes(4, "big") + data[24:]


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "neither JPEG nor PNG"),
        (b"GIF89a" + bytes(100), "neither JPEG nor PNG"),
        (b"\x89PNG\r\n\x1a\n", "ends within its header"),
        (b"\xff\xd8\xff\xe0\x00\x10", "ends within its header"),
        (b"\xff\xd8\x00\x00", "damaged JPEG"),
        (with_size(cv2.imencode(".png", picture())[1].tobytes(), 100_000, 100_000), "1 to 8192 px"),
        (cv2.imencode(".png", picture())[1].tobytes()[:60], "cannot be decoded"),
    ],
)
def test_damaged_or_exploding_images_are_refused(data, complaint):
    with pytest.raises(FrameError, match=complaint):
        images.decode_image(WIRE.compressed(10**9, "cam", "png", data))


def test_every_truncation_and_bit_flip_ends_in_a_picture_or_a_frame_error():
    rng = np.random.default_rng(0)
    for extension in (".png", ".jpg"):
        data = cv2.imencode(extension, picture()[..., ::-1])[1].tobytes()
        for _ in range(60):
            bad = bytearray(data[: rng.integers(1, len(data))] if rng.random() < 0.4 else data)
            for at in rng.integers(0, len(bad), 3):
                bad[at] ^= 1 << rng.integers(8)
            try:
                found = images.decode_image(WIRE.compressed(10**9, "cam", "x", bytes(bad)))
            except FrameError:
                continue
            assert found.dtype == np.uint8
            assert found.ndim == 3


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"encoding": "32FC1"}, "encoding '32FC1' is not supported"),
        ({"encoding": ""}, "encoding '' is not supported"),
        ({"step": 10}, "step must be at least 90"),
        ({"height": 19}, "needs 1710, found 1800"),
        ({"height": 0}, "1 to 8192"),
        ({"width": 100_000}, "1 to 8192"),
    ],
)
def test_inconsistent_images_are_refused(change, complaint):
    m = message("rgb8", picture())
    for name, value in change.items():
        setattr(m, name, value)
    with pytest.raises(FrameError, match=complaint):
        images.decode_image(m)


def test_masks():
    mask = np.zeros((20, 30), dtype=np.uint8)
    mask[3:5] = 255
    assert np.array_equal(images.decode_mask(message("mono8", mask)), mask)
    assert images.decode_mask(message("mono8", np.zeros((0, 0), np.uint8))) is None
    mask[0, 0] = 3
    with pytest.raises(FrameError, match=r"0, 128 .* and 255"):
        images.decode_mask(message("mono8", mask))
    with pytest.raises(FrameError, match="must be mono8"):
        images.decode_mask(message("rgb8", picture()))
