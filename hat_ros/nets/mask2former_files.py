"""Reading the folder of a Mask2Former in the layout of the `transformers` library."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hat_ros.errors import MissingDependencyError, WeightsError

if TYPE_CHECKING:
    from transformers import Mask2FormerForUniversalSegmentation, Mask2FormerImageProcessorPil


def load_mask2former(folder: Path) -> tuple[Mask2FormerImageProcessorPil, Mask2FormerForUniversalSegmentation]:
    """Processor and network, read from local files only; safetensors only, so nothing in them is run.

    Raises:
        WeightsError: a file is missing or damaged, or the tensors are not those of the network.
        MissingDependencyError: the library is not installed.
    """
    try:
        from transformers import Mask2FormerForUniversalSegmentation, Mask2FormerImageProcessorPil
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"mask2former needs the package '{error.name}', which is not installed: "
            f"run `make install-nets` (or `pip install 'hat_ros[nets]'`)"
        ) from None
    try:
        processor = Mask2FormerImageProcessorPil.from_pretrained(folder, local_files_only=True)
        # The library's annotation does not know of `output_loading_info`, which makes it a pair.
        loaded: Any = Mask2FormerForUniversalSegmentation.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # the library lets out whatever its parsers meet
        reason = " ".join(str(error).split())[:200]
        raise WeightsError(
            f"mask2former: {folder} is not a complete folder (config.json, preprocessor_config.json, "
            f"model.safetensors): {reason}"
        ) from None
    model, loading = loaded
    missing = sorted(loading["missing_keys"])  # the library would fill them with random values
    if missing:
        raise WeightsError(
            f"mask2former: {folder}/model.safetensors lacks {len(missing)} tensors of the network, the first is "
            f"{missing[0]}; get the folder again"
        )
    return processor, model
