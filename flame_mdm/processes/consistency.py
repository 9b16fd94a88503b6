"""Consistency distillation: a student learns to replace many steps of its teacher with one call.

Let f(x_t, t) be a network's clean estimate at time t. Along each sampling path of the teacher, f
should be the same at all times (Song et al. 2023, "Consistency Models"). Because the teacher's
steps are guided, the student needs no guidance (Luo et al. 2023, "Latent Consistency Models"; Dai
et al. 2024, "MotionLCM").
"""

import torch
from torch import Tensor

from flame_mdm.batch import Condition, Denoise
from flame_mdm.losses import masked_mse
from flame_mdm.processes import Auxiliary, Process


def consistency_terms(
    process: Process,
    student: Denoise,
    follower: Denoise,
    teacher: Denoise,
    x: Tensor,
    mask: Tensor,
    cond: Condition,
    *,
    times: Tensor,
    index: Tensor,
    noise: Tensor,
    auxiliary: Auxiliary,
) -> dict[str, Tensor]:
    """Computes the losses of a student.

    The student's estimate at x_t is compared with the estimate after one step of the teacher. This
    step is a DDIM step with eta = 0 or, for a flow, an Euler step. At the last time in the grid,
    the target is the teacher's own clean estimate.

    Args:
        process: the process of both the student and the teacher. The prediction must be the clean
            motion or the velocity.
        student: the network to train.
        follower: the network that computes the target (the estimate after the step), without
            gradients. It is the student itself, or a copy with averaged weights.
        teacher: the guided teacher.
        x: (B, F, D) normalized clean motion.
        mask: (B, F) bool, True for real frames.
        cond: conditions of the batch.
        times: (N,) times, starting from pure noise; see `Process.grid`.
        index: (B,) int64, the index of each motion's time in `times`, from 0 to N - 1.
        noise: (B, F, D).
        auxiliary: geometric losses between the estimate and the target.

    Returns:
        Per-sample losses (B,), keyed by name: "consistency", the auxiliary losses, and their sum,
        "loss".
    """
    # The step follows the teacher's path to the next time. It is computed from the teacher's clean
    # estimate and the noise that this estimate implies.
    is_last = index == len(times) - 1
    t, end = times[index], times[(index + 1).clamp(max=len(times) - 1)]
    x_t = process.corrupt(x, noise, t)
    with torch.no_grad():
        guided = process.clean(teacher, x_t, t, mask, cond)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        left = (x_t - process.corrupt(guided, zero, t)) / process.corrupt(zero, one, t)
        nearer = process.corrupt(guided, left, end)
        target = torch.where(
            is_last[:, None, None], guided, process.clean(follower, nearer, end, mask, cond)
        )
    estimate = process.clean(student, x_t, t, mask, cond)
    terms = {"consistency": masked_mse(estimate, target, mask)} | auxiliary(estimate, target, mask)
    return terms | {"loss": torch.stack(list(terms.values())).sum(0)}
