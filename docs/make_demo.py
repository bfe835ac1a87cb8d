"""The moving picture of the README, from the overlay of a run: ``python docs/make_demo.py out/demo/overlay.mp4``."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
from PIL import Image

SIZE, EVERY, MS_PER_FRAME, QUALITY = (560, 420), 3, 100, 60


def main(video: str) -> None:
    """Write ``docs/demo.webp``: every third frame, reduced."""
    capture, pictures = cv2.VideoCapture(video), []
    while True:
        found, image = capture.read()
        if not found:
            break
        small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
        pictures.append(Image.fromarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB)))
    first, *others = pictures[::EVERY]
    out = Path(__file__).with_name("demo.webp")
    first.save(out, save_all=True, append_images=others, duration=MS_PER_FRAME, loop=0, quality=QUALITY, method=6)


if __name__ == "__main__":
    main(sys.argv[1])
