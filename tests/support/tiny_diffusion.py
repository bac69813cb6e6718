"""A model in diffusers' layout, with SD-Turbo's topology, small enough for a test."""

import json

import torch
from random_diffusion import fill_randomly
from turbo_shapes import WholeModel, build_text_encoder

from lidarpainter_models.painter.one_step.architectures import build_tiny, build_unet, build_vae

TEXT_WIDTH = 16
TINY = WholeModel(
    unet={
        "in_channels": 4,
        "out_channels": 4,
        "block_out_channels": (16, 16, 32, 32),
        "attention_head_dim": (2, 2, 4, 4),
        "cross_attention_dim": TEXT_WIDTH,
        "use_linear_projection": True,
        "layers_per_block": 1,
        "norm_num_groups": 8,
    },
    vae={
        "down_block_types": ("DownEncoderBlock2D",) * 4,
        "up_block_types": ("UpDecoderBlock2D",) * 4,
        "block_out_channels": (8, 8, 16, 16),
        "layers_per_block": 1,
        "norm_num_groups": 4,
        "scaling_factor": 0.18215,
    },
    tiny={
        "encoder_block_out_channels": (8, 8, 8, 8),
        "decoder_block_out_channels": (8, 8, 8, 8),
        "num_encoder_blocks": (1, 1, 1, 1),
        "num_decoder_blocks": (1, 1, 1, 1),
    },
    text={
        "vocab_size": 64,
        "hidden_size": TEXT_WIDTH,
        "intermediate_size": 32,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "projection_dim": TEXT_WIDTH,
        "bos_token_id": 62,
        "eos_token_id": 63,
    },
)
"""Four levels as the real one, so that images are halved six times and skips fit."""


def write_model(folder, seed=0):
    """Write U-Net, both autoencoders, text encoder and tokenizer; returns the folder."""
    parts = {
        "unet": build_unet(TINY, 4),
        "vae": build_vae(TINY),
        "taesd": build_tiny(TINY),
        "text_encoder": build_text_encoder(TINY),
    }
    for name, part in parts.items():
        fill_randomly(part, seed=seed)
        if name == "unet":
            torch.nn.init.constant_(part.conv_out.bias, 0.1 * (seed + 1))
        part.save_pretrained(folder / name)
    write_tokenizer(folder / "tokenizer")
    return folder


def write_tokenizer(folder):
    """A byte-pair tokenizer of single letters."""
    folder.mkdir(parents=True)
    letters = [chr(code) for code in range(ord("a"), ord("z") + 1)]
    words = [*letters, *(f"{letter}</w>" for letter in letters)]
    words += [f"<{index}>" for index in range(62 - len(words))]
    words += ["<|startoftext|>", "<|endoftext|>"]
    vocabulary = {word: index for index, word in enumerate(words)}
    (folder / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    (folder / "tokenizer_config.json").write_text(
        json.dumps(
            {
                "tokenizer_class": "CLIPTokenizer",
                "bos_token": "<|startoftext|>",
                "eos_token": "<|endoftext|>",
                "unk_token": "<|endoftext|>",
                "pad_token": "<|endoftext|>",
                "model_max_length": 77,
            }
        )
    )
