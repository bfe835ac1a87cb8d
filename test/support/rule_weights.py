"""A weights folder full of rule weights, so that the learned backends run end to end (their poses mean nothing)."""

from pathlib import Path

import torch
from safetensors.torch import save_file
from weight_rule import rule_state


def save_rule_weights(folder: Path, name: str, net: torch.nn.Module) -> None:
    """Write ``<name>.safetensors`` for a network."""
    folder.mkdir(parents=True, exist_ok=True)
    save_file({key: value.contiguous() for key, value in rule_state(net).items()}, str(folder / f"{name}.safetensors"))


def save_small_mask2former(folder: Path) -> None:
    """Write the folder of a Mask2Former with a few channels and random weights, as `transformers` would save it."""
    from transformers import (
        Mask2FormerConfig,
        Mask2FormerForUniversalSegmentation,
        Mask2FormerImageProcessorPil,
        SwinConfig,
    )

    torch.manual_seed(0)
    backbone = SwinConfig(
        embed_dim=12, depths=[1, 1, 1, 1], num_heads=[1, 1, 1, 1], window_size=4,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )  # fmt: skip
    network = Mask2FormerForUniversalSegmentation(
        Mask2FormerConfig(
            backbone_config=backbone,
            hidden_dim=32,
            feature_size=32,
            mask_feature_size=32,
            encoder_layers=1,
            decoder_layers=2,
            num_attention_heads=2,
            encoder_feedforward_dim=32,
            dim_feedforward=32,
            num_queries=5,
            num_labels=3,
        )
    )
    path = folder / "mask2former-swin-large-coco-instance"
    network.save_pretrained(path)
    Mask2FormerImageProcessorPil(size={"shortest_edge": 64, "longest_edge": 96}, size_divisor=32).save_pretrained(path)
