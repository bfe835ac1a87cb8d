import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hat_ros.bench.datasets.detections import decode_rle, load_detections
from hat_ros.errors import DatasetError

SIZE = (12, 20)


def blob(seed=0):
    rng = np.random.default_rng(seed)
    return cv2.blur(rng.random(SIZE), (5, 5)) > 0.5


def runs(mask):
    """COCO run lengths of a mask, written from their definition: columns, background first."""
    flat = mask.T.ravel().astype(np.int8)
    changes = np.flatnonzero(np.diff(np.concatenate([[0], flat])))
    return np.diff(np.concatenate([[0], changes, [flat.size]])).tolist()


def compress(counts):
    """COCO's string form, written from its definition."""
    text = ""
    for i, value in enumerate(counts):
        value = value - counts[i - 2] if i > 2 else value
        more = True
        while more:
            digit = value & 31
            value >>= 5
            more = value != -1 if digit & 16 else value != 0
            text += chr((digit | 32 if more else digit) + 48)
    return text


def write(path, data):
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 5000), min_size=1, max_size=40))
def test_compressed_and_plain_run_lengths_mean_the_same(counts):
    size = [1, sum(counts)]
    if not 0 < size[1] <= 8192:
        return
    plain = decode_rle({"size": size, "counts": counts})
    packed = decode_rle({"size": size, "counts": compress(counts)})
    assert np.array_equal(plain, packed)


@pytest.mark.parametrize("seed", range(4))
def test_run_lengths_give_the_mask_back(seed):
    mask = blob(seed)
    assert np.array_equal(decode_rle({"size": list(SIZE), "counts": runs(mask)}) == 255, mask)


def test_a_string_as_the_mask_api_writes_it():
    # 3 x 3 with the middle pixel set: runs 4, 1, 4.
    assert compress([4, 1, 4]) == "414"
    assert decode_rle({"size": [3, 3], "counts": "414"})[1, 1] == 255


def test_bop_list_keeps_the_best_score_of_each_image(tmp_path):
    good, poor = blob(1), blob(2)
    items = [
        {
            "scene_id": 1,
            "image_id": 7,
            "score": s,
            "segmentation": {"size": list(SIZE), "counts": c},
            "bbox": [0, 0, 1, 1],
        }
        for s, c in ((0.2, runs(poor)), (0.9, compress(runs(good))), (0.5, runs(poor)))
    ]
    lookup = load_detections(write(tmp_path / "cnos.json", items))
    assert len(lookup) == 1
    for name in (7, "7", "000007.png"):
        assert np.array_equal(lookup.given_mask(name, SIZE) == 255, good)
    assert lookup.given_mask(8, SIZE) is None


def test_bop_list_with_boxes_only(tmp_path):
    path = write(tmp_path / "boxes.json", [{"image_id": "a.png", "score": 1, "bbox": [2.4, 3.0, 5.2, 4.0]}])
    mask = load_detections(path).given_mask("a.jpg", SIZE)
    assert (mask == 128).sum() == 4 * 6
    assert (mask[3:7, 2:8] == 128).all()


def test_box_mapping_is_clipped_to_the_image(tmp_path):
    mask = load_detections(write(tmp_path / "boxes.json", {"img1.jpg": [-5, -5, 4, 3]})).given_mask("img1.jpg", SIZE)
    assert (mask == 128).sum() == 12
    assert (mask[:3, :4] == 128).all()


def test_mask_folder_with_silhouettes_boxes_and_zero_one_masks(tmp_path):
    mask = blob(3)
    cv2.imwrite(str(tmp_path / "000001.png"), mask.astype(np.uint8) * 255)
    cv2.imwrite(str(tmp_path / "000002.png"), mask.astype(np.uint8))
    cv2.imwrite(str(tmp_path / "000003.png"), mask.astype(np.uint8) * 128)
    lookup = load_detections(tmp_path)
    assert np.array_equal(lookup.given_mask(1, SIZE), np.where(mask, 255, 0))
    assert np.array_equal(lookup.given_mask("000002.jpg", SIZE), np.where(mask, 255, 0))
    assert np.array_equal(lookup.given_mask(3, SIZE), np.where(mask, 128, 0))


def test_a_mask_of_another_size_is_an_error(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), blob().astype(np.uint8) * 255)
    with pytest.raises(DatasetError, match="20x12 but the image is 30x30"):
        load_detections(tmp_path).given_mask(1, (30, 30))


def rle(size, counts):
    return [{"image_id": 0, "score": 1.0, "segmentation": {"size": size, "counts": counts}}]


MALFORMED = {
    "not json": ("{", "not valid JSON"),
    "a number": (3, "expected a list"),
    "no image id": ([{"score": 1.0, "bbox": [0, 0, 1, 1]}], "image_id"),
    "image id of another type": ([{"image_id": 1.5, "bbox": [0, 0, 1, 1]}], "image_id"),
    "nan score": ([{"image_id": 1, "score": float("nan"), "bbox": [0, 0, 1, 1]}], "score"),
    "nothing detected": ([{"image_id": 1, "score": 1.0}], "neither"),
    "short box": ({"a": [1, 2, 3]}, "four finite numbers"),
    "box of text": ({"a": ["x", 1, 2, 3]}, "four finite numbers"),
    "infinite box": ({"a": [0, 0, float("inf"), 3]}, "four finite numbers"),
    "box of integers that no float holds": ({"a": [0, 0, 10**400, 3]}, "four finite numbers"),
    "box that overflows": ([{"image_id": 0, "bbox": [1e308, 0, 1e308, 3]}], "four finite numbers"),
    "score that no float holds": ([{"image_id": 1, "score": 10**400, "bbox": [0, 0, 1, 1]}], "score"),
    "empty box": ({"a": [5, 5, 5, 9]}, "empty"),
    "two boxes": ({"1.png": [0, 0, 2, 2], "01.jpg": [0, 0, 3, 3]}, "second box"),
    "runs too short": (rle([12, 20], [4, 4]), "add up to 8"),
    "negative run": (rle([12, 20], [250, -10]), "non-negative"),
    "absurd size": (rle([1 << 20, 1 << 20], [1 << 40]), "size"),
    "size of text": (rle("big", [1]), "size"),
    "bad character": (rle([12, 20], "4\n4"), "invalid character"),
    "cut string": (rle([12, 20], "4P"), "middle of a number"),
    "bomb": (rle([12, 20], "o" * 200), "invalid character"),
    "no counts": ([{"image_id": 0, "segmentation": {"size": [2, 2]}}], "counts"),
    "polygon": ([{"image_id": 0, "segmentation": [[1, 2, 3]]}], "run lengths"),
}


@pytest.mark.parametrize(("data", "message"), MALFORMED.values(), ids=MALFORMED.keys())
def test_malformed_files_are_named_and_explained(tmp_path, data, message):
    path = tmp_path / "detections.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")
    with pytest.raises(DatasetError, match=message) as caught:
        load_detections(path).given_mask(0 if isinstance(data, list) else "a", SIZE)
    assert "detections.json" in str(caught.value)


def test_missing_and_empty_places(tmp_path):
    with pytest.raises(DatasetError, match="no such"):
        load_detections(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="no mask images"):
        load_detections(tmp_path)
    (tmp_path / "1.png").write_bytes(b"not a picture")
    with pytest.raises(DatasetError, match="not a readable image"):
        load_detections(tmp_path).given_mask(1, SIZE)


def test_two_masks_for_one_frame(tmp_path):
    for name in ("1.png", "001.png"):
        cv2.imwrite(str(tmp_path / name), blob().astype(np.uint8) * 255)
    with pytest.raises(DatasetError, match="two masks"):
        load_detections(tmp_path)
