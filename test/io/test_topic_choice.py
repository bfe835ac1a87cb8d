"""Of several topics the camera's own image and calibration are taken, or one sentence names the option."""

from __future__ import annotations

import pytest

from hat_ros.errors import BagError
from hat_ros.io.bag_files import Topic
from hat_ros.io.topic_choice import CAMERA_INFO_KIND, COMPRESSED_KIND, IMAGE_KIND, choose_camera_info, choose_image


def topics_of(images=(), compressed=(), infos=(), empty=()):
    kinds = {IMAGE_KIND: images, COMPRESSED_KIND: compressed, CAMERA_INFO_KIND: infos}
    return {name: Topic(name, kind, 0 if name in empty else 3) for kind, names in kinds.items() for name in names}


@pytest.mark.parametrize(
    ("images", "compressed", "chosen"),
    [
        (["/image", "/other"], [], "/image"),
        (["/c/color/image_raw", "/c/depth/image_rect_raw"], [], "/c/color/image_raw"),
        (["/c/color/image_raw", "/c/aligned"], [], "/c/color/image_raw"),  # by its encoding, 16UC1
        (["/c/image_raw"], ["/c/image_raw/compressed"], "/c/image_raw"),
        ([], ["/c/image_raw/compressed", "/c/image_raw/compressedDepth"], "/c/image_raw/compressed"),
        (["/c/image_raw"], ["/c/image_raw/compressed", "/d/depth/compressed"], "/c/image_raw"),
        (["/depth/image"], [], "/depth/image"),
        (["/c/image", "/detection/mask"], [], "/c/image"),
    ],
)
def test_one_camera_among_others_is_found(images, compressed, chosen):
    found = topics_of(images, compressed)
    assert choose_image(found, None, lambda name: "16UC1" if "aligned" in name else "rgb8") == chosen


def test_a_topic_without_messages_is_no_choice():
    found = topics_of(["/c/image_raw", "/d/image_raw"], ["/c/image_raw/compressed"], empty=["/d/image_raw"])
    assert choose_image(found, None, lambda _: "rgb8") == "/c/image_raw"
    found = topics_of(["/c/image_raw"], ["/c/image_raw/compressed"], empty=["/c/image_raw"])
    assert choose_image(found, None, lambda _: "rgb8") == "/c/image_raw/compressed"


def test_two_cameras_are_listed_and_the_option_is_named():
    found = topics_of(["/left/image_raw", "/right/image_raw"], infos=["/left/camera_info", "/right/camera_info"])
    with pytest.raises(BagError, match="choose one by --image-topic: /left/image_raw, /right/image_raw"):
        choose_image(found, None, lambda _: "rgb8")
    assert choose_image(found, "right/image_raw", lambda _: "rgb8") == "/right/image_raw"
    with pytest.raises(BagError, match="no image topic '/nope', it has: /left"):
        choose_image(found, "/nope", lambda _: "rgb8")


def test_only_images_of_cameras_are_offered():
    images = ["/c/color", "/c/aligned", "/c/depth", "/detection/mask"]
    found = topics_of(images, ["/c/color/compressed", "/d/color/compressed"])
    encodings = dict.fromkeys(images, "rgb8") | {"/c/aligned": "16UC1"}
    for wrong in ("/x", "/detection/mask"):
        with pytest.raises(BagError, match=f"no image topic '{wrong}', it has: /c/color, /d/color/compressed$"):
            choose_image(found, wrong, encodings.__getitem__)
    assert choose_image(found, "/c/aligned", encodings.__getitem__) == "/c/aligned", "whoever asks for it gets it"
    with pytest.raises(BagError, match="has no image topic"):
        choose_image(topics_of(["/detection/mask"]), None, encodings.__getitem__)


@pytest.mark.parametrize(
    ("image", "infos", "chosen"),
    [
        ("/c/color/image_raw", ["/c/color/camera_info", "/c/depth/camera_info"], "/c/color/camera_info"),
        ("/c/color/image_raw/compressed", ["/camera_info", "/c/color/camera_info"], "/c/color/camera_info"),
        ("/image/compressed", ["/camera_info", "/c/depth/camera_info"], "/camera_info"),
        ("/c/color/image_raw", ["/c/camera_info", "/d/camera_info"], "/c/camera_info"),
        ("/pictures", ["/calibration"], "/calibration"),
        ("/c/image", ["/c/info", "/d/info"], "/c/info"),
    ],
)
def test_the_calibration_is_that_of_the_images_namespace(image, infos, chosen):
    assert choose_camera_info(topics_of([image, "/d/image"], infos=infos), None, image) == chosen


def test_the_calibration_of_another_camera_is_not_taken():
    found = topics_of(["/color/image", "/depth/image"], infos=["/depth/camera_info"])
    with pytest.raises(BagError, match="choose one by --camera-info-topic: /depth/camera_info"):
        choose_camera_info(found, None, "/color/image")
    assert choose_camera_info(found, "/depth/camera_info", "/color/image") == "/depth/camera_info"
