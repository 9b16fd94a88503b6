"""Layers of `speed=fast` that a CPU computes with fewer operations: GRU and masked group norm.

They compute the same as the layers that they replace, up to rounding.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.amp import custom_bwd, custom_fwd
from torch.nn import functional


def recur(gru: nn.GRU, x: Tensor) -> Tensor:
    """Computes the outputs of a GRU without dropout, from its inputs, in the GRU's layout.

    torch runs about twelve operations per frame in the forward pass, and in the backward pass
    adds a gradient of the weights per frame. Here, the forward pass runs six operations per
    frame, the backward pass four, and the weights get their gradients from one matrix product.
    """
    x = x.transpose(0, 1) if gru.batch_first else x
    for layer in range(gru.num_layers):
        weights = (getattr(gru, f"{name}_l{layer}") for name in ("weight_ih", "bias_ih"))
        x = _Recurrence.apply(
            functional.linear(x, *weights),
            getattr(gru, f"weight_hh_l{layer}"),
            getattr(gru, f"bias_hh_l{layer}"),
        )
    return x.transpose(0, 1) if gru.batch_first else x


class _Recurrence(torch.autograd.Function):
    """A layer of a GRU from the projected inputs (F, B, 3H) of reset, update and new gate.

    h' = (1 - z) n + z h with r, z = sigmoid(i_rz + W_rz h + b_rz) and n = tanh(i_n + r (W_n h + b_n)),
    see `torch.nn.GRU`.
    """

    @staticmethod
    @custom_fwd(device_type="cpu", cast_inputs=torch.float32)
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        frames, rows, size = inputs.shape[0], inputs.shape[1], weight.shape[1]
        hidden = inputs.new_zeros(frames + 1, rows, size)
        projected = torch.empty_like(inputs)  # W h + b
        gates, new = inputs.new_empty(frames, rows, 2 * size), torch.empty_like(hidden[1:])
        parts = [
            hidden[:-1],
            hidden[1:],
            projected,
            projected[..., : 2 * size],
            projected[..., 2 * size :],
            inputs[..., : 2 * size],
            inputs[..., 2 * size :],
            gates,
            gates[..., :size],
            gates[..., size:],
            new,
        ]
        transposed = weight.t()
        for h, after, w, w_rz, w_n, i_rz, i_n, rz, r, z, n in zip(
            *(part.unbind(0) for part in parts), strict=True
        ):
            torch.addmm(bias, h, transposed, out=w)
            torch.add(i_rz, w_rz, out=rz).sigmoid_()
            torch.addcmul(i_n, r, w_n, out=n).tanh_()
            torch.lerp(n, h, z, out=after)
        ctx.save_for_backward(weight, hidden, projected, gates, new)
        return hidden[1:]

    @staticmethod
    @custom_bwd(device_type="cpu")
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        (gradient,) = gradients
        weight, hidden, projected, gates, new = ctx.saved_tensors
        size = weight.shape[1]
        before, w_n = hidden[:-1], projected[..., 2 * size :]
        r, z = gates[..., :size], gates[..., size:]

        # Factors of the gradient of h' in the gradients of the gates' inputs, for all frames
        of_new = (1 - z) * (1 - new.square())
        of_reset = of_new * w_n * r * (1 - r)
        of_update = (before - new) * z * (1 - z)
        factors = torch.stack([of_reset, of_update, of_new * r], 2)

        to_hidden = torch.empty_like(factors)  # gradients of W h + b, (F, B, 3, H)
        totals = torch.empty_like(new)  # gradients of h', which also come from later frames
        kept = torch.zeros_like(new[0])
        steps = [gradient, factors, to_hidden, to_hidden.flatten(2), totals, totals[:, :, None], z]
        for direct, factor, out, flat, total, of_gates, share in zip(
            *(reversed(part.unbind(0)) for part in steps),
            strict=True,
        ):
            torch.add(direct, kept, out=total)
            torch.mul(factor, of_gates, out=out)
            kept = torch.addmm(total * share, flat, weight)
        flat = to_hidden.flatten(2)
        to_inputs = torch.cat([flat[..., : 2 * size], totals * of_new], -1)
        of_weight = flat.flatten(0, 1).t() @ before.flatten(0, 1)
        return to_inputs, of_weight, flat.sum((0, 1))


def masked_group_norm(
    x: Tensor,
    mask: Tensor,
    num_groups: int,
    weight: Tensor,
    bias: Tensor,
    scale: Tensor | None,
    shift: Tensor | None,
) -> Tensor:
    """Normalizes x (B, C, F) by the statistics of its real frames; see `MaskedGroupNorm`.

    Scale and shift are part of the affine map of the norm, and the backward pass has three
    passes over x instead of about twenty.
    """
    factor, offset = weight.expand(x.shape[:2]), bias.expand(x.shape[:2])
    if scale is not None and shift is not None:
        factor, offset = factor * (1 + scale), offset * (1 + scale) + shift
    return _Normalization.apply(x, mask, num_groups, factor, offset)


class _Normalization(torch.autograd.Function):
    """Masked group norm with a factor and a bias per row and channel (B, C)."""

    @staticmethod
    @custom_fwd(device_type="cpu", cast_inputs=torch.float32)
    def forward(
        ctx: Any, x: Tensor, mask: Tensor, groups: int, weight: Tensor, bias: Tensor
    ) -> Tensor:
        column = mask.transpose(1, 2)  # (B, F, 1)
        count = mask.sum((1, 2)).clamp(min=1)[:, None] * (x.shape[1] // groups)

        def over_group(sums: Tensor) -> Tensor:
            """Means (B, C) over the groups of sums (B, C) over frames."""
            means = sums.unflatten(1, (groups, -1)).sum(2) / count
            return means.repeat_interleave(x.shape[1] // groups, 1)

        centered = x - over_group(torch.bmm(x, column)[..., 0])[..., None]
        variance = over_group(torch.bmm(centered.square(), column)[..., 0])
        scale = (variance + 1e-5).rsqrt()
        ctx.groups = groups
        ctx.save_for_backward(centered, mask, count, scale, weight)
        return torch.addcmul(bias[..., None], centered, (scale * weight)[..., None])

    @staticmethod
    @custom_bwd(device_type="cpu")
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = gradients
        centered, mask, count, scale, weight = ctx.saved_tensors
        of_bias = gradient.sum(2)  # (B, C)
        products = torch.mul(gradient, centered).sum(2)

        def over_group(sums: Tensor) -> Tensor:
            means = sums.unflatten(1, (ctx.groups, -1)).sum(2) / count
            return means.repeat_interleave(sums.shape[1] // ctx.groups, 1)

        # Gradients through the mean and the variance, which reach the real frames only
        by_mean = scale * over_group(of_bias * weight)
        by_variance = scale**3 * over_group(products * weight)
        through = torch.addcmul(by_mean[..., None], centered, by_variance[..., None]).mul_(mask)
        of_x = torch.addcmul(through.neg_(), gradient, (scale * weight)[..., None])
        return of_x, None, None, products * scale, of_bias
