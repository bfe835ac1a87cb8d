"""Damaged JPEGs: what a decoder complains of is refused, what cameras send is not."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from decoder_words import words_on_stderr
from PIL import Image

from hat_ros.errors import FrameError
from hat_ros.io.compressed import check_pixels, decode_compressed
from hat_ros.io.jpeg import check_jpeg, jpeg_size
from hat_ros.io.value_range import ValueRange

SOS, EOI = b"\xff\xda", b"\xff\xd9"
N_DAMAGED = 200


def picture(height=120, width=168):
    """A bright craft with edges before a black sky, and noise on it: (H, W, 3) uint8."""
    rng = np.random.default_rng(5)
    out = np.zeros((height, width, 3), np.uint8)
    out[height // 4 : height * 3 // 4, width // 3 : width * 2 // 3] = (200, 150, 90)
    out[height // 3 : height // 2, width // 2 :] = (30, 60, 200)
    noise = rng.normal(0, 6, out.shape) * (out > 0)
    return np.clip(out + noise, 0, 255).astype(np.uint8)


def encoded(image=None, *options):
    return cv2.imencode(".jpg", picture() if image is None else image, options)[1].tobytes()


def parts(data):
    """Marker segments before the scan, the scan's header, its coded pixels."""
    at, segments = 2, []
    while True:
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at : at + 2] == SOS:
            return segments, data[at:end], data[end:-2]
        segments.append(data[at:end])
        at = end


def damaged(data, rng):
    """Bits turned, bytes left out, put in or written over, behind the header; half the time one bit."""
    begin = data.index(SOS) + 12
    out = bytearray(data)
    at = int(rng.integers(begin, len(out) - 2))
    kind = rng.integers(6)
    if kind < 3:
        out[at] ^= 1 << int(rng.integers(8))
    elif kind == 3:
        del out[at : at + int(rng.choice((1, 4, 64)))]
    elif kind == 4:
        out[at:at] = rng.integers(0, 256, int(rng.choice((1, 4, 64))), np.uint8).tobytes()
    else:
        out[at : at + 4] = rng.integers(0, 256, 4, np.uint8).tobytes()
    return bytes(out)


SAMPLINGS = [
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_411,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_440,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]


@pytest.mark.parametrize("size", [(120, 168), (1, 1), (8, 8), (17, 9), (101, 77)])
def test_whole_files_pass(size):
    image = picture(*size)
    for quality in (1, 30, 95, 100):
        for sampling in SAMPLINGS:
            for interval in (0, 1, 3):
                check_jpeg(
                    encoded(
                        image,
                        *(cv2.IMWRITE_JPEG_QUALITY, quality),
                        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling),
                        *(cv2.IMWRITE_JPEG_RST_INTERVAL, interval),
                        *(cv2.IMWRITE_JPEG_OPTIMIZE, int(interval == 1)),
                    )
                )
        check_jpeg(encoded(image[..., 0], cv2.IMWRITE_JPEG_QUALITY, quality))
    assert jpeg_size(encoded(image)) == (size[1], size[0])


@pytest.mark.parametrize("mode", ["L", "RGB", "CMYK", "YCbCr"])
@pytest.mark.parametrize("progressive", [False, True])
def test_whole_files_of_another_encoder_pass(mode, progressive):
    stream = io.BytesIO()
    Image.fromarray(picture()).convert(mode).save(stream, "jpeg", quality=90, progressive=progressive, exif=b"a" * 99)
    check_jpeg(stream.getvalue())


def test_extreme_levels_pass():
    """Blocks of nothing but black, white and both in turn: the largest steps and levels there are."""
    board = np.kron(np.indices((6, 6)).sum(0) % 2, np.ones((8, 8))).astype(np.uint8) * 255
    stripes = (np.indices((48, 48)).sum(0) % 2).astype(np.uint8) * 255
    for image in (np.zeros((48, 48), np.uint8), np.full((48, 48), 255, np.uint8), board, stripes):
        for quality in (1, 50, 100):
            check_jpeg(encoded(image, cv2.IMWRITE_JPEG_QUALITY, quality))


def without_tables(data):
    segments, header, pixels = parts(data)
    return b"\xff\xd8" + b"".join(part for part in segments if part[1] != 0xC4) + header + pixels + EOI


def one_scan_for_each_component(_data):
    """Three grey images as the components of one."""
    grey = [parts(encoded(np.ascontiguousarray(picture()[..., channel]))) for channel in range(3)]
    frame = b"".join(bytes((name, 0x11, 0)) for name in (1, 2, 3))
    segments = [part for part in grey[0][0] if part[1] != 0xC0]
    (size,) = (part[5:9] for part in grey[0][0] if part[1] == 0xC0)
    out = b"\xff\xd8" + b"".join(segments) + b"\xff\xc0" + (17).to_bytes(2, "big") + b"\x08" + size + b"\x03" + frame
    for name, (_, _, pixels) in enumerate(grey, 1):
        out += SOS + (8).to_bytes(2, "big") + bytes((1, name, 0, 0, 63, 0)) + pixels
    return out + EOI


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(without_tables, id="the standard's tables left out, as in MJPEG"),
        pytest.param(one_scan_for_each_component, id="one scan for each component"),
        pytest.param(lambda data: data[:-2] + b"\x11\x22\x33" + EOI, id="bytes before the end"),
        pytest.param(lambda data: data[:-2] + b"\xff\xff" + EOI, id="fill bytes before the end"),
        pytest.param(lambda data: data[:-2], id="no end"),
        pytest.param(lambda data: data + bytes(range(256)), id="bytes after the end"),
        pytest.param(lambda data: data[:20] + b"\x00" + data[20:], id="a byte between segments"),
        pytest.param(
            lambda data: data[:2] + b"\xff\xe1\x00\x0aExif\xff\xd8\xff\xd9" + data[2:], id="markers in what is skipped"
        ),
    ],
)
def test_what_cameras_send_is_read(change):
    data = change(encoded())
    image, _ = decode_compressed(data, ValueRange())
    assert image.shape == picture().shape
    if change is not one_scan_for_each_component:
        assert np.array_equal(image, decode_compressed(encoded(), ValueRange())[0])


def test_bytes_before_restart_markers_are_read():
    """Some cameras put a few before each: libjpeg calls them extraneous, the picture is whole."""
    data = encoded(None, cv2.IMWRITE_JPEG_RST_INTERVAL, 5)
    _, _, pixels = parts(data)
    changed, n_ends = pixels, 0
    for number in range(8):
        marker = bytes((0xFF, 0xD0 + number))
        n_ends += pixels.count(marker)
        changed = changed.replace(marker, b"\x00\x00" + marker) if number % 2 else changed
    assert n_ends > 8
    ends_in_ones_or_whole_bytes = data.replace(pixels, pixels.replace(b"\xff\xd0", b"\xff\xff\xd0"))
    check_jpeg(ends_in_ones_or_whole_bytes)
    check_jpeg(data.replace(pixels, changed))


@pytest.mark.parametrize("options", [(), (cv2.IMWRITE_JPEG_RST_INTERVAL, 8), (cv2.IMWRITE_JPEG_OPTIMIZE, 1)])
def test_what_the_decoder_complains_of_is_refused(options):
    """Of damage that libjpeg warns of nothing passes, but bytes that might be a camera's; of the rest, most."""
    rng = np.random.default_rng(1)
    data = encoded(None, *options)
    whole = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    n_changed = n_passed = 0
    for _ in range(N_DAMAGED):
        bad = damaged(data, rng)
        with words_on_stderr() as said:
            image = cv2.imdecode(np.frombuffer(bad, np.uint8), cv2.IMREAD_COLOR)
        try:
            check_jpeg(bad)
        except FrameError:
            n_changed += 1
            continue
        assert not said[0] or "extraneous" in said[0], "libjpeg warned"
        if image.shape != whole.shape or np.sqrt(np.mean((image.astype(float) - whole) ** 2)) > 3:
            n_changed += 1
            n_passed += 1
    assert n_changed > 0.6 * N_DAMAGED
    assert n_passed < 0.15 * n_changed


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda data: data[: len(data) // 2], "not what an encoder writes"),
        (lambda data: data[:-300] + EOI, "not what an encoder writes"),
        (lambda data: data.replace(b"\xff\xc4", b"\xff\xe4").replace(SOS, b"\xff\xe5"), "damaged JPEG"),
        (lambda data: data[:2] + data[data.index(SOS) :], "damaged JPEG"),
        (lambda data: data.replace(b"\xff\xc4\x00\x1f", b"\xff\xc4\x00\x1d"), "damaged JPEG"),
        (lambda data: data.replace(b"\xff\xc4\x00\x1f\x00\x00", b"\xff\xc4\x00\x1f\x00\x09"), "damaged JPEG"),
        (lambda data: data.replace(b"\x00\x0c\x03\x01\x00", b"\x00\x0c\x03\x01\x44"), "damaged JPEG"),
        (lambda data: data.replace(b"\x00\x0c\x03\x01", b"\x00\x0c\x03\x07"), "damaged JPEG"),
    ],
)
def test_broken_structure_is_refused(change, complaint):
    data = encoded()
    bad = change(data)
    assert bad != data
    with pytest.raises(FrameError, match=complaint):
        check_jpeg(bad)


def test_damage_in_a_compressed_tiff_is_refused_where_the_decoder_goes_on():
    rng = np.random.default_rng(2)
    n_refused = 0
    for compression in (5, 8):  # LZW, deflate
        data = cv2.imencode(".tiff", picture(), [cv2.IMWRITE_TIFF_COMPRESSION, compression])[1].tobytes()
        check_pixels(data)
        for _ in range(40):
            bad = bytearray(data)
            bad[int(rng.integers(200, len(bad) // 2))] ^= 1 << int(rng.integers(8))
            with words_on_stderr() as said:
                image = cv2.imdecode(np.frombuffer(bytes(bad), np.uint8), cv2.IMREAD_COLOR)
            if image is not None and said[0]:
                with words_on_stderr(), pytest.raises(FrameError, match="damaged TIFF"):
                    check_pixels(bytes(bad))
                n_refused += 1
    assert n_refused > 20


def test_every_kind_of_tiff_that_was_read_is_read():
    image = picture()
    for pixels in (image, image[..., 0], image.astype(np.uint16) * 200, image[..., 0].astype(np.uint16) * 200):
        for compression in (1, 5, 8, 32773):
            data = cv2.imencode(".tiff", pixels, [cv2.IMWRITE_TIFF_COMPRESSION, compression])[1].tobytes()
            assert decode_compressed(data, ValueRange())[0].shape == image.shape
