"""A table of vectors, of which none is drawn before there is memory for them."""

from torch import nn


class Embedding(nn.Embedding):
    """``nn.Embedding``, except that nothing is drawn on the meta device, where torch imports its compiler for it.

    That takes three seconds, and every network is built there before its weights are loaded or drawn.
    """

    def reset_parameters(self) -> None:
        if not self.weight.is_meta:
            super().reset_parameters()
