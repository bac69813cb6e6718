"""Prompts as the U-Net wants them: CLIP's features of a text, encoded once and kept.

The text encoder (340 million parameters) is read for a prompt that is new, and let go again; it is
never part of the painter. Weights files carry the prompts they were trained for.
"""

from pathlib import Path
from types import MappingProxyType

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarpainter_models.errors import ConfigError, WeightsError
from lidarpainter_models.painter.one_step.architectures import TEXT_TOKENS, diffusion_package

STYLE_TEXTS = MappingProxyType(
    {
        "clear": "picture of urban street scene",
        "foggy": "image of urban street scene in dense fog",
        "night": "image of urban street scene at night, street lamps and headlights on",
        "rain": "image of urban street scene in the rain, wet road with reflections",
    }
)
"""What a style is called to the text encoder (the first is the authors' own prompt). Any other
prompt is taken as the text itself."""


class PromptBook:
    """Encoded prompts of one model."""

    def __init__(
        self, encoded: dict[str, Float[Tensor, "tokens features"]], folder: Path | None = None
    ) -> None:
        """Begin with what is encoded already.

        The folder is that of a model in diffusers' layout, to encode others with.
        """
        self._encoded = dict(encoded)
        self._folder = folder

    @property
    def encoded(self) -> dict[str, Float[Tensor, "tokens features"]]:
        """All prompts encoded so far."""
        return dict(self._encoded)

    def encode(self, prompt: str) -> Float[Tensor, "tokens features"]:
        """Features of a prompt.

        Raises:
            ConfigError: it is new, and there is no text encoder to encode it with.
            WeightsError: the text encoder cannot be used.
        """
        if prompt not in self._encoded:
            if self._folder is None or not (self._folder / "text_encoder").is_dir():
                known = ", ".join(self._encoded) or "none"
                raise ConfigError(
                    f"the painter knows no prompt {prompt!r} (known: {known}) and its model has "
                    "no text_encoder folder"
                )
            self._encoded[prompt] = encode_text(self._folder, STYLE_TEXTS.get(prompt, prompt))
        return self._encoded[prompt]


def encode_text(folder: Path, text: str) -> Float[Tensor, "tokens features"]:
    """Read a model's text encoder, encode one text, and let the encoder go.

    Raises:
        WeightsError: tokenizer or text encoder are missing, damaged or incomplete.
    """
    transformers = diffusion_package("transformers")
    transformers.logging.disable_progress_bar()  # this takes a second
    try:
        tokenizer = transformers.CLIPTokenizer.from_pretrained(
            str(folder / "tokenizer"), local_files_only=True
        )
        encoder, found = transformers.CLIPTextModel.from_pretrained(
            str(folder / "text_encoder"),
            local_files_only=True,
            use_safetensors=True,
            dtype=torch.bfloat16,
            output_loading_info=True,
        )
        tokens = tokenizer(
            text, max_length=TEXT_TOKENS, padding="max_length", truncation=True, return_tensors="pt"
        ).input_ids
        text_features = run_text_encoder(encoder, tokens)
    except Exception as error:  # noqa: BLE001 - many kinds for one thing: the files do not fit
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise WeightsError(f"the text encoder of {folder} cannot be used: {reason}") from None
    for kind in ("missing_keys", "mismatched_keys"):
        if found[kind]:
            name = sorted(map(str, found[kind]))[0]
            raise WeightsError(f"the text encoder of {folder} has {kind.replace('_', ' ')}: {name}")
    return text_features


@torch.inference_mode()
def run_text_encoder(encoder: nn.Module, tokens: Tensor) -> Float[Tensor, "tokens features"]:
    """Features of the last layer, after its norm."""
    return encoder.eval()(tokens).last_hidden_state[0].clone()
