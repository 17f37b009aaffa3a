"""SigLIP's patch embedding: a convolution on a CPU, one product on a GPU, the same numbers."""

import torch

from dual_system.models.siglip import VisionConfig, VisionTower


def test_the_product_is_the_convolution() -> None:
    """A float32 convolution on a GPU is TF32 unless told otherwise; a product is float32."""
    torch.manual_seed(0)
    tower = VisionTower(VisionConfig(width=24, depth=1, num_heads=2, mlp_width=8, image_px=42, patch_px=14))
    images = torch.rand(3, 3, 42, 42) * 2 - 1
    torch.testing.assert_close(tower._product(images), tower._convolution(images), rtol=1e-5, atol=1e-5)
