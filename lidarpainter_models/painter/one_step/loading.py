"""A one-step painter from what the user names: a model, or a weights file of ours.

`sd-turbo`, a folder in diffusers' layout and an id of the hub give the model untrained for our
task, in the wiring of a preset (`sd-turbo:fast`; `paper` unless said). A weights file names its
model itself; where that folder has moved, one of the same name beside the file is taken.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from lidarpainter_models.errors import ConfigError, WeightsError
from lidarpainter_models.painter.known_painters import WEIGHTS_SUFFIX, split_preset
from lidarpainter_models.painter.one_step.architectures import TEXT_TOKENS
from lidarpainter_models.painter.one_step.assembly import assemble, merge_lora, trained_in_float32
from lidarpainter_models.painter.one_step.base_models import (
    BaseModel,
    BaseParts,
    load_parts,
    model_files,
    open_base,
)
from lidarpainter_models.painter.one_step.config import PRESETS, OneStepConfig
from lidarpainter_models.painter.one_step.painter import OneStepPainter
from lidarpainter_models.painter.one_step.prompts import PromptBook
from lidarpainter_models.painter.one_step.weights import (
    Trainable,
    TrainedFile,
    apply_trained,
    read_trained,
)
from lidarpainter_models.painter.precision import faster_type
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT

CPU = torch.device("cpu")
UNTRAINED = "none for repairing renders: the model as it comes"
MARK_TOLERANCE = 1e-2
"""Biases of one model agree to this share in float32, float16 and bfloat16."""


def load_one_step(
    name: str,
    *,
    device: torch.device = CPU,
    dtype: torch.dtype | None = None,
    may_download: bool = False,
) -> OneStepPainter:
    """A painter on a device, its adapters merged into the model.

    `dtype` is that of the weights, None what the device computes faster; the step, the fusion and
    the U-Net's last layer stay float32.

    Raises:
        WeightsError: model or weights are missing, damaged, or do not belong together.
        ConfigError: there is no such preset.
        MissingPackageError: the extra `diffusion` is not installed.
    """
    dtype = dtype or faster_type(device)
    file = _file_of(name)
    if file is None:
        model, preset = split_preset(name)
        base, config = open_base(model, may_download=may_download), PRESETS[preset]
    else:
        base, config = _base_of(file, may_download=may_download), file.config
    prompts = _open_prompts(base, file)
    parts = load_parts(base, config, dtype=dtype)
    network = assemble(config, parts.unet, parts.autoencoder, has_adapters=file is not None)
    origin = {"base": base.name, "mark": parts.mark, "licence": base.licence}
    if file is None:
        origin |= {"training": UNTRAINED, "trained_targets": []}
    else:
        _check_mark(file, parts)
        apply_trained(network, file)
        origin = file.provenance | origin | {"licence": file.licence}
    merge_lora(network)
    return OneStepPainter(network, prompts, origin).to(device)


def load_trainable(
    name: str, config: OneStepConfig, *, prompts: Sequence[str], dtype: torch.dtype, seed: int = 0
) -> Trainable:
    """A network to train, on the CPU.

    The name is that of a model, or of a weights file of ours, of the same wiring, to go on from.
    `dtype` is that of the weights that stay as they are; the others are float32. The seed is that
    of the adapters and the fusion, where they are new.

    Raises:
        WeightsError: model or weights are missing, damaged, or do not belong together.
        ConfigError: a weights file of another wiring.
        MissingPackageError: the extra `diffusion` is not installed.
    """
    file = _file_of(name)
    if file is not None and file.config != config:
        raise ConfigError(
            f"{name} is wired otherwise than the training: leave its network as it is"
        )
    base = open_base(split_preset(name)[0]) if file is None else _base_of(file)
    book = _open_prompts(base, file)
    texts = {prompt: book.encode(prompt) for prompt in prompts}
    parts = load_parts(base, config, dtype=dtype)
    network = assemble(config, parts.unet, parts.autoencoder, has_adapters=True, seed=seed)
    trained_in_float32(network)
    if file is not None:
        _check_mark(file, parts)
        apply_trained(network, file)
    return Trainable(
        network=network,
        texts=texts,
        base=base.name,
        mark=parts.mark,
        licence=base.licence,
        provenance={} if file is None else file.provenance | {"licence": file.licence},
    )


def painter_files(name: str) -> list[Path]:
    """The files that a painter of this name is made of, in a fixed order.

    Raises:
        WeightsError: the model or the weights file is not there.
    """
    if (file := _file_of(name)) is not None:
        return [file.path, *model_files(_base_of(file), file.config.autoencoder)]
    model, preset = split_preset(name)
    return model_files(open_base(model), PRESETS[preset].autoencoder)


def _file_of(name: str) -> TrainedFile | None:
    """A weights file of ours; None for the name of a model."""
    return read_trained(Path(name)) if name.endswith(WEIGHTS_SUFFIX) else None


def _check_mark(file: TrainedFile, parts: BaseParts) -> None:
    """Refuse weights of a model whose biases are others than the file says."""
    fits = len(file.mark) == len(parts.mark) and all(
        math.isclose(found, kept, rel_tol=MARK_TOLERANCE, abs_tol=1e-4)
        for found, kept in zip(parts.mark, file.mark, strict=True)
    )
    if not fits:
        raise WeightsError(
            f"weights file {file.path} was trained on another model than {file.base}"
        )


def _base_of(file: TrainedFile, *, may_download: bool = False) -> BaseModel:
    beside = file.path.parent / Path(file.base).name
    moved = not Path(file.base).is_dir() and beside.is_dir()
    try:
        base = open_base(str(beside) if moved else file.base, may_download=may_download)
    except WeightsError as error:
        raise WeightsError(f"weights file {file.path} needs its model: {error}") from None
    return replace(base, name=file.base)


def _open_prompts(base: BaseModel, file: TrainedFile | None) -> PromptBook:
    """The prompts, the default one encoded now: before the U-Net is there, memory is free."""
    prompts = PromptBook({} if file is None else file.prompts, base.folder)
    prompts.encode(DEFAULT_PROMPT)
    expected = (TEXT_TOKENS, base.architecture.text_width)
    for prompt, text in prompts.encoded.items():
        if tuple(text.shape) != expected:
            raise WeightsError(
                f"prompt {prompt!r} for {base.folder} is encoded as {tuple(text.shape)}, its U-Net "
                f"expects {expected}"
            )
    return prompts
