"""Cross-attention to a single token, without the attention.

Zero-1-to-3 and Stable Video Diffusion look at one token per picture. The softmax over one key is 1 whatever the query
asks, so every pixel is told the same, out(value(token)): it is worked out once, and queries, keys and scores not at
all. The result is the same up to rounding.
"""

from typing import Any

from torch import Tensor


def shorten_attention(unet: Any) -> Any:
    """The same network, whose cross-attention takes the short way from now on where there is one token.

    Args:
        unet: diffusers' UNet2DConditionModel or UNetSpatioTemporalConditionModel; no weight moves or changes its name.
    """
    processors = unet.attn_processors.items()
    unet.set_attn_processor(
        {
            name: SingleTokenProcessor(ordinary) if name.endswith("attn2.processor") else ordinary
            for name, ordinary in processors
        }
    )
    return unet


class SingleTokenProcessor:
    """A processor of diffusers' `Attention`.

    Its shapes are not checked: it runs where networks are traced by a compiler.

    Args:
        ordinary: the processor that is asked where there are several tokens, a mask, or training with its dropout.
    """

    def __init__(self, ordinary: Any) -> None:
        self.ordinary = ordinary

    def __call__(
        self,
        attn: Any,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor | None = None,
        attention_mask: Tensor | None = None,
        temb: Tensor | None = None,
    ) -> Tensor:
        """What the queries are told; names and order of the arguments are diffusers'.

        Args:
            attn: the layer with its weights.
            hidden_states: queries, "b q c" or "b c h w".
            encoder_hidden_states: tokens, "b l d".
            attention_mask: which tokens are seen.
            temb: only handed on.

        Returns:
            The shape of `hidden_states`; of one token it may be a view of one query, not to be written to.
        """
        tokens = encoder_hidden_states
        if tokens is None or tokens.shape[1] != 1 or attention_mask is not None or attn.training:
            return self.ordinary(attn, hidden_states, tokens, attention_mask, temb)
        if attn.norm_cross:
            tokens = attn.norm_encoder_hidden_states(tokens)
        told = attn.to_out[0](attn.to_v(tokens))
        if hidden_states.ndim == 4:
            told = told.mT[..., None]
        if attn.residual_connection:
            told = told + hidden_states
        if attn.rescale_output_factor != 1:  # a division less for nearly all layers
            told = told / attn.rescale_output_factor
        return told.expand_as(hidden_states)
