"""Which topics of a recording are the camera: its image and its calibration."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping

from hat_ros.errors import BagError
from hat_ros.io import topics
from hat_ros.io.bag_files import Topic

IMAGE_KIND = "sensor_msgs/msg/Image"
COMPRESSED_KIND = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO_KIND = "sensor_msgs/msg/CameraInfo"

_COMPRESSED = "/compressed"
_DEPTH_NAME = re.compile("depth", re.IGNORECASE)
_DEPTH_ENCODINGS = ("16UC1", "32FC1")


def choose_image(found: Mapping[str, Topic], given: str | None, encoding_of: Callable[[str], str]) -> str:
    """The topic of the images.

    ``/image`` or ``/image/compressed`` if the recording has it, else the only one that is no depth image; of an image
    and its compressed copy the image. Masks (``/detection/mask``) are no camera's images.

    Args:
        found: the topics of the recording.
        given: the one asked for; None = find it.
        encoding_of: tells the encoding of the first message of an Image topic.

    Raises:
        BagError: there is none, or several; the sentence lists them.
    """
    every = [name for name in _of_kinds(found, IMAGE_KIND, COMPRESSED_KIND) if name != topics.DETECTION_MASK]
    names = [name for name in every if found[name].count] or every
    if given is not None:
        return _given("image", given, every, _cameras(found, names, encoding_of))
    for usual in (topics.IMAGE, topics.IMAGE_COMPRESSED):
        if usual in names:
            return usual
    if not names:
        raise BagError(
            f"has no image topic (Image or CompressedImage), topics are: {', '.join(sorted(found)) or 'none'}"
        )
    cameras = _cameras(found, names, encoding_of)
    if len(cameras) > 1:
        raise BagError(f"has several image topics, choose one by --image-topic: {', '.join(cameras)}")
    return cameras[0]


def choose_camera_info(found: Mapping[str, Topic], given: str | None, image: str) -> str:
    """The topic of the calibration: that in the image's own namespace or the nearest above it, else the only one.

    Args:
        found: the topics of the recording.
        given: the one asked for; None = find it.
        image: the topic of the images.

    Raises:
        BagError: there is none, or none that belongs to the image for certain; the sentence lists them.
    """
    every = _of_kinds(found, CAMERA_INFO_KIND)
    if given is not None:
        return _given("camera_info", given, every, every)
    if not every:
        raise BagError(f"has no camera_info topic (CameraInfo), topics are: {', '.join(sorted(found)) or 'none'}")
    names = [name for name in every if found[name].count] or every
    space = _namespace(image)
    while True:
        if f"{space}/camera_info" in names:
            return f"{space}/camera_info"
        if not space:
            break
        space = _namespace(space)
    others = {_namespace(name) for name in _of_kinds(found, IMAGE_KIND, COMPRESSED_KIND)} - {_namespace(image)}
    free = [name for name in names if _namespace(name) not in others]
    own = [name for name in names if _namespace(name) == _namespace(image)] or free
    if len(own) == 1:
        return own[0]
    raise BagError(
        f"does not tell which camera_info belongs to {image}, choose one by --camera-info-topic: {', '.join(names)}"
    )


def _of_kinds(found: Mapping[str, Topic], *kinds: str) -> list[str]:
    return sorted(name for name, topic in found.items() if topic.kind in kinds)


def _given(what: str, given: str, names: Collection[str], offered: Collection[str]) -> str:
    for name in (given, f"/{given}"):
        if name in names:
            return name
    raise BagError(f"has no {what} topic '{given}', it has: {', '.join(offered) or 'none'}")


def _cameras(found: Mapping[str, Topic], names: Collection[str], encoding_of: Callable[[str], str]) -> list[str]:
    """Of several topics those that are a camera's images: no compressed copies, no depth."""
    cameras = _without_copies(names)
    if len(cameras) > 1:
        cameras = [name for name in cameras if not _DEPTH_NAME.search(name)] or cameras
    if len(cameras) > 1:
        raw = {name: encoding_of(name) for name in cameras if found[name].kind == IMAGE_KIND}
        cameras = [name for name in cameras if raw.get(name) not in _DEPTH_ENCODINGS] or cameras
    return cameras


def _without_copies(names: Collection[str]) -> list[str]:
    """The topics less the compressed copies of others."""
    return [name for name in names if name.removesuffix(_COMPRESSED) == name or _base(name) not in names]


def _base(name: str) -> str:
    return name.removesuffix(_COMPRESSED)


def _namespace(name: str) -> str:
    return _base(name).rpartition("/")[0]
