"""Cross-attention to a single token, computed without queries, keys and scores.

Zero-1-to-3 and Stable Video Diffusion attend to one token per image. The softmax over one key is 1 for any query, so
every pixel gets out(value(token)), which is computed once. The result is the same up to rounding.
"""

from typing import Any

from torch import Tensor


def shorten_attention(unet: Any) -> Any:
    """Replace the cross-attention processors of a UNet, and return the UNet.

    Args:
        unet: diffusers' UNet2DConditionModel or UNetSpatioTemporalConditionModel; its weights keep their names.
    """
    processors = unet.attn_processors.items()
    unet.set_attn_processor(
        {
            name: SingleTokenProcessor(fallback) if name.endswith("attn2.processor") else fallback
            for name, fallback in processors
        }
    )
    return unet


class SingleTokenProcessor:
    """Attention processor of diffusers; shapes are not checked, because torch.compile traces it.

    Args:
        fallback: processor for several tokens, masks, or training with dropout.
    """

    def __init__(self, fallback: Any) -> None:
        self.fallback = fallback

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
            attention_mask: of the tokens.
            temb: passed on.

        Returns:
            The shape of `hidden_states`; of one token it may be a view of one query, not to be written to.
        """
        tokens = encoder_hidden_states
        if tokens is None or tokens.shape[1] != 1 or attention_mask is not None or attn.training:
            return self.fallback(attn, hidden_states, tokens, attention_mask, temb)
        if attn.norm_cross:
            tokens = attn.norm_encoder_hidden_states(tokens)
        output = attn.to_out[0](attn.to_v(tokens))
        if hidden_states.ndim == 4:
            output = output.mT[..., None]
        if attn.residual_connection:
            output = output + hidden_states
        if attn.rescale_output_factor != 1:  # saves a division in nearly all layers
            output = output / attn.rescale_output_factor
        return output.expand_as(hidden_states)
