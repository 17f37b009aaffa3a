"""Camera frames to Qwen3.5's patches, in torch, so that it runs where the model runs.

Bit-identical to the public image processor (transformers' ``Qwen2VLImageProcessorPil`` with mean = std = 0.5) for
frames that it does not resize. Nothing is resized here: frames come from ``ObservationReader.images``.
"""

import torch
from torch import Tensor

# N frames, R rows and C columns of merged tokens, m merge, p patch size, t temporal patch, D = 3 * t * p * p


def patchify(frames_NHW3: Tensor, *, patch_px: int = 16, merge: int = 2, temporal: int = 2) -> Tensor:
    """Patches of ``frames`` (N, height, width, 3) uint8 as (N * patches, D) float32 in -1..1.

    Patches come in blocks of merge x merge, the order in which the vision tower merges them into one token; a
    still image fills all ``temporal`` slots. Height and width must be multiples of ``patch_px * merge``
    (checked by the caller, once, at start).
    """
    num_frames, height, width, channels = frames_NHW3.shape
    rows, columns = height // (patch_px * merge), width // (patch_px * merge)
    # x / 127.5 - 1 and the processor's (x / 255 - 0.5) / 0.5 agree in float32 for all 256 values
    pixels = frames_NHW3.to(torch.float32).div_(127.5).sub_(1.0)
    pixels = pixels.reshape(num_frames, rows, merge, patch_px, columns, merge, patch_px, channels)
    patches = pixels.permute(0, 1, 4, 2, 5, 7, 3, 6)  # N R C m m 3 p p
    patches = patches.unsqueeze(6).expand(-1, -1, -1, -1, -1, -1, temporal, -1, -1)
    return patches.reshape(num_frames * rows * columns * merge * merge, channels * temporal * patch_px * patch_px)
