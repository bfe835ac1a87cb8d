"""Stage 1: where the target is in the image. One file per backend, chosen by ``segmentation.backend``."""
