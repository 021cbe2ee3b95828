"""Cross-attention to a single token, without the attention.

Zero-1-to-3 and Stable Video Diffusion attend to one token per picture. The softmax over one key is 1 for any query, so
that every pixel gets out(value(token)): it is computed once, without queries, keys and scores. The result is the same
up to rounding.
"""

from typing import Any

from torch import Tensor


def shorten_attention(unet: Any) -> Any:
    """Return the network with shortened cross-attention to single tokens.

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
    """Processor of diffusers' `Attention`; shapes are not checked, because compilers trace it.

    Args:
        ordinary: processor for several tokens, a mask, or training with its dropout.
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
        """Return the attention's output; names and order of the arguments are diffusers'.

        Args:
            attn: the layer with its weights.
            hidden_states: queries, "b q c" or "b c h w".
            encoder_hidden_states: tokens, "b l d".
            attention_mask: which tokens are seen.
            temb: passed on.

        Returns:
            The shape of `hidden_states`; of one token it may be a view of one query, not to be written to.
        """
        tokens = encoder_hidden_states
        if tokens is None or tokens.shape[1] != 1 or attention_mask is not None or attn.training:
            return self.ordinary(attn, hidden_states, tokens, attention_mask, temb)
        if attn.norm_cross:
            tokens = attn.norm_encoder_hidden_states(tokens)
        output = attn.to_out[0](attn.to_v(tokens))
        if hidden_states.ndim == 4:
            output = output.mT[..., None]
        if attn.residual_connection:
            output = output + hidden_states
        if attn.rescale_output_factor != 1:  # a division less for nearly all layers
            output = output / attn.rescale_output_factor
        return output.expand_as(hidden_states)
