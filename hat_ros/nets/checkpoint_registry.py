"""The public checkpoints that our networks can use: names, sources, licences, checksums, and how to read them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Checkpoint:
    """One public checkpoint.

    Attributes:
        name: what our commands and error messages call it.
        filename: path below the weights folder under which the public file is expected.
        source: where a person finds it.
        licence: licence of the code and, where it differs, of the weights.
        sha256: published checksum, lower case; empty when none is published.
        size: size as far as it is known, for people.
        container: key of the state dict inside the file; empty when the file is the state dict.
        renames: (old prefix, new prefix) applied to every tensor name, the first that fits.
        cut_rows: tensors stored with more rows (first axis) than the network uses -> rows to keep.
        companions: (filename, sha256) of small files that belong beside it.
        library_folder: a folder in the layout of the `transformers` library instead of one file.
    """

    name: str
    filename: str
    source: str
    licence: str
    sha256: str = ""
    size: str = "unknown"
    container: str = ""
    renames: tuple[tuple[str, str], ...] = ()
    cut_rows: tuple[tuple[str, int], ...] = ()
    companions: tuple[tuple[str, str], ...] = ()
    library_folder: bool = False

    @property
    def converted_filename(self) -> str:
        """Name of the safetensors file that :func:`hat_ros.nets.checkpoint.convert` writes."""
        return f"{self.name}.safetensors"


_MEGAPOSE_RENAMES = (("backbone.backbone.", "backbone."), ("backbone.head.0.", "views_logits_head."))
_MEGAPOSE_SOURCE = "https://www.paris.inria.fr/archive_ylabbeprojectsdata/megapose/megapose-models/"

CHECKPOINTS: dict[str, Checkpoint] = {
    item.name: item
    for item in (
        Checkpoint(
            name="droid",
            filename="droid.pth",
            source="https://github.com/princeton-vl/DROID-SLAM (README, 'droid.pth')",
            licence="BSD-3-Clause code; the weights carry no licence of their own",
            sha256="46476ef64cde45a97504910d6f3de2eef7b398ec1c6e4e668815c29076024526",
            size="about 16 MB",
            renames=(("module.", ""),),
            cut_rows=(
                ("update.weight.2.weight", 2),
                ("update.weight.2.bias", 2),
                ("update.delta.2.weight", 2),
                ("update.delta.2.bias", 2),
            ),
        ),
        Checkpoint(
            name="megapose_coarse",
            filename="coarse-rgb-906902141/checkpoint.pth.tar",
            source=_MEGAPOSE_SOURCE + "coarse-rgb-906902141/",
            licence="Apache-2.0",
            sha256="30fa2ba97d1bb1b27f6443b6671f557baebf3dff93fcc8605a6c7924ead759a4",
            size="about 83 MB",
            container="state_dict",
            renames=_MEGAPOSE_RENAMES,
            companions=(
                (
                    "coarse-rgb-906902141/config.yaml",
                    "24de955519e9d65c82a237b29844576989504e956448ecae07b0e2f2b6675bd9",
                ),
            ),
        ),
        Checkpoint(
            name="megapose_refiner",
            filename="refiner-rgb-653307694/checkpoint.pth.tar",
            source=_MEGAPOSE_SOURCE + "refiner-rgb-653307694/",
            licence="Apache-2.0",
            sha256="52dd473fc719488e2f45a98aac2f83960ebe1534b2845cb292c0a287ba70adb7",
            size="about 83 MB",
            container="state_dict",
            renames=_MEGAPOSE_RENAMES,
            companions=(
                (
                    "refiner-rgb-653307694/config.yaml",
                    "29e02244d9b674fd5e374c9902b567cfe5ef4e2e2e3fef01dd1d6188df7b7d84",
                ),
            ),
        ),
        Checkpoint(
            name="picopose",
            filename="picopose.ckpt",
            source="https://github.com/foollh/PicoPose (README, trained model)",
            licence="MIT badge without a licence file; includes fine-tuned DINOv2 (Apache-2.0)",
            sha256="9d1173d3db55e690e468edde453b06d47402d7b993748e4d2fe8f34a203014c0",
            size="about 1.5 GB",
            container="state_dict",
            renames=(("network.", ""),),
        ),
        Checkpoint(
            name="gigapose",
            filename="gigaPose_v1.ckpt",
            source="https://huggingface.co/datasets/nv-nguyen/gigaPose (gigaPose_v1.ckpt)",
            licence="MIT",
            sha256="0f60a23b03ddc41d2135c916ed1e66fb16f814f612dbde0305ae5a2c0f45c932",
            size="about 3.6 GB",
            container="state_dict",
        ),
        Checkpoint(
            name="mask2former",
            filename="mask2former-swin-large-coco-instance",
            source="https://huggingface.co/facebook/mask2former-swin-large-coco-instance",
            licence="MIT code; weights CC BY-NC 4.0 (non-commercial)",
            size="about 866 MB",
            library_folder=True,
        ),
    )
}
