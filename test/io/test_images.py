"""ROS image encodings: the same picture comes out of every one of them, and nonsense is refused."""

from __future__ import annotations

import array

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
    assert np.array_equal(images.decode_image(message(encoding, pixels))[0], picture())


def test_grey_encodings_agree():
    grey = picture()[..., 0]
    expected = np.dstack([grey] * 3)
    assert np.array_equal(images.decode_image(message("mono8", grey))[0], expected)
    wide = np.stack([np.full_like(grey, 77), grey], axis=-1)  # little-endian 16 bit: low byte first
    sixteen = message("mono16", wide)
    assert np.array_equal(images.decode_image(sixteen)[0], expected)
    swapped = message("mono16", wide[..., ::-1])
    swapped.is_bigendian = 1
    assert np.array_equal(images.decode_image(swapped)[0], expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_reconstruct_flat_colours(pattern):
    rgb = {"r": 200, "g": 120, "b": 40}
    tile = np.array([[rgb[pattern[0]], rgb[pattern[1]]], [rgb[pattern[2]], rgb[pattern[3]]]], dtype=np.uint8)
    mosaic = np.tile(tile, (8, 8))
    found = images.decode_image(message(f"bayer_{pattern}8", mosaic))[0]
    assert found[8, 8].tolist() == [200, 120, 40]


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_wide_encodings_are_the_narrow_ones_in_more_bits(pattern, bits):
    # The brightest value is in the picture, so that the depth can be found; the low bits are noise.
    rgb = picture()
    rgb[0, 0] = 255
    alpha = np.full((*rgb.shape[:2], 1), 200, np.uint8)
    rgba = np.concatenate([rgb, alpha], axis=-1)
    same = {
        "mono": rgb[..., :1],
        "rgb": rgb,
        "bgr": rgb[..., ::-1],
        "rgba": rgba,
        "bgra": rgba[..., [2, 1, 0, 3]],
        f"bayer_{pattern}": rgb[..., :1],
    }
    noise = np.random.default_rng(0)
    for name, pixels in same.items():
        expected = images.decode_image(message(f"{name}8", pixels))[0]
        wide = pixels.astype(np.uint16) << (bits - 8)
        wide += noise.integers(0, 1 << (bits - 8), wide.shape, dtype=np.uint16)
        for order, big in (("<u2", 0), (">u2", 1)):
            m = message(
                f"{name}16", np.ascontiguousarray(wide).astype(order).view(np.uint8).reshape(*wide.shape[:2], -1)
            )
            m.is_bigendian = big
            found, known = images.decode_image(m)
            assert known.bits == bits, name
            assert np.array_equal(found, expected), name


def yuv_of(rgb, full):
    """(H, W, 3) float Y, U, V as the recommendation BT.601 defines them."""
    red, green, blue = np.moveaxis(rgb.astype(float), -1, 0)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    colours = [(blue - luma) / 1.772, (red - luma) / 1.402]
    if full:
        return np.stack([luma, *(128 + c for c in colours)], axis=-1)
    return np.stack([16 + luma * 219 / 255, *(128 + c * 224 / 255 for c in colours)], axis=-1)


def blocks():
    """A picture whose blocks of 2 x 2 pixels have one colour, with black and white."""
    rgb = np.random.default_rng(1).integers(0, 256, (10, 12, 3), dtype=np.uint8)
    rgb[:3], rgb[3] = 0, 255
    return rgb.repeat(2, axis=0).repeat(2, axis=1)


def packed_yuv(encoding, yuv):
    luma_first = encoding in ("yuyv", "yuv422_yuy2")
    colour = np.where(np.arange(yuv.shape[1]) % 2, yuv[..., 2], yuv[..., 1])
    return np.dstack([yuv[..., 0], colour] if luma_first else [colour, yuv[..., 0]])


def planar_yuv(encoding, yuv):
    step = 1 if encoding == "nv24" else 2
    pairs = yuv[::step, ::step, 1:]
    return np.concatenate([yuv[..., 0].ravel(), (pairs[..., ::-1] if encoding == "nv21" else pairs).ravel()])


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21", "nv24"])
def test_yuv_of_either_range_gives_the_colours_back(encoding, full):
    yuv = np.rint(yuv_of(blocks(), full)).clip(0, 255).astype(np.uint8)
    if encoding.startswith("nv"):
        m = message(encoding, yuv[..., 0])
        m.data = array.array("B", planar_yuv(encoding, yuv).tobytes())
    else:
        m = message(encoding, packed_yuv(encoding, yuv))
    found, known = images.decode_image(m)
    assert known.full_luma is full
    assert np.abs(found.astype(int) - blocks()).max() <= 3


@pytest.mark.parametrize(
    ("encoding", "shape"), [("yuyv", (4, 5, 2)), ("nv12", (4, 6)), ("nv21", (5, 6)), ("nv24", (4, 6))]
)
def test_yuv_of_a_size_that_does_not_fit_is_refused(encoding, shape):
    with pytest.raises(FrameError, match=r"even width|in whole rows"):
        images.decode_image(message(encoding, np.zeros(shape, np.uint8)))


def test_row_padding_is_left_out():
    padded = np.zeros((20, 40, 3), dtype=np.uint8)
    padded[:, :30] = picture()
    m = message("rgb8", padded)
    m.width = 30
    assert np.array_equal(images.decode_image(m)[0], picture())


@pytest.mark.parametrize("extension", [".png", ".jpg"])
def test_compressed_images_decode(extension):
    data = cv2.imencode(extension, picture()[..., ::-1])[1].tobytes()
    found = images.decode_image(WIRE.compressed(10**9, "cam", extension[1:], data))[0]
    assert found.shape == (20, 30, 3)
    if extension == ".png":
        assert np.array_equal(found, picture())
    else:
        assert np.abs(found.astype(int) - picture()).mean() < 6


@pytest.mark.parametrize("extension", [".png", ".tiff"])
@pytest.mark.parametrize("bits", [10, 12, 16])
def test_compressed_images_of_16_bits_are_read_by_their_depth(extension, bits):
    rgb = picture()
    rgb[0, 0] = 255
    data = cv2.imencode(extension, rgb[..., ::-1].astype(np.uint16) << (bits - 8))[1].tobytes()
    found, known = images.decode_image(WIRE.compressed(10**9, "cam", extension[1:], data))
    assert known.bits == bits
    assert np.array_equal(found, rgb)


def test_webp_of_every_kind_and_tiff_decode():
    lossy = cv2.imencode(".webp", picture()[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 95])[1].tobytes()
    found = images.decode_image(WIRE.compressed(10**9, "cam", "webp", lossy))[0]
    assert np.abs(found.astype(int) - picture()).mean() < 6
    exact = cv2.imencode(".webp", picture()[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    with_alpha = np.dstack([picture()[..., ::-1], np.full((20, 30), 100, np.uint8)])
    extended = cv2.imencode(".webp", with_alpha, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    tiff = cv2.imencode(".tiff", picture()[..., ::-1])[1].tobytes()
    for data in (exact, tiff):
        assert np.array_equal(images.decode_image(WIRE.compressed(10**9, "cam", "x", data))[0], picture())
    assert images.decode_image(WIRE.compressed(10**9, "cam", "x", extended))[0].shape == (20, 30, 3)


def test_tiff_of_real_numbers_is_refused():
    data = cv2.imencode(".tiff", picture().astype(np.float32))[1].tobytes()
    with pytest.raises(FrameError, match="8 or 16 bits per value, found float32"):
        images.decode_image(WIRE.compressed(10**9, "cam", "tiff", data))


def with_size(data, width, height):
    """A PNG that claims another size."""
    return data[:16] + width.to_bytes(4, "big") + height.to_bytes(4, "big") + data[24:]


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "neither JPEG, PNG, WebP nor TIFF"),
        (b"GIF89a" + bytes(100), "neither JPEG, PNG, WebP nor TIFF"),
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
    for extension in (".png", ".jpg", ".webp", ".tiff"):
        data = cv2.imencode(extension, picture()[..., ::-1])[1].tobytes()
        for _ in range(60):
            bad = bytearray(data[: rng.integers(1, len(data))] if rng.random() < 0.4 else data)
            for at in rng.integers(0, len(bad), 3):
                bad[at] ^= 1 << rng.integers(8)
            try:
                found = images.decode_image(WIRE.compressed(10**9, "cam", "x", bytes(bad)))[0]
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
